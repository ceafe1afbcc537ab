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
template <class Real>
__global__ void __launch_bounds__(kCoarseThreads) invert_matrix(const __grid_constant__ CoarseScene<Real> s) {
  extern __shared__ double scratch[];
  solver::invert_coarse(Team(), s.coarse, scratch);
}
template <class Real>
__global__ void __launch_bounds__(kCoarseThreads) solve_system(const __grid_constant__ CoarseScene<Real> s) {
  __shared__ Real vectors[4 * view::kRigidModes * view::kMaxAggregates];
  CoarseTeam<Real> team(s.scene.solve.report);
  solver::RowsCoarseLevel<CoarseTeam<Real>, Real> level(team, s.scene.patches, s.coarse, s.lists, vectors);
  solver::conjugate_gradients(team, s.scene.patches, s.scene.state, s.scene.matrix, s.scene.solve, s.scene.links, level);
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
