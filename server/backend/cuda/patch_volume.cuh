#pragma once

#include <limits>

#include <cuda_pipeline.h>

#include "backend/cuda/exchange.cuh"
#include "solver/advance.h"
#include "tensor/check_volume.h"

namespace tensormass::backend::cuda {

/// Looks for tetrahedra of a patch (tensor/patch_tetrahedra.h) that are turned inside out where a solve ends: patches
/// tell each other how far their rows have moved, and each looks at its own tetrahedra in shared memory. A kernel of
/// its own takes longer to begin and to be waited for than this takes in all.
template <unsigned Threads>
class PatchVolume {
 public:
  /// Where the patch's tetrahedra are, of own rows only and the others. A kernel reads it when it begins and keeps it
  /// in shared memory, so that its end does not wait for it.
  struct Parts {
    std::uint32_t begin, halo_begin, end;
  };
  __device__ static Parts parts_of(const tensor::SceneView<float>& s, const tensor::Patch& patch) {
    const std::uint32_t* const parts = s.patch_tetrahedra + 2 * patch.index;
    return {parts[0], parts[1], parts[2]};
  }

  /// Has what a check reads brought near. A solve takes long enough for caches to lose it.
  __device__ static void expect(const tensor::SceneView<float>& s, const Parts& parts) {
    constexpr std::uint32_t kLine = 16;  // tetrahedra in 128 bytes
    for (std::uint32_t t = parts.begin + kLine * threadIdx.x; t < parts.end; t += kLine * Threads) {
      tensormass::expect(s.tetrahedron_rows + std::size_t{4} * t);
    }
  }

  /// By all threads, when nothing in shared memory is in use any more. What the solve does not change is on its way
  /// from now on.
  __device__ PatchVolume(const tensor::SceneView<float>& s, const tensor::Patch& patch, const Parts& parts,
                         Exchange& exchange, float4* shared)
      : s_(s),
        patch_(patch),
        exchange_(exchange),
        positions_(shared),
        tetrahedra_(reinterpret_cast<const uint2*>(s.tetrahedron_rows)),
        begin_(parts.begin),
        halo_begin_(parts.halo_begin),
        end_(parts.end),
        origin_(tensor::load3<float>(s.rest, patch.row_begin)) {
    exchange_.begin();
    halo_.read(*this, threadIdx.x);
    read_ahead(begin_ + threadIdx.x, halo_begin_);
  }

  /// What solver::move_rows wants: for each own row, where it is at rest, and where it has moved to.
  __device__ Vec3<float> read(std::uint32_t row) const { return tensor::load3<float>(s_.rest, row); }
  __device__ void operator()(std::uint32_t row, const Vec3<float>& u, const Vec3<float>& rest) const {
    exchange_.publish_row(row, u[0], u[1], u[2]);
    positions_[row - patch_.row_begin] = position(rest, u);
  }

  /// By all threads, after that: whether one of the tetrahedra that the thread looks at seems inside out.
  __device__ bool finds() {
    bool inside_out = false;
    std::uint32_t t = begin_ + threadIdx.x, end = halo_begin_;
    // First what needs no row of the halo, which is on its way meanwhile. Both by the same instructions: what runs once
    // waits for them.
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
        for (std::uint32_t i = 0; i < kAtOnce; ++i) inside_out |= !has_volume(nodes[i]);
      }
      if (ends) return inside_out;
      t = halo_begin_ + threadIdx.x;
      end = end_;
      read_ahead(t, end);
      place_halo();
    }
  }
  /// By all threads, which meet here: of the patch's tetrahedra that seem inside out; infinity where no thread has
  /// found one, as in nearly all steps.
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
  // Some at once hide what each waits for.
  static constexpr std::uint32_t kAtOnce = 3, kHaloAtOnce = 4;

  /// Rows h, h + Threads, .. of the halo.
  struct Halo {
    std::uint32_t rows[kHaloAtOnce];
    Vec3<float> rest[kHaloAtOnce];

    __device__ void read(const PatchVolume& of, std::uint32_t h) {
#pragma unroll
      for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) {
        const std::uint32_t place = h + i * Threads;
        rows[i] = place < of.patch_.halo_count ? of.s_.halo[of.patch_.halo_begin + place] : 0;
      }
#pragma unroll
      for (std::uint32_t i = 0; i < kHaloAtOnce; ++i) rest[i] = tensor::load3<float>(of.s_.rest, rows[i]);
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

  /// The thread's next; beyond the end the last one again, which does no harm.
  __device__ void read_ahead(std::uint32_t t, std::uint32_t end) {
#pragma unroll
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      if (t < end) ahead_[i] = tetrahedra_[minimum(t + i * Threads, end - 1)];
    }
  }
  __device__ void place_halo() {
#pragma unroll 1
    for (std::uint32_t h = threadIdx.x; h < patch_.halo_count; h += kHaloAtOnce * Threads) {
      if (h != threadIdx.x) halo_.read(*this, h);
      halo_.place(*this, h);
    }
  }

  /// Relative to a row of the patch: rounded to what the patch is large, not the scene.
  __device__ float4 position(const Vec3<float>& rest, const Vec3<float>& u) const {
    const Vec3<float> x = (rest - origin_) + u;
    return {x[0], x[1], x[2], 0};
  }
  __device__ static std::uint32_t local_of(uint2 nodes, std::uint32_t k) {
    return (k < 2 ? nodes.x : nodes.y) >> (16 * (k % 2)) & 0xFFFF;
  }
  /// As far as rounded positions tell: a tetrahedron whose height is a millionth of its patch may be taken for flat.
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
      const std::uint32_t row = tensor::global_row(s_, patch_, local_of(nodes, k));
      rest[k] = tensor::load3<float>(s_.rest, row);
      const Exchange::Cell cell = exchange_.row(row);
      displacement[k] = {cell.x, cell.y, cell.z};
    }
    return tensor::det_f_of_nodes(rest, displacement);
  }

  const tensor::SceneView<float>& s_;
  const tensor::Patch& patch_;
  Exchange& exchange_;
  float4* const positions_;  // [own and halo], where q and direction have been
  const uint2* const tetrahedra_;
  const std::uint32_t begin_, halo_begin_, end_;  // tetrahedra of own rows only, then the others
  const Vec3<float> origin_;
  Halo halo_;
  uint2 ahead_[kAtOnce];
};

/// Ends a solve: moves the patch's rows by the change of velocity that `change_of(row)` says, reports on them, and has
/// the volume of the tetrahedra checked where the scene asks for it. By all threads, when nothing in shared memory is
/// in use any more.
template <unsigned Threads, class Change>
__device__ void end_solve(const tensor::SceneView<float>& s, const tensor::Patch& patch,
                          const typename PatchVolume<Threads>::Parts& tetrahedra, Exchange& exchange, float4* shared,
                          const Change& change_of) {
  const Team team;
  if (s.patch_tetrahedra == nullptr) {
    solver::report(team, s, solver::advance_by(team, s, change_of, solver::Unasked{}));
  } else {
    PatchVolume<Threads> volume(s, patch, tetrahedra, exchange, shared);
    const solver::Motion<float> motion = solver::advance_by(team, s, change_of, volume);
    const bool found = volume.finds();
    solver::report(team, s, motion, [&] { return volume.least_det_f(team, found); });
  }
  if (threadIdx.x == 0) exchange.remember();
}

}  // namespace tensormass::backend::cuda
