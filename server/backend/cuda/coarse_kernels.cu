#include "backend/cuda/coarse_kernels.h"

#include "backend/cuda/solve_team.cuh"
#include "solver/conjugate_gradients.h"

// TM_REAL, float or double, comes from the build.
namespace tensormass::backend::cuda {

namespace {

/// The team of a solve with a coarse level.
template <class Real>
class CoarseTeam : public SolveTeam<Real> {
 public:
  using SolveTeam<Real>::SolveTeam;

  /// solver::each_sum: a warp for each sum. Four sums at a time hide each other's reads.
  template <class Begin, class End, class Term, class Use>
  __device__ void each_sum(std::uint32_t count, const Begin& begin, const End& end, const Term& term,
                           const Use& use) const {
    constexpr std::uint32_t kAtOnce = 4;
    const std::uint32_t lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, warps = blockDim.x / kWarp;
    for (std::uint32_t first = warp; first < count; first += kAtOnce * warps) {
      Real sums[kAtOnce] = {};
      std::uint32_t from = count, to = 0;
#pragma unroll
      for (std::uint32_t k = 0; k < kAtOnce; ++k) {
        const std::uint32_t i = first + k * warps;
        if (i >= count) break;
        from = minimum(from, begin(i));
        to = maximum(to, end(i));
      }
      for (std::uint32_t j = from + lane; j < to; j += kWarp) {
#pragma unroll
        for (std::uint32_t k = 0; k < kAtOnce; ++k) {
          const std::uint32_t i = first + k * warps;
          if (i < count && j >= begin(i) && j < end(i)) sums[k] += term(i, j);
        }
      }
#pragma unroll
      for (std::uint32_t k = 0; k < kAtOnce; ++k) {
        const std::uint32_t i = first + k * warps;
        Real sum = sums[k];
        for (unsigned mask = kWarp / 2; mask > 0; mask /= 2) sum += __shfl_xor_sync(0xFFFFFFFFu, sum, mask);
        if (lane == 0 && i < count) use(i, sum);
      }
    }
  }
  /// solver::whole_sum: every warp adds up everything in the same order.
  template <class Term>
  __device__ Real whole_sum(std::uint32_t count, const Term& term) const {
    Real sum = 0;
    for (std::uint32_t i = threadIdx.x % kWarp; i < count; i += kWarp) sum += term(i);
    for (unsigned mask = kWarp / 2; mask > 0; mask /= 2) sum += __shfl_xor_sync(0xFFFFFFFFu, sum, mask);
    return sum;
  }
};

template <class Real>
__global__ void __launch_bounds__(kMaxBlockThreads) measure_errors(const __grid_constant__ CoarseScene<Real> s) {
  solver::measure_errors_of_rows(Team(), s.scene.patches, s.scene.state, s.scene.matrix, s.coarse);
}
template <class Real>
__global__ void __launch_bounds__(kMaxBlockThreads) sum_rows(const __grid_constant__ CoarseScene<Real> s) {
  solver::sum_free_parts_of_rows(Team(), s.scene.patches, s.scene.state, s.scene.matrix, s.coarse);
}
template <class Real>
__global__ void __launch_bounds__(kMaxBlockThreads) measure_losses(const __grid_constant__ CoarseScene<Real> s) {
  solver::measure_losses_of_rows(Team(), s.scene.patches, s.scene.matrix, s.coarse);
}
template <class Real>
__global__ void __launch_bounds__(kStageThreads) assemble_matrix(const __grid_constant__ CoarseScene<Real> s) {
  solver::assemble_coarse_pair(Team(), blockIdx.x, s.scene.patches, s.scene.state, s.scene.matrix, s.coarse, s.lists);
}
/// Computes W by elimination of E and of the identity side by side: row i of both −= E_ik / E_kk · row k, for k = 0, 1,
/// .. Column k of E is no longer needed then, so column k of W takes its place. W is scaled at the end.
///
/// The triangle is in registers: thread (x, y) of 32 × 16 has the elements (y + 16 a, x + 32 b), b ≤ a / 2. In each of
/// n steps, shared memory carries column k of E and row k of W from those that have them to all.
template <class Real>
__global__ void __launch_bounds__(kCoarseThreads) invert_matrix(const __grid_constant__ CoarseScene<Real> s) {
  constexpr unsigned kUnknowns = view::kRigidModes * view::kMaxAggregates, kWidth = 32,
                     kHeight = kCoarseThreads / kWidth;
  constexpr unsigned kA = kUnknowns / kHeight, kB = kUnknowns / kWidth;
  static_assert(kUnknowns % kWidth == 0 && kWidth == 2 * kHeight);
  __shared__ double columns[2][kUnknowns], rows[2][kUnknowns], least[kUnknowns], scale[kUnknowns];
  const auto n = static_cast<unsigned>(solver::coarse_unknowns(s.coarse));
  const unsigned x = threadIdx.x % kWidth, y = threadIdx.x / kWidth;
  double triangle[kA][kB];  // those beyond b = a / 2 do not exist
#pragma unroll
  for (unsigned a = 0; a < kA; ++a) {
#pragma unroll
    for (unsigned b = 0; b <= a / 2; ++b) {
      const unsigned i = y + kHeight * a, j = x + kWidth * b;
      triangle[a][b] = i < n && j <= i ? s.coarse.sums[std::size_t{n} * i + j] : 0;
      if (i == j) least[i] = solver::kLeastPivot * triangle[a][b];
    }
  }
#pragma unroll
  for (unsigned block = 0; block < kB; ++block) {
#pragma unroll 1
    for (unsigned in_block = 0; in_block < kWidth; ++in_block) {
      const unsigned k = kWidth * block + in_block;
      if (k >= n) break;
      double* const column = columns[k % 2];  // by parity: the last step's may still be read
      double* const row = rows[k % 2];
      if (x == in_block) {
#pragma unroll
        for (unsigned a = 2 * block; a < kA; ++a) column[y + kHeight * a] = triangle[a][block];
      }
      if (y == k % kHeight) {
#pragma unroll
        for (unsigned b = 0; b <= block; ++b) {
          row[x + kWidth * b] = in_block < kHeight ? triangle[2 * block][b] : triangle[2 * block + 1][b];
        }
      }
      __syncthreads();
      const double pivot = column[k];
      const bool kept = pivot > least[k];  // else the mode is left out
      const double inverse = kept ? 1 / pivot : 0;
      if (threadIdx.x == 0) scale[k] = std::sqrt(inverse);
      double other[kB];
#pragma unroll
      for (unsigned b = 0; b < kB; ++b) {
        const unsigned j = x + kWidth * b;
        other[b] = j < k ? row[j] : j > k ? column[j] : 1;
      }
#pragma unroll
      for (unsigned a = 2 * block; a < kA; ++a) {
        const unsigned i = y + kHeight * a;
        if (i <= k) continue;
        const double factor = column[i] * inverse;
#pragma unroll
        for (unsigned b = 0; b <= a / 2; ++b) {
          const double before = x + kWidth * b == k ? 0 : triangle[a][b];
          triangle[a][b] = before - factor * other[b];
        }
      }
    }
  }
  __syncthreads();
#pragma unroll
  for (unsigned a = 0; a < kA; ++a) {
#pragma unroll
    for (unsigned b = 0; b <= a / 2; ++b) {
      const unsigned i = y + kHeight * a, j = x + kWidth * b;
      if (i >= n || j > i) continue;
      const auto value = static_cast<Real>(scale[i] * (j < i ? triangle[a][b] : 1));
      s.coarse.lower[solver::lower_place(i, j)] = value;
      s.coarse.upper[solver::upper_place(n, j, i)] = value;
    }
  }
}
template <class Real>
__global__ void __launch_bounds__(kCoarseThreads) solve_system(const __grid_constant__ CoarseScene<Real> s) {
  __shared__ Real vectors[4 * view::kRigidModes * view::kMaxAggregates];
  extern __shared__ float4 shared[];
  const Real *lower = s.coarse.lower, *upper = s.coarse.upper;
  if (const auto n = static_cast<unsigned>(solver::coarse_unknowns(s.coarse)); coarse_shared_bytes<Real>(n) > 0) {
    auto* const copy = reinterpret_cast<Real*>(shared);
    const unsigned reals = solver::triangle_reals(n);
    for (unsigned i = threadIdx.x; i < reals; i += kCoarseThreads) {
      copy[i] = lower[i];
      copy[reals + i] = upper[i];
    }
    lower = copy;
    upper = copy + reals;
  }
  CoarseTeam<Real> team(s.scene.solve.report);
  solver::RowsCoarseLevel<CoarseTeam<Real>, Real> level(team, s.scene.patches, s.coarse, s.lists, lower, upper,
                                                        vectors);
  solver::conjugate_gradients(team, s.scene.patches, s.scene.state, s.scene.matrix, s.scene.solve, s.scene.links,
                              level);
}

}  // namespace

template <class Real>
CoarseKernels coarse_kernels() {
  const auto pointer = [](auto* kernel) { return reinterpret_cast<const void*>(kernel); };
  return {pointer(&measure_errors<Real>),  pointer(&sum_rows<Real>),      pointer(&measure_losses<Real>),
          pointer(&assemble_matrix<Real>), pointer(&invert_matrix<Real>), pointer(&solve_system<Real>)};
}

template CoarseKernels coarse_kernels<TM_REAL>();

}  // namespace tensormass::backend::cuda
