#pragma once

#include <cooperative_groups.h>

#include "backend/cuda/blocks.h"
#include "core/strided.h"

/// The team of a GPU: the interface between a stage and the thread blocks that run it.
///
///   grid:       x = patch           y = part of the patch, only in stages that may have several
///   block:      the threads that share a patch's loops
///   for_each    strides over all threads of the patch's blocks
///   reductions  lanes of a warp (shuffles) ──> shared memory ──> all threads of the block
///   exchange    reduction, then a barrier of the grid, then sums over all patches
///
/// 1. Stages are written once, against this interface. backend/cpu/team.h implements it for one thread.
/// 2. A stage that reduces has one block a patch, or reduces over each part separately.
/// 3. Reductions run in a fixed order, so that results repeat bitwise.
namespace tensormass::backend::cuda {

/// The thread blocks that run one patch.
class Team {
 public:
  template <class Real>
  using Lanes = SingleLane<Real>;

  __device__ std::uint32_t patch() const { return blockIdx.x; }
  __device__ bool leads() const { return blockIdx.x == 0 && threadIdx.x == 0; }
  __device__ bool leads_patch() const { return threadIdx.x == 0; }
  /// Index of this block among those that share the patch.
  __device__ std::uint32_t part() const { return blockIdx.y; }
  __device__ std::uint32_t parts() const { return gridDim.y; }

  /// AtOnce: bodies that run side by side, if they only read.
  template <int AtOnce = 1, class Body>
  __device__ void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    const std::uint32_t stride = blockDim.x * gridDim.y;
#pragma unroll AtOnce
    for (std::uint32_t i = begin + blockIdx.y * blockDim.x + threadIdx.x; i < end; i += stride) body(i);
  }
  /// Calls use(i, read(i)) for all items; up to AtOnce items are read before the first is used.
  template <int AtOnce, class Read, class Use>
  __device__ void for_each(std::uint32_t begin, std::uint32_t end, const Read& read, const Use& use) const {
    const std::uint32_t first = begin + blockIdx.y * blockDim.x + threadIdx.x;
    for_each_strided<AtOnce>(first, end, blockDim.x * gridDim.y, read, use);
  }
  template <std::uint32_t Width, int AtOnce = 1, class Body>
  __device__ void for_lanes(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    static_assert(Width == 1);
    for_each<AtOnce>(begin, end, body);
  }
  __device__ void sync() const { __syncthreads(); }

  template <class Real>
  __device__ Real patch_max(Real value) const {
    return reduce(value, [](Real a, Real b) { return maximum(a, b); });
  }
  template <class Real, std::size_t Count>
  __device__ void patch_sum(Real (&values)[Count]) const {
    const Sums<Real, Count> total = reduce(gather(values), add<Real, Count>);
    for (std::size_t i = 0; i < Count; ++i) values[i] = total.value[i];
  }
  template <class Real, std::size_t MaximumCount, std::size_t SumCount>
  __device__ void patch_reduce(Real (&maxima)[MaximumCount], Real (&sums)[SumCount]) const {
    sync();  // the results of the last reduction have been read
    begin_reduce(maxima, sums);
    sync();
    end_reduce(maxima, sums);
  }
  /// patch_reduce in two halves, at most once in a kernel. The block must synchronize between them. Only threads that
  /// need the results call the second.
  template <class Real, std::size_t MaximumCount, std::size_t SumCount>
  __device__ void begin_reduce(const Real (&maxima)[MaximumCount], const Real (&sums)[SumCount]) const {
    using Both = MaximaAndSums<Real, MaximumCount, SumCount>;
    const Both of_warp = reduce_warp(Both{gather(maxima), gather(sums)}, Both::combine);
    if (threadIdx.x % kWarp == 0) partial<Both>(threadIdx.x / kWarp) = of_warp;
  }
  template <class Real, std::size_t MaximumCount, std::size_t SumCount>
  __device__ void end_reduce(Real (&maxima)[MaximumCount], Real (&sums)[SumCount]) const {
    using Both = MaximaAndSums<Real, MaximumCount, SumCount>;
    Both total = partial<Both>(0);
#pragma unroll 1
    for (unsigned warp = 1; warp < blockDim.x / kWarp; ++warp) total = Both::combine(total, partial<Both>(warp));
    for (std::size_t i = 0; i < MaximumCount; ++i) maxima[i] = total.maxima.value[i];
    for (std::size_t i = 0; i < SumCount; ++i) sums[i] = total.sums.value[i];
  }
  /// Replaces value and index by the smallest value and its index, the lowest index among equals, in every thread.
  template <class Real>
  __device__ void patch_argmin(Real& value, std::uint32_t& index) const {
    const Candidate<Real> best =
        reduce(Candidate<Real>{value, index}, [](const Candidate<Real>& a, const Candidate<Real>& b) {
          return b.value < a.value || (b.value == a.value && b.index < a.index) ? b : a;
        });
    value = best.value;
    index = best.index;
  }

  /// Stores a value and returns the one before. Other threads may do so at the same place at the same time.
  __device__ static std::uint32_t replace(std::uint32_t* place, std::uint32_t value) {
    return atomicExch(place, value);
  }
  /// Makes everything that a patch wrote before visible to all patches. Only for stages that exchange.
  __device__ void meet() const { cooperative_groups::this_grid().sync(); }
  /// Replaces `sums` by their sums over all patches, and makes everything that a patch wrote before visible to all.
  /// scratch: [patch_count, 4]; must differ from that of the previous exchange.
  template <class Real, std::size_t Count>
  __device__ void exchange(Real (&sums)[Count], Real* scratch) {
    static_assert(Count <= 4);
    patch_sum(sums);
    if (threadIdx.x == 0) {
      for (std::size_t i = 0; i < Count; ++i) scratch[4 * blockIdx.x + i] = sums[i];
    }
    cooperative_groups::this_grid().sync();
    // Every warp adds up all patches in the same order, which needs no barrier of the block. Other blocks have just
    // written, so the reads bypass the L1 cache.
    for (Real& sum : sums) sum = 0;
    for (std::uint32_t patch = threadIdx.x % kWarp; patch < gridDim.x; patch += kWarp) {
      for (std::size_t i = 0; i < Count; ++i) sums[i] += __ldcg(scratch + 4 * patch + i);
    }
    const Sums<Real, Count> total = reduce_warp(gather(sums), add<Real, Count>);
    for (std::size_t i = 0; i < Count; ++i) sums[i] = total.value[i];
  }

 private:
  template <class Real>
  struct Candidate {
    Real value;
    std::uint32_t index;
  };
  template <class Real, std::size_t Count>
  struct Sums {
    Real value[Count];
  };

  template <class Real, std::size_t MaximumCount, std::size_t SumCount>
  struct MaximaAndSums {
    Sums<Real, MaximumCount> maxima;
    Sums<Real, SumCount> sums;

    __device__ static MaximaAndSums combine(const MaximaAndSums& a, const MaximaAndSums& b) {
      MaximaAndSums both{a.maxima, add(a.sums, b.sums)};
      for (std::size_t i = 0; i < MaximumCount; ++i)
        both.maxima.value[i] = maximum(both.maxima.value[i], b.maxima.value[i]);
      return both;
    }
  };

  template <class Real, std::size_t Count>
  __device__ static Sums<Real, Count> gather(const Real (&values)[Count]) {
    Sums<Real, Count> sums;
    for (std::size_t i = 0; i < Count; ++i) sums.value[i] = values[i];
    return sums;
  }
  template <class Real, std::size_t Count>
  __device__ static Sums<Real, Count> add(const Sums<Real, Count>& a, const Sums<Real, Count>& b) {
    Sums<Real, Count> sums;
    for (std::size_t i = 0; i < Count; ++i) sums.value[i] = a.value[i] + b.value[i];
    return sums;
  }

  template <class T>
  __device__ static T shuffle(T value, unsigned mask) {
    return __shfl_xor_sync(0xFFFFFFFFu, value, mask);
  }
  template <class Real>
  __device__ static Candidate<Real> shuffle(const Candidate<Real>& c, unsigned mask) {
    return {shuffle(c.value, mask), shuffle(c.index, mask)};
  }
  template <class Real, std::size_t Count>
  __device__ static Sums<Real, Count> shuffle(const Sums<Real, Count>& sums, unsigned mask) {
    Sums<Real, Count> out;
    for (std::size_t i = 0; i < Count; ++i) out.value[i] = shuffle(sums.value[i], mask);
    return out;
  }

  template <class Real, std::size_t MaximumCount, std::size_t SumCount>
  __device__ static MaximaAndSums<Real, MaximumCount, SumCount> shuffle(
      const MaximaAndSums<Real, MaximumCount, SumCount>& both, unsigned mask) {
    return {shuffle(both.maxima, mask), shuffle(both.sums, mask)};
  }

  /// Reduces over a warp. The result is in every lane, the same to the last bit, because each combination is
  /// commutative.
  template <class T, class Combine>
  __device__ static T reduce_warp(T value, Combine combine) {
    for (unsigned mask = kWarp / 2; mask > 0; mask /= 2) value = combine(value, shuffle(value, mask));
    return value;
  }
  /// Reduces over the block, whose size must be a multiple of kWarp. The result is in every thread.
  template <class T, class Combine>
  __device__ T reduce(T value, Combine combine) const {
    const unsigned warps = blockDim.x / kWarp;
    value = reduce_warp(value, combine);
    __syncthreads();  // the partial results of the last reduction have been read
    if (threadIdx.x % kWarp == 0) partial<T>(threadIdx.x / kWarp) = value;
    __syncthreads();
    T total = partial<T>(0);
    for (unsigned other = 1; other < warps; ++other) total = combine(total, partial<T>(other));
    return total;
  }
  /// The results of the warps, in shared memory: one array for all reductions of a type.
  template <class T>
  __device__ static T& partial(unsigned warp) {
    __shared__ T partials[kMaxBlockThreads / kWarp];
    return partials[warp];
  }
};

}  // namespace tensormass::backend::cuda
