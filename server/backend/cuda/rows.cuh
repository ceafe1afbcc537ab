#pragma once

#include "backend/cuda/rows_memory.h"
#include "backend/cuda/team.cuh"
#include "matrix/lagged_tangents.h"
#include "matrix/rows.h"

/// Assembly by rows (matrix/rows.h) on a GPU: a block runs a slice, a thread a row, and the row's blocks are in shared
/// memory.
///
///   part      warp of the block: parts share the rows of a slice
///   sum       copy of the blocks to which a part adds: one for all parts (AddsInTurns) or one for each
///   place     column of a slot within the slice;  capacity: columns that fit at once
///   Quad      four reals, read and written at once
///
/// rows_memory.h says where they are in shared memory.
///
/// 1. A lane reads four reals at once, and no two lanes of a warp meet in a bank.
/// 2. The parts of a slice hide each other's reads. A small scene has few slices and takes more parts for each.
namespace tensormass::backend::cuda {

using view::ElementView;
using view::kSliceRows;
using view::SceneView;

/// A row's blocks of a turn, and its neighbours with KeepsNeighbours: the `Blocks` of matrix::assemble_row. Parts have
/// neighbours in common.
template <class Real, bool KeepsNeighbours, bool AddsInTurns>
class SharedBlocks {
 public:
  __device__ SharedBlocks(void* shared, std::uint32_t capacity)
      : capacity_(capacity),
        part_(threadIdx.x / kWarp),
        parts_(blockDim.x / kWarp),
        quads_(static_cast<Quad*>(shared) + lane()),
        singles_(reinterpret_cast<Real*>(static_cast<Quad*>(shared) + quad_place(sums(), capacity, 0, 0)) + lane()),
        neighbours_(singles_ + single_place(sums(), capacity, 0, 0)) {}

  __device__ std::uint32_t parts() const { return parts_; }
  __device__ std::uint32_t part() const { return part_; }
  __device__ std::uint32_t begin(std::uint32_t column, std::uint32_t count) {
    meet();  // all parts are done with the last turn
    first_ = column;
    held_ = minimum(count, capacity_);
    holds_all_ = column == 0 && held_ == count;
    return held_;
  }
  __device__ bool holds(std::uint32_t place) const { return place - first_ < held_; }

  __device__ void clear(std::uint32_t place, const matrix::RowNeighbour<Real>& neighbour) {
#pragma unroll 1
    for (std::uint32_t sum = 0; sum < sums(); ++sum) {
      Quad* quads = quads_at(place, sum);
      quads[0] = quads[kSliceRows] = {0, 0, 0, 0};
      single_at(place, sum) = 0;
    }
    if constexpr (!KeepsNeighbours) return;
    Real* const to = neighbours_ + (place - first_) * kNeighbourColumnReals;
    for (int c = 0; c < 3; ++c) {
      to[c * kSliceRows] = neighbour.displacement[c];
      to[(3 + c) * kSliceRows] = neighbour.ahead[c];
    }
  }
  template <int Count>
  __device__ void add(const std::uint32_t (&places)[Count], const Mat3<Real> (&blocks)[Count], bool adds) {
    if constexpr (AddsInTurns) {
#pragma unroll 1
      for (std::uint32_t part = 0; part < parts_; ++part) {
        if (adds && part == part_) add_now(places, blocks);
        meet();
      }
    } else {
      if (adds) add_now(places, blocks);
    }
  }
  __device__ Vec3<Real> displacement(std::uint32_t place) const {
    return of_neighbour(minimum(place - first_, held_ - 1), 0);
  }
  __device__ Vec3<Real> ahead(std::uint32_t place) const { return of_neighbour(place - first_, 3); }
  __device__ void meet() const {
    if (parts_ > 1) __syncthreads();
  }
  __device__ Mat3<Real> block(std::uint32_t place) const {
    Mat3<Real> all = of_sum(place, 0);
#pragma unroll 1
    for (std::uint32_t sum = 1; sum < sums(); ++sum) all += of_sum(place, sum);
    return all;
  }
  __device__ bool leads(matrix::RowSums<Real>& sums) const {
    if (parts_ == 1) return true;
    meet();  // the blocks have been read
    const auto place = [&](std::uint32_t part) {
      return reinterpret_cast<Real*>(quads_ - lane()) + row_sums_place(part) + lane();
    };
    Real* const mine = place(part_);
    each(sums, [&](unsigned c, const Real& value) { mine[c * kSliceRows] = value; });
    meet();
    if (part_ != 0) return false;
#pragma unroll 1
    for (std::uint32_t part = 1; part < parts_; ++part) {
      const Real* other = place(part);
      each(sums, [&](unsigned c, Real& value) { value += other[c * kSliceRows]; });
    }
    return true;
  }

 private:
  struct alignas(16) Quad {
    Real x, y, z, w;
  };
  __device__ static unsigned lane() { return threadIdx.x % kWarp; }
  __device__ std::uint32_t sums() const { return AddsInTurns ? 1 : parts_; }
  __device__ std::uint32_t own_sum() const { return AddsInTurns ? 0 : part_; }
  __device__ Vec3<Real> of_neighbour(std::uint32_t column, std::uint32_t first) const {
    const Real* const from = neighbours_ + neighbour_place(column, first);
    return {from[0], from[kSliceRows], from[2 * kSliceRows]};
  }
  __device__ Quad* quads_at(std::uint32_t place, std::uint32_t sum) const {
    return quads_ + quad_place(sum, capacity_, place, first_);
  }
  __device__ Real& single_at(std::uint32_t place, std::uint32_t sum) const {
    return singles_[single_place(sum, capacity_, place, first_)];
  }
  template <int Count>
  __device__ void add_now(const std::uint32_t (&places)[Count], const Mat3<Real> (&blocks)[Count]) {
    // Only wide rows, with several turns, must test each place.
    if (holds_all_) {
      add_where(places, blocks, [](std::uint32_t) { return true; });
    } else {
      add_where(places, blocks, [this](std::uint32_t place) { return holds(place); });
    }
  }
  template <int Count, class IsHeld>
  __device__ void add_where(const std::uint32_t (&places)[Count], const Mat3<Real> (&blocks)[Count],
                            const IsHeld& is_held) {
    // All reads before all writes: a write between them would make the next read wait.
    constexpr int kAtOnce = 4;
#pragma unroll
    for (int first = 0; first < Count; first += kAtOnce) {
      Quad a[kAtOnce], b[kAtOnce];
      Real c[kAtOnce];
#pragma unroll
      for (int i = 0; i < kAtOnce && first + i < Count; ++i) {
        if (!is_held(places[first + i])) continue;
        const Quad* quads = quads_at(places[first + i], own_sum());
        a[i] = quads[0];
        b[i] = quads[kSliceRows];
        c[i] = single_at(places[first + i], own_sum());
      }
#pragma unroll
      for (int i = 0; i < kAtOnce && first + i < Count; ++i) {
        if (!is_held(places[first + i])) continue;
        const Mat3<Real>& block = blocks[first + i];
        Quad* quads = quads_at(places[first + i], own_sum());
        quads[0] = {a[i].x + block(0, 0), a[i].y + block(1, 0), a[i].z + block(2, 0), a[i].w + block(0, 1)};
        quads[kSliceRows] = {b[i].x + block(1, 1), b[i].y + block(2, 1), b[i].z + block(0, 2), b[i].w + block(1, 2)};
        single_at(places[first + i], own_sum()) = c[i] + block(2, 2);
      }
    }
  }
  /// Calls visit(index, value) for kSumsReals reals of the sums: of the vertex tensor, which is symmetric, only six.
  template <class Sums, class Visit>
  __device__ static void each(Sums& sums, const Visit& visit) {
    unsigned c = 0;
    for (int i = 0; i < 3; ++i) {
      visit(c++, sums.force[i]);
      visit(c++, sums.stiffness_ahead[i]);
      visit(c++, sums.momentum[i]);
      for (int j = i; j < 3; ++j) visit(c++, sums.vertex(i, j));
    }
  }
  __device__ Mat3<Real> of_sum(std::uint32_t place, std::uint32_t sum) const {
    const Quad* quads = quads_at(place, sum);
    const Quad a = quads[0], b = quads[kSliceRows];
    Mat3<Real> block;
    block << a.x, a.w, b.z, a.y, b.x, b.w, a.z, b.y, single_at(place, sum);
    return block;
  }

  const std::uint32_t capacity_, part_, parts_;
  Quad* const quads_;  // quad_place, single_place and neighbour_place index these
  Real* const singles_;
  Real* const neighbours_;
  std::uint32_t first_ = 0, held_ = 0;
  bool holds_all_ = false;
};

/// Most parts of a slice of a shape.
template <class Shape>
inline constexpr std::uint32_t kMaxPartsOf = matrix::kAddsInTurns<Shape> ? kMaxParts : kMaxPartsWithSums;

/// Assembles the rows of a group, one block a slice.
template <class Shape, class Law, class Real>
__global__ void __launch_bounds__(kMaxPartsOf<Shape>* kWarp)
    assemble_rows(const __grid_constant__ SceneView<Real> s, const __grid_constant__ ElementView<Real> e,
                  std::uint32_t capacity) {
  extern __shared__ float4 shared[];
  SharedBlocks<Real, matrix::kKeepsNeighbours<Shape>, matrix::kAddsInTurns<Shape>> blocks(shared, capacity);
  matrix::assemble_row<Shape, Law>(s.patches, s.state, s.matrix, s.newton, e, blockIdx.x, threadIdx.x % kWarp, blocks);
}

/// Adds up the kept tensors of the rows of a group, one block a slice.
template <class Shape, class Real>
__global__ void __launch_bounds__(kMaxPartsWithSums* kWarp)
    gather_rows(const __grid_constant__ SceneView<Real> s, const __grid_constant__ ElementView<Real> e,
                std::uint32_t capacity) {
  extern __shared__ float4 shared[];
  SharedBlocks<Real, false, false> blocks(shared, capacity);
  matrix::gather_kept<Shape>(s.state, s.matrix, e, blockIdx.x, threadIdx.x % kWarp, blocks);
}

}  // namespace tensormass::backend::cuda
