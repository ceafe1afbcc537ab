#pragma once

#include <algorithm>
#include <optional>

#include <cuda_runtime.h>

#include "backend/cuda/resident_solve.cuh"
#include "backend/cuda/solve_room.h"
#include "backend/cuda/streamed_solve.cuh"
#include "matrix/layout.h"

/// Chooses the fused solve of a scene, resident or streamed, and launches it.
namespace tensormass::backend::cuda {

struct SolvePlan {
  bool resident = false;
  const void* kernel = nullptr;
  unsigned threads = 0;
  std::size_t shared_bytes = 0;
  std::uint32_t argument = 0;  ///< column_capacity of resident_solve, near_vectors of streamed_solve

  /// Whether direction and residual stay on the chip, so that the scene needs no buffers for them.
  bool keeps_vectors() const {
    constexpr std::uint32_t kBoth = kNearDirection | kNearResidual;
    return resident || (argument & kBoth) == kBoth;
  }
};

/// Allows a kernel all shared memory of a block, and returns how much that is besides what the kernel declares itself
/// [bytes]. The limit belongs to the kernel and not to a launch. It must never be lowered, because scenes may load at
/// the same time.
inline std::size_t allow_all_shared_bytes(const void* kernel) {
  int device = 0, most = 0;
  cudaFuncAttributes attributes{};
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&most, cudaDevAttrMaxSharedMemoryPerBlockOptin, device);
  cudaFuncGetAttributes(&attributes, kernel);
  most -= static_cast<int>(attributes.sharedSizeBytes);
  cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, most);
  return static_cast<std::size_t>(most);
}

/// most_kept_rows of streamed_memory.h, of a device.
inline std::uint32_t most_kept_rows(const cudaDeviceProp& device) {
  return most_kept_rows(device.sharedMemPerBlockOptin);
}

/// Chooses the first kernel that the largest patch fits: resident solves first, then the streamed one. As much as
/// possible of the matrix or of the vectors stays on the chip.
inline SolvePlan plan_solve(const matrix::Layout& layout) {
  const PatchSizes most = largest_sizes(layout);
  SolvePlan plan;
  // Smaller kernels first: fewer rows leave more registers to each thread, and so hold more of the matrix.
  const auto consider = [&]<unsigned Threads, int Rows, int Held>() {
    if (plan.kernel != nullptr || most.rows > Threads * Rows) return;
    const auto whole = reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, true>);
    const auto partly = reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, false>);
    const std::size_t most_bytes = minimum(allow_all_shared_bytes(whole), allow_all_shared_bytes(partly));
    const std::optional<ResidentRoom> room = resident_room(layout, most, Held, most_bytes);
    if (room) plan = {true, room->whole ? whole : partly, Threads, room->bytes, room->column_capacity};
  };
  consider.template operator()<128, 1, 18>();
  consider.template operator()<256, 1, 18>();
  consider.template operator()<384, 1, 12>();
  // Two rows a thread: half as many warps must wait for each other.
  consider.template operator()<224, 2, 8>();
  consider.template operator()<kMostResidentRows / 2, 2, 8>();
  if (plan.kernel == nullptr) {
    const auto near = reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint16_t, true>);
    const auto far = reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint16_t, false>);
    const auto farthest = reinterpret_cast<const void*>(&streamed_solve<kStreamedThreads, std::uint32_t, false>);
    plan.threads = kStreamedThreads;
    const std::uint32_t tile_rows = layout.tile_rows != 0 ? layout.tile_rows : matrix::kMostTileRows;
    std::size_t most_bytes = allow_all_shared_bytes(near);
    for (const void* kernel : {far, farthest}) most_bytes = std::min(most_bytes, allow_all_shared_bytes(kernel));
    const StreamedRoom room = streamed_room(most.rows, most.locals, tile_rows, most_bytes);
    plan.shared_bytes = room.bytes;
    plan.argument = room.near_vectors;
    const bool is_near = (plan.argument & kNearDirection) != 0;
    plan.kernel = most.locals > Neighbour<std::uint16_t>::kMostLocals ? farthest : is_near ? near : far;
  }
  return plan;
}

inline cudaError_t launch_solve(const SolvePlan& plan, const view::SceneView<float>& view, cudaStream_t stream) {
  std::uint32_t argument = plan.argument;
  void* arguments[] = {const_cast<view::SceneView<float>*>(&view), &argument};
  return cudaLaunchCooperativeKernel(plan.kernel, view.patches.patch_count, plan.threads, arguments, plan.shared_bytes,
                                     stream);
}

}  // namespace tensormass::backend::cuda
