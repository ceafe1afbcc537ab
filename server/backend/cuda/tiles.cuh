#pragma once

#include <cuda_pipeline_primitives.h>

#include "backend/cuda/team.cuh"
#include "tensor/assembly.h"

/// Elements to rows through shared memory; tensor/tiles.h says what tiles are. A block runs the parts of one tile.
namespace tensormass::backend::cuda {

using tensor::ElementView;
using tensor::kSliceRows;
using tensor::SceneView;

inline constexpr unsigned kFinishThreads = 256;

/// A slice of tetrahedra touches about 350 elements: a thread each, at two blocks a multiprocessor.
template <class Shape>
inline constexpr unsigned kTileThreads = Shape::kNodes == 4 ? 352 : 256;
inline constexpr unsigned kMostTileWarps = 352 / kWarp;

/// An element's record in shared memory; physics::add_point writes to it.
template <class Shape, class Real>
struct SharedRecord {
  Real* record;
  __device__ void add_force(int k, const Vec3<Real>& force, bool first) {
    Real* out = record + tensor::force_offset(static_cast<std::uint32_t>(k));
    for (int c = 0; c < 3; ++c) out[c] = first ? force[c] : out[c] + force[c];
  }
  __device__ void add_edge(int pair, const Mat3<Real>& block, bool first) {
    Real* out = record + tensor::edge_offset(Shape::kNodes, static_cast<std::uint32_t>(pair));
    for (int c = 0; c < 9; ++c) out[c] = first ? block(c % 3, c / 3) : out[c] + block(c % 3, c / 3);
  }
};

/// The sums of a row, put together from the warps that have shared its slots, in their order. Shared memory,
/// [warps][kReals][kSliceRows].
template <class Real>
class SharedSums {
 public:
  static constexpr unsigned kReals = 15;
  static constexpr std::size_t kBytes = kMostTileWarps * kReals * kSliceRows * sizeof(Real);

  __device__ explicit SharedSums(void* shared) : place_(static_cast<Real*>(shared)) {}
  __device__ void store(unsigned warp, unsigned lane, const tensor::RowSums<Real>& sums) const {
    Real* out = place_ + warp * kReals * kSliceRows + lane;
    each(sums, [&](unsigned c, const Real& value) { out[c * kSliceRows] = value; });
  }
  __device__ void add_to(unsigned warp, unsigned lane, tensor::RowSums<Real>& sums) const {
    const Real* in = place_ + warp * kReals * kSliceRows + lane;
    each(sums, [&](unsigned c, Real& value) { value += in[c * kSliceRows]; });
  }

 private:
  /// Of the vertex tensor, which is symmetric, the upper triangle.
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
  Real* const place_;
};

/// Starts a copy of 16-bit numbers to shared memory, by the whole block; both ends are aligned to kTileAlignment.
__device__ inline void copy_async(std::uint16_t* to, const std::uint16_t* from, std::uint32_t count) {
  for (std::uint32_t i = threadIdx.x * tensor::kTileAlignment; i < count; i += blockDim.x * tensor::kTileAlignment) {
    __pipeline_memcpy_async(to + i, from + i, sizeof(std::uint16_t) * tensor::kTileAlignment);
  }
}

/// Shared memory of assemble_tiles [bytes]: records, or sums when those have been read; then lists and entries.
template <class Real>
std::size_t tile_record_bytes(const ElementView<Real>& e) {
  return (std::max(e.tile_reals * sizeof(Real), SharedSums<Real>::kBytes) + 15) / 16 * 16;
}
template <class Real>
std::size_t tile_bytes(const ElementView<Real>& e) {
  return tile_record_bytes(e) + e.tile_lists * sizeof(std::uint16_t);
}

/// The sum of a slot's edge tensors.
template <class Real>
__device__ Mat3<Real> gather_edge(const Real* records, const std::uint16_t* entries, std::uint32_t begin,
                                  std::uint32_t end) {
  Mat3<Real> edge = Mat3<Real>::Zero();
  for (std::uint32_t i = begin; i < end; ++i) {
    const std::uint32_t entry = entries[i];
    const Real* block = records + (entry >> 1);
    const std::uint32_t row_step = (entry & 1) != 0 ? 3 : 1, column_step = 4 - row_step;
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) edge(r, c) += block[r * row_step + c * column_step];
    }
  }
  return edge;
}

template <class Shape, class Law, class Real>
__global__ void __launch_bounds__(kTileThreads<Shape>, 2)
    assemble_tiles(const __grid_constant__ SceneView<Real> s, const __grid_constant__ ElementView<Real> e,
                   std::uint32_t record_bytes) {
  extern __shared__ float4 aligned[];
  Real* const records = reinterpret_cast<Real*>(aligned);
  auto* const list = reinterpret_cast<std::uint16_t*>(reinterpret_cast<char*>(aligned) + record_bytes);
  constexpr std::uint32_t kRecord = tensor::tile_record_reals(Shape::kNodes);
  constexpr unsigned kThreads = kTileThreads<Shape>, kWarps = kThreads / kWarp;
  const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;

  for (std::uint32_t index = e.tile_parts[blockIdx.x]; index < e.tile_parts[blockIdx.x + 1]; ++index) {
    const tensor::TilePart part = e.parts[index];
    const std::uint32_t listed = (part.list_count + tensor::kTileAlignment - 1) / tensor::kTileAlignment;
    std::uint16_t* const entries = list + listed * tensor::kTileAlignment;
    copy_async(list, e.tile_list + part.list_begin, part.list_count);
    copy_async(entries, e.tile_entries + part.entry_begin, part.entry_count);
    __pipeline_commit();
    for (std::uint32_t i = threadIdx.x; i < part.element_count; i += kThreads) {
      SharedRecord<Shape, Real> record{records + i * kRecord};
      tensor::evaluate_elements<SingleLane<Real>, Shape, Law>(s, e, e.tile_elements[part.element_begin + i], false,
                                                              record);
    }
    __pipeline_wait_prior(0);
    __syncthreads();

    // Warps take turns with the slots of a slice.
    const std::uint32_t which = warp % part.slice_count, turn = warp / part.slice_count;
    const std::uint32_t turns = kWarps / part.slice_count;  // a warp may be left over
    const std::uint32_t slice = part.slice_begin + which, row = slice * kSliceRows + lane;
    const std::uint32_t columns_before = s.slice_begin[part.slice_begin];
    const std::uint32_t lists = (s.slice_begin[part.slice_begin + part.slice_count] - columns_before) * kSliceRows;
    const tensor::Patch patch = tensor::patch_of(s, s.patch_of_slice[slice]);
    const tensor::RowAssembly<false, Real> assembly(s, patch, row);
    tensor::RowSums<Real> sums;
    for (std::uint32_t j = s.slice_begin[slice] + turn; turn < turns && j < s.slice_begin[slice + 1]; j += turns) {
      const std::size_t slot = std::size_t{j} * kSliceRows + lane;
      const std::uint32_t own = (j - columns_before) * kSliceRows + lane;
      const auto neighbour = assembly.neighbour(s.columns[slot]);
      Mat3<Real> edge = gather_edge(records, entries, list[own], list[own + 1]);
      if (part.adds != 0) edge += tensor::load_block(s.edges, slot);
      if (part.finishes != 0) edge = assembly.couple(slot, neighbour, edge, sums);
      tensor::store_block<Real>(s.edges, slot, edge);
    }
    const std::uint32_t own = lists + which * kSliceRows + lane;
    for (std::uint32_t i = list[own] + turn; turn < turns && i < list[own + 1]; i += turns) {
      const Real* force = records + entries[i];
      sums.force += Vec3<Real>(force[0], force[1], force[2]);
    }

    __syncthreads();  // the records have been read
    const SharedSums<Real> shared(aligned);
    shared.store(warp, lane, sums);
    __syncthreads();
    if (turn == 0) {
      for (std::uint32_t other = warp + part.slice_count; other < kWarps; other += part.slice_count) {
        shared.add_to(other, lane, sums);
      }
      if (part.adds != 0) sums.force += tensor::load3<Real>(s.rhs, row);
      if (part.finishes != 0) {
        assembly.finish(sums);
        if (s.external != nullptr) tensor::add_external_force(s, row);
      } else {
        tensor::store3<Real>(s.rhs, row, sums.force);
      }
    }
    __syncthreads();  // the sums have been read
  }
}

/// Rows that no tile finishes: of linear laws, or of more than one group.
template <bool HasConstant, class Real>
__global__ void __launch_bounds__(kFinishThreads) finish_slices(const __grid_constant__ SceneView<Real> s) {
  const std::uint32_t i = (blockIdx.x * kFinishThreads + threadIdx.x) / kWarp;
  if (i >= s.open_slice_count) return;
  const std::uint32_t slice = s.open_slices[i] / 2, row = slice * kSliceRows + threadIdx.x % kWarp;
  const bool begun = s.open_slices[i] % 2 != 0;
  const tensor::Patch patch = tensor::patch_of(s, s.patch_of_slice[slice]);
  const tensor::RowAssembly<HasConstant, Real> assembly(s, patch, row);
  tensor::RowSums<Real> sums;
  if (begun) sums.force = tensor::load3<Real>(s.rhs, row);
  tensor::for_each_slot(s, row, [&](std::size_t slot, std::uint32_t column) {
    const Mat3<Real> edge = begun ? tensor::load_block(s.edges, slot) : Mat3<Real>(Mat3<Real>::Zero());
    tensor::store_block<Real>(s.edges, slot, assembly.couple(slot, assembly.neighbour(column), edge, sums));
  });
  assembly.finish(sums);
  if (s.external != nullptr) tensor::add_external_force(s, row);
}

}  // namespace tensormass::backend::cuda
