#pragma once

#include <cstdint>

#include "backend/cuda/exchange_cells.h"
#include "backend/cuda/stop.cuh"
#include "backend/cuda/team.cuh"
#include "view/scene.h"

/// Exchange of data between the patches of one solve, while it runs, without a barrier of the grid.
///
///   patch A                                  patch B
///   begin()                                  begin()
///   publish_row, publish_sums ──> cells ──>  wait_for_rows, wait_for_sums
///                             <── cells ──   ...
///
///   cell   three floats and a tag, 16 bytes; read and written as one
///   tag    number of the exchange
///   q      Â p of the solve (solver/conjugate_gradients.h); the sums are p·q, q·q and r·r
///
/// 1. Data carry their own flag, the tag. A reader needs no fence, and it waits only for the cells that it needs.
/// 2. Cells have two buffers, chosen by the parity of the tag. A patch writes a buffer again two exchanges later.
///    By then every patch has read it, because each has published sums since.
/// 3. Tags continue from solve to solve (SolveView::exchange_tags). Otherwise an old cell would pass for a new one.
/// 4. All patches of a scene must run at the same time, or a patch would wait for ever.
namespace tensormass::backend::cuda {

/// A vector in a cell of four floats, and back. All four are written: memory that is only partly written must be read
/// first.
__device__ inline Vec3<float> three_of(const float4& cell) { return {cell.x, cell.y, cell.z}; }
__device__ inline float4 cell_of(const Vec3<float>& v) { return {v[0], v[1], v[2], 0}; }

/// One patch's end of the exchange. All threads of its block have a copy.
class Exchange {
 public:
  struct Cell {
    float x, y, z;
    std::uint32_t tag;
  };

  __device__ Exchange(const view::SceneView<float>& s, std::uint32_t patch)
      : cells_(reinterpret_cast<Cell*>(s.solve.product)),
        sums_(reinterpret_cast<Cell*>(s.solve.reduction)),
        tags_(s.solve.exchange_tags),
        report_(s.solve.report),
        rows_(s.patches.row_count),
        patches_(s.patches.patch_count),
        patch_(patch),
        tag_(tags_[patch]) {}

  /// Starts the next exchange. All threads must call it.
  __device__ void begin() { ++tag_; }
  /// Stores the tag for the next solve. One thread must call it, after the last exchange.
  __device__ void remember() const { tags_[patch_] = tag_; }

  /// Publishes three floats for a row of the patch.
  __device__ void publish_row(std::uint32_t row, float x, float y, float z) const {
    store(row_cell(cells_, rows_, tag_, row), {x, y, z, tag_});
  }

  /// Cells of the rows from `first` on in this exchange, four floats each.
  __device__ float* rows(std::uint32_t first) const { return &row_cell(cells_, rows_, tag_, first)->x; }

  /// The cell of a row in this exchange. The thread must know that it has been published.
  __device__ Cell row(std::uint32_t row) const { return load(row_cell(cells_, rows_, tag_, row)); }

  /// Whether the solve must end (stop.cuh), in the patch that tells the others by its sums.
  __device__ bool must_end(std::uint32_t iteration) const { return patch_ == 0 && is_end_asked(report_, iteration); }
  /// Publishes the three sums of the patch.
  __device__ void publish_sums(float x, float y, float z) const { store(sums_of(patch_), {x, y, z, tag_}); }
  /// Waits for the sums of the patches first, first + stride, .. as wait_for_rows does.
  template <int Count>
  __device__ void wait_for_sums(std::uint32_t first, std::uint32_t stride, std::uint32_t count,
                                Cell (&cells)[Count]) const {
    wait_for(
        first, stride, count, [=, this](int i) { return sums_of(first + i * stride); }, cells);
  }
  /// Waits for the cells of some rows and reads them, all at once: i counts those of first, first + stride, .. that are
  /// below `count`, at most Count.
  ///
  ///   index(i) -> row   the row to wait for
  template <int Count, class Index>
  __device__ void wait_for_rows(std::uint32_t first, std::uint32_t stride, std::uint32_t count, const Index& index,
                                Cell (&cells)[Count]) const {
    const Cell* from = row_cell(cells_, rows_, tag_, 0);
    wait_for(
        first, stride, count, [&](int i) { return from + index(i); }, cells);
  }

  /// Sums over groups of `Lanes` lanes, a power of two. Each combination is commutative, so all lanes get the same
  /// bits.
  template <unsigned Lanes = kWarp>
  __device__ static Cell sum_lanes(Cell value) {
    for (unsigned mask = Lanes / 2; mask > 0; mask /= 2) {
      value.x += exchange_lanes(value.x, mask);
      value.y += exchange_lanes(value.y, mask);
      value.z += exchange_lanes(value.z, mask);
    }
    return value;
  }

 private:
  __device__ static float exchange_lanes(float value, unsigned mask) {
    return __shfl_xor_sync(0xFFFFFFFFu, value, mask);
  }
  __device__ static void store(Cell* cell, const Cell& value) {
    asm volatile(
        "{ .reg .b128 q; .reg .b64 lo, hi; mov.b64 lo, {%1, %2}; mov.b64 hi, {%3, %4}; mov.b128 q, {lo, hi};"
        " st.relaxed.gpu.global.b128 [%0], q; }" ::"l"(cell),
        "r"(__float_as_uint(value.x)), "r"(__float_as_uint(value.y)), "r"(__float_as_uint(value.z)), "r"(value.tag)
        : "memory");
  }
  __device__ static Cell load(const Cell* cell) {
    std::uint32_t x, y, z, tag;
    asm volatile(
        "{ .reg .b128 q; .reg .b64 lo, hi; ld.relaxed.gpu.global.b128 q, [%4]; mov.b128 {lo, hi}, q;"
        " mov.b64 {%0, %1}, lo; mov.b64 {%2, %3}, hi; }"
        : "=r"(x), "=r"(y), "=r"(z), "=r"(tag)
        : "l"(cell)
        : "memory");
    return {__uint_as_float(x), __uint_as_float(y), __uint_as_float(z), tag};
  }
  __device__ Cell* sums_of(std::uint32_t patch) const { return sum_cell(sums_, patches_, tag_, patch); }
  template <int Count, class PlaceOf>
  __device__ void wait_for(std::uint32_t first, std::uint32_t stride, std::uint32_t count, const PlaceOf& place_of,
                           Cell (&cells)[Count]) const {
    const Cell* place[Count];
    cells_to_wait_for(first, stride, count, place_of, place);
    bool arrived;
    do {
      arrived = true;
#pragma unroll
      for (int i = 0; i < Count; ++i) cells[i] = load(place[i]);
#pragma unroll
      for (int i = 0; i < Count; ++i) arrived = arrived && cells[i].tag == tag_;
    } while (!arrived);
  }

  Cell* const cells_;
  Cell* const sums_;
  std::uint32_t* const tags_;
  const view::SolveReport<float>* const report_;
  const std::uint32_t rows_, patches_, patch_;
  std::uint32_t tag_;
};

}  // namespace tensormass::backend::cuda
