#pragma once

#include <bit>

#include "backend/cuda/exchange.cuh"

/// Sums over all patches of a solve.
///
///   each warp ── sum of its lanes ──> shared memory ── last warp of the block ──> publish the patch's sums
///                                                                                    │ (exchange.cuh)
///   all threads <── barrier ── total in shared memory <── add all patches' sums <────┘
///
/// 1. Only the last warp waits for the other patches' sums. The other warps wait for the halo meanwhile.
/// 2. Sums run in a fixed order, so every patch gets the same total to the last bit.
namespace tensormass::backend::cuda {

/// Place of the sums in shared memory, one for a block of `Threads` threads.
template <unsigned Threads>
class PatchSums {
 public:
  /// Sums `own` over all threads of all patches. All threads must call it and then meet at a barrier.
  /// iteration: of the solve. If the host asks for its end (stop.cuh), the third sum is not a number.
  __device__ void exchange(const Exchange& exchange, std::uint32_t patches, Exchange::Cell own,
                           std::uint32_t iteration) {
    const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
    own = Exchange::sum_lanes(own);
    if (lane == 0) warps_[warp] = own;
    __syncthreads();
    if (warp + 1 < kWarps) return;
    constexpr unsigned kLanes = std::bit_ceil(kWarps);
    const Exchange::Cell mine =
        Exchange::sum_lanes<kLanes>(lane % kLanes < kWarps ? warps_[lane % kLanes] : Exchange::Cell{0, 0, 0, 0});
    if (lane == 0) {
      const bool ends = exchange.must_end(iteration);
      exchange.publish_sums(mine.x, mine.y, ends ? std::numeric_limits<float>::quiet_NaN() : mine.z);
    }
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
  /// The sums over all patches. Valid after the barrier that follows exchange().
  __device__ Exchange::Cell total() const { return total_; }

 private:
  static constexpr unsigned kWarps = Threads / kWarp;
  static_assert(kWarps <= kWarp);
  Exchange::Cell warps_[kWarps];
  Exchange::Cell total_;
};

}  // namespace tensormass::backend::cuda
