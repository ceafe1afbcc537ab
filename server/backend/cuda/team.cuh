#pragma once

#include <cooperative_groups.h>

#include "core/scalar.h"

namespace tensormass::backend::cuda {

inline constexpr unsigned kMaxBlockThreads = 512;
inline constexpr unsigned kWarp = 32;

/// One thread block that runs one patch; the counterpart of backend/cpu/team.h. Reductions run in a fixed order.
class Team {
 public:
  template <class Real>
  using Lanes = SingleLane<Real>;

  __device__ std::uint32_t patch() const { return blockIdx.x; }
  __device__ bool leads() const { return blockIdx.x == 0 && threadIdx.x == 0; }
  __device__ bool leads_patch() const { return threadIdx.x == 0; }

  template <class Body>
  __device__ void for_each(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    for (std::uint32_t i = begin + threadIdx.x; i < end; i += blockDim.x) body(i);
  }
  template <std::uint32_t Width, class Body>
  __device__ void for_lanes(std::uint32_t begin, std::uint32_t end, Body&& body) const {
    static_assert(Width == 1);
    for_each(begin, end, body);
  }
  __device__ void sync() const { __syncthreads(); }

  template <class Real>
  __device__ Real patch_max(Real value) const {
    return reduce(value, [](Real a, Real b) { return maximum(a, b); });
  }
  template <class Real, std::size_t Count>
  __device__ void patch_sum(Real (&values)[Count]) const {
    for (Real& value : values) value = reduce(value, [](Real a, Real b) { return a + b; });
  }
  /// The smallest value with its index, the lowest index among equals; in every thread.
  template <class Real>
  __device__ void patch_argmin(Real& value, std::uint32_t& index) const {
    const Candidate<Real> best =
        reduce(Candidate<Real>{value, index}, [](const Candidate<Real>& a, const Candidate<Real>& b) {
          return b.value < a.value || (b.value == a.value && b.index < a.index) ? b : a;
        });
    value = best.value;
    index = best.index;
  }

  template <class Real, std::size_t Count>
  __device__ void exchange(Real (&sums)[Count], Real* scratch) {
    static_assert(Count <= 4);
    patch_sum(sums);
    if (threadIdx.x == 0) {
      for (std::size_t i = 0; i < Count; ++i) scratch[4 * blockIdx.x + i] = sums[i];
    }
    cooperative_groups::this_grid().sync();
    for (std::size_t i = 0; i < Count; ++i) {
      Real total = 0;
      for (std::uint32_t patch = threadIdx.x; patch < gridDim.x; patch += blockDim.x) {
        // Another block wrote it a moment ago: past the L1 cache.
        total += __ldcg(scratch + 4 * patch + i);
      }
      sums[i] = total;
    }
    patch_sum(sums);
  }

 private:
  template <class Real>
  struct Candidate {
    Real value;
    std::uint32_t index;
  };

  template <class T>
  __device__ static T shuffle_down(T value, unsigned offset) {
    return __shfl_down_sync(0xFFFFFFFFu, value, offset);
  }
  template <class Real>
  __device__ static Candidate<Real> shuffle_down(Candidate<Real> c, unsigned offset) {
    return {shuffle_down(c.value, offset), shuffle_down(c.index, offset)};
  }

  /// Over the block by warps; blockDim.x is a multiple of kWarp. The result is in every thread.
  template <class T, class Combine>
  __device__ T reduce(T value, Combine combine) const {
    __shared__ T partial[kMaxBlockThreads / kWarp];
    const unsigned warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp, warps = blockDim.x / kWarp;
    for (unsigned offset = kWarp / 2; offset > 0; offset /= 2) value = combine(value, shuffle_down(value, offset));
    __syncthreads();  // the partial results of the reduction before this one have been read
    if (lane == 0) partial[warp] = value;
    __syncthreads();
    T total = partial[0];
    for (unsigned other = 1; other < warps; ++other) total = combine(total, partial[other]);
    return total;
  }
};

}  // namespace tensormass::backend::cuda
