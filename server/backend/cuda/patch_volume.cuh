#pragma once

#include <limits>

#include <cuda_pipeline.h>
#include <Eigen/Geometry>

#include "backend/cuda/checked_tetrahedra.h"
#include "backend/cuda/exchange.cuh"
#include "solver/time_scheme.h"
#include "step/inversion_check.h"

/// The epilogue of a fused solve: moves the rows, and checks the volume of the patch's linear tetrahedra.
///
///   u, X, x   displacement, rest position and position of a row;  x = X + u
///   own, halo   rows of the patch; rows of other patches to which they are coupled
///
///   prefetch ──> move own rows ──> publish u ──> check tetrahedra of own rows only
///                                     │                        │
///                                     └──> u of the halo ──────┴──> check those with rows of the halo ──> report
///
/// 1. A separate kernel would take longer to launch and to wait for than this whole check.
/// 2. Positions are in shared memory, relative to a row of the patch. Rounding then depends on the patch's size.
/// 3. Nearly always no tetrahedron is inverted, so only the sign of the volume is computed. det F, from differences of
///    the stored values, is computed only for those without positive volume.
/// 4. Own tetrahedra come first: their check hides the wait for the halo.
namespace tensormass::backend::cuda {

/// Finds inverted tetrahedra of a patch (matrix/patch_tetrahedra.h) at the end of a solve.
template <unsigned Threads>
class PatchVolume {
 public:
  /// The ranges of the patch's tetrahedra: those of own rows only, then those with rows of the halo. A kernel reads
  /// them at its start into shared memory, so that its end does not wait for them.
  struct Parts {
    std::uint32_t begin, halo_begin, end;
  };
  __device__ static Parts parts_of(const view::SceneView<float>& s, const view::Patch& patch) {
    const std::uint32_t* const parts = s.guard.patch_tetrahedra + 2 * patch.index;
    return {parts[0], parts[1], parts[2]};
  }

  /// Prefetches what the check reads. A solve takes long enough for caches to lose it.
  __device__ static void expect(const view::SceneView<float>& s, const Parts& parts) {
    constexpr std::uint32_t kLine = kTetrahedraInLine;
    for (std::uint32_t t = parts.begin + kLine * threadIdx.x; t < parts.end; t += kLine * Threads) {
      tensormass::expect(s.guard.tetrahedron_rows + std::size_t{4} * t);
    }
  }

  /// All threads must call it, once shared memory is free. It starts reading what the solve does not change.
  __device__ PatchVolume(const view::SceneView<float>& s, const view::Patch& patch, const Parts& parts,
                         Exchange& exchange, float4* shared)
      : s_(s),
        patch_(patch),
        exchange_(exchange),
        positions_(shared),
        tetrahedra_(reinterpret_cast<const uint2*>(s.guard.tetrahedron_rows)),
        begin_(parts.begin),
        halo_begin_(parts.halo_begin),
        end_(parts.end),
        origin_(view::load3<float>(s.state.rest, patch.row_begin)) {
    exchange_.begin();
    halo_.read(*this, threadIdx.x);
    read_ahead(begin_ + threadIdx.x, halo_begin_);
  }

  /// `moved` of solver::move_rows: reads a row's rest position, then publishes and stores where it has moved.
  __device__ Vec3<float> read(std::uint32_t row) const { return view::load3<float>(s_.state.rest, row); }
  __device__ void operator()(std::uint32_t row, const Vec3<float>& u, const Vec3<float>& rest) const {
    exchange_.publish_row(row, u[0], u[1], u[2]);
    positions_[row - patch_.row_begin] = position(rest, u);
  }

  /// All threads must call it, after move_rows. Returns whether one of the thread's tetrahedra seems inverted.
  __device__ bool finds() {
    bool inverted = false;
    std::uint32_t t = begin_ + threadIdx.x, end = halo_begin_;
    // Tetrahedra of own rows first, while rows of the halo arrive. One loop serves both: code that runs once waits for
    // its instructions.
#pragma unroll 1
    for (bool ends = false;; ends = true) {
      __syncthreads();
#pragma unroll 1
      for (; t < end; t += kAtOnce * Threads) {
        uint2 nodes[kAtOnce];
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) nodes[i] = ahead_[i];
        read_ahead(t + kAtOnce * Threads, end);
#pragma unroll
        for (std::uint32_t i = 0; i < kAtOnce; ++i) inverted |= !has_volume(nodes[i]);
      }
      if (ends) return inverted;
      t = halo_begin_ + threadIdx.x;
      end = end_;
      read_ahead(t, end);
      place_halo();
    }
  }
  /// All threads must call it; they synchronize here. Returns the smallest det F of the patch's tetrahedra that seem
  /// inverted; infinity if no thread has found one, as in nearly all steps.
  __device__ float least_det_f(const Team& team, bool found) const {
    float least = std::numeric_limits<float>::infinity();
    if (__syncthreads_or(found ? 1 : 0) == 0) return least;
#pragma unroll 1
    for (std::uint32_t t = begin_ + threadIdx.x; t < end_; t += Threads) {
      if (!has_volume(tetrahedra_[t])) least = fminf(least, det_f(tetrahedra_[t]));
    }
    return -team.patch_max(-least);
  }

 private:
  // Several in flight hide each other's latency.
  static constexpr std::uint32_t kAtOnce = 3, kHaloAtOnce = 4;

  /// Rows h, h + Threads, .. of the halo.
  struct Halo {
    std::uint32_t rows[kHaloAtOnce];
    Vec3<float> rest[kHaloAtOnce];

    __device__ void read(const PatchVolume& of, std::uint32_t h) {
#pragma unroll
      for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
        const std::uint32_t place = h + i * Threads;
        rows[i] = place < of.patch_.halo_count ? of.s_.patches.halo[of.patch_.halo_begin + place] : 0;
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) rest[i] = view::load3<float>(of.s_.state.rest, rows[i]);
    }
    __device__ void place(const PatchVolume& of, std::uint32_t h) const {
      Exchange::Cell cells[kHaloAtOnce];
      of.exchange_.wait_for_rows(
          h, Threads, of.patch_.halo_count, [&](int i) { return rows[i]; }, cells);
#pragma unroll
      for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
        const std::uint32_t place = h + i * Threads;
        if (place >= of.patch_.halo_count) break;
        of.positions_[of.patch_.own() + place] = of.position(rest[i], {cells[i].x, cells[i].y, cells[i].z});
      }
    }
  };

  /// Reads the thread's next tetrahedra.
  __device__ void read_ahead(std::uint32_t t, std::uint32_t end) {
#pragma unroll
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      if (t < end) ahead_[i] = tetrahedra_[tetrahedron_ahead(t, i, Threads, end)];
    }
  }
  __device__ void place_halo() {
#pragma unroll 1
    for (std::uint32_t h = threadIdx.x; h < patch_.halo_count; h += kHaloAtOnce * Threads) {
      if (h != threadIdx.x) halo_.read(*this, h);
      halo_.place(*this, h);
    }
  }

  /// Position relative to a row of the patch, so that rounding depends on the patch's size and not the scene's.
  __device__ float4 position(const Vec3<float>& rest, const Vec3<float>& u) const {
    const Vec3<float> x = (rest - origin_) + u;
    return {x[0], x[1], x[2], 0};
  }
  __device__ static std::uint32_t local_of(uint2 nodes, std::uint32_t k) { return local_of_node(nodes.x, nodes.y, k); }
  /// Whether the volume is positive, within rounding: a tetrahedron whose height is a millionth of its patch may count
  /// as flat.
  __device__ bool has_volume(uint2 nodes) const {
    Vec3<float> x[4];
#pragma unroll
    for (std::uint32_t k = 0; k < 4; ++k) {
      const float4 at = positions_[local_of(nodes, k)];
      x[k] = {at.x, at.y, at.z};
    }
    return (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0])) > 0;
  }
  __device__ float det_f(uint2 nodes) const {
    Vec3<float> rest[4], displacement[4];
    for (std::uint32_t k = 0; k < 4; ++k) {
      const std::uint32_t row = view::global_row(s_.patches, patch_, local_of(nodes, k));
      rest[k] = view::load3<float>(s_.state.rest, row);
      const Exchange::Cell cell = exchange_.row(row);
      displacement[k] = {cell.x, cell.y, cell.z};
    }
    return step::det_f_of_nodes(rest, displacement);
  }

  const view::SceneView<float>& s_;
  const view::Patch& patch_;
  Exchange& exchange_;
  float4* const positions_;  // [own and halo], overwrites the vectors of the solve
  const uint2* const tetrahedra_;
  const std::uint32_t begin_, halo_begin_, end_;  // tetrahedra of own rows only, then the others
  const Vec3<float> origin_;
  Halo halo_;
  uint2 ahead_[kAtOnce];
};

/// The epilogue of a solve: moves the patch's rows, writes the patch's report and, if the scene asks for it, checks the
/// volume of its tetrahedra. All threads must call it, once shared memory is free.
///   change_of(row) -> Vec3<float>   Δv of the row
template <unsigned Threads, class Change>
__device__ void end_solve(const view::SceneView<float>& s, const view::Patch& patch,
                          const typename PatchVolume<Threads>::Parts& tetrahedra, Exchange& exchange, float4* shared,
                          const Change& change_of) {
  const Team team;
  if (s.guard.patch_tetrahedra == nullptr) {
    solver::report(
        team, s.guard,
        solver::advance_by(team, s.patches, s.state, s.newton, s.guard, change_of, solver::DiscardPosition{}));
  } else {
    PatchVolume<Threads> volume(s, patch, tetrahedra, exchange, shared);
    const solver::Motion<float> motion =
        solver::advance_by(team, s.patches, s.state, s.newton, s.guard, change_of, volume);
    const bool found = volume.finds();
    solver::report(team, s.guard, motion, [&] { return volume.least_det_f(team, found); });
  }
  if (threadIdx.x == 0) exchange.remember();
}

}  // namespace tensormass::backend::cuda
