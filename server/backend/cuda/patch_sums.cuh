#pragma once

#include <bit>

#include "backend/cuda/exchange.cuh"

namespace tensormass::backend::cuda {

/// The sums of all patches. Each warp leaves its own in shared memory; the last warp of the block adds them up,
/// publishes them, waits for those of all patches and adds those up, while the other warps wait for the halo. In a
/// fixed order, and so the same to the last bit in every patch.
template <unsigned Threads>
class PatchSums {
 public:
  /// By all threads.
  __device__ void exchange(const Exchange& exchange, std::uint32_t patches, Exchange::Cell own) {
    const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
    own = Exchange::sum_lanes(own);
    if (lane == 0) warps_[warp] = own;
    __syncthreads();
    if (warp + 1 < kWarps) return;
    constexpr unsigned kLanes = std::bit_ceil(kWarps);
    const Exchange::Cell mine =
        Exchange::sum_lanes<kLanes>(lane % kLanes < kWarps ? warps_[lane % kLanes] : Exchange::Cell{0, 0, 0, 0});
    if (lane == 0) exchange.publish_sums(mine.x, mine.y, mine.z);
    Exchange::Cell sum{0, 0, 0, 0};
    constexpr std::uint32_t kAtOnce = 5;  // 160 patches: one a multiprocessor
    for (std::uint32_t first = lane; first < patches; first += kAtOnce * kWarp) {
      Exchange::Cell cells[kAtOnce];
      exchange.wait_for_sums(first, kWarp, patches, cells);
      for (std::uint32_t i = 0; i < kAtOnce; ++i) {
        if (first + i * kWarp >= patches) break;
        sum.x += cells[i].x;
        sum.y += cells[i].y;
        sum.z += cells[i].z;
      }
    }
    __syncwarp();
    sum = Exchange::sum_lanes(sum);
    if (lane == 0) total_ = sum;
  }
  /// After a barrier.
  __device__ Exchange::Cell total() const { return total_; }

 private:
  static constexpr unsigned kWarps = Threads / kWarp;
  static_assert(kWarps <= kWarp);
  Exchange::Cell warps_[kWarps];
  Exchange::Cell total_;
};

}  // namespace tensormass::backend::cuda
