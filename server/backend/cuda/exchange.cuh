#pragma once

#include <cstdint>

#include "backend/cuda/team.cuh"
#include "view/scene.h"

namespace tensormass::backend::cuda {

/// What patches of one solve tell each other while it runs: q = Â p of their rows and three sums, without a barrier of
/// the grid.
///
/// A cell is three floats and the number of the exchange, written and read as one: data carry their own flag, so that
/// a reader needs no fence and waits for what it needs only. Cells come in two buffers by the parity of that number. A
/// patch writes a buffer again two exchanges later, and by then every patch has read it: it has published sums since.
/// The numbers go on from solve to solve (`tags`), or an old cell would pass for a new one.
///
/// All patches of a scene must run at once.
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
        rows_(s.patches.row_count),
        patches_(s.patches.patch_count),
        patch_(patch),
        tag_(tags_[patch]) {}

  /// The next exchange begins.
  __device__ void begin() { ++tag_; }
  /// After the last one; by one thread.
  __device__ void remember() const { tags_[patch_] = tag_; }

  __device__ void publish_row(std::uint32_t row, float x, float y, float z) const {
    store(cells_ + std::size_t{tag_ & 1} * rows_ + row, {x, y, z, tag_});
  }

  /// The cells of rows in this exchange, four floats each.
  __device__ float* rows(std::uint32_t first) const { return &(cells_ + std::size_t{tag_ & 1} * rows_ + first)->x; }

  /// What has been published of a row, and waited for, in this exchange.
  __device__ Cell row(std::uint32_t row) const { return load(cells_ + std::size_t{tag_ & 1} * rows_ + row); }

  __device__ void publish_sums(float x, float y, float z) const { store(sums_of(patch_), {x, y, z, tag_}); }
  /// Sums of patches first, first + stride, .., as wait_for_rows.
  template <int Count>
  __device__ void wait_for_sums(std::uint32_t first, std::uint32_t stride, std::uint32_t count,
                                Cell (&cells)[Count]) const {
    wait_for(
        first, stride, count, [=, this](int i) { return sums_of(first + i * stride); }, cells);
  }
  /// Cells of the rows index(0), index(1), .. that a thread waits for, as many of first, first + stride, .. as are
  /// below `count`, at most Count; they are under way at once.
  template <int Count, class Index>
  __device__ void wait_for_rows(std::uint32_t first, std::uint32_t stride, std::uint32_t count, const Index& index,
                                Cell (&cells)[Count]) const {
    const Cell* from = cells_ + std::size_t{tag_ & 1} * rows_;
    wait_for(
        first, stride, count, [&](int i) { return from + index(i); }, cells);
  }

  /// Over groups of `Lanes` lanes, a power of two; each combination is commutative, so that all lanes have the same
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
  __device__ Cell* sums_of(std::uint32_t patch) const {
    return sums_ + (std::size_t{tag_ & 1} * patches_ + patch) * (view::kPatchSums / 4);
  }
  template <int Count, class PlaceOf>
  __device__ void wait_for(std::uint32_t first, std::uint32_t stride, std::uint32_t count, const PlaceOf& place_of,
                           Cell (&cells)[Count]) const {
    const Cell* place[Count];
#pragma unroll
    for (int i = 0; i < Count; ++i) {
      // Beyond the end, the first one again.
      place[i] = first + i * stride < count ? place_of(i) : place_of(0);
    }
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
  const std::uint32_t rows_, patches_, patch_;
  std::uint32_t tag_;
};

}  // namespace tensormass::backend::cuda
