#pragma once

#include <algorithm>
#include <optional>

#include <cuda_runtime.h>

#include "backend/cuda/link_blocks.cuh"
#include "backend/cuda/solve_kernels.h"
#include "backend/cuda/solve_room.h"
#include "matrix/layout.h"
#include "view/scene.h"

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
/// linked: the scene has links. Whether a patch fits a resident solve does not depend on it.
inline SolvePlan plan_solve(const matrix::Layout& layout, bool linked) {
  const PatchSizes most = largest_sizes(layout);
  for (const ResidentKernel& kernel : resident_kernels(linked)) {
    if (most.rows > kernel.threads * kernel.rows) continue;
    const std::size_t most_bytes =
        std::min(allow_all_shared_bytes(kernel.whole), allow_all_shared_bytes(kernel.partly));
    const std::optional<ResidentRoom> room = resident_room(layout, most, kernel.held, most_bytes);
    if (!room) continue;
    return {true, room->whole ? kernel.whole : kernel.partly, kernel.threads, room->bytes, room->column_capacity};
  }
  const StreamedKernels kernels = streamed_kernels();
  const std::uint32_t tile_rows = layout.tile_rows != 0 ? layout.tile_rows : matrix::kMaxTileRows;
  std::size_t most_bytes = allow_all_shared_bytes(kernels.near);
  for (const void* kernel : {kernels.far, kernels.farthest}) {
    most_bytes = std::min(most_bytes, allow_all_shared_bytes(kernel));
  }
  const StreamedRoom room = streamed_room(most.rows, most.locals, tile_rows, most_bytes);
  const bool is_near = (room.near_vectors & kNearDirection) != 0;
  const void* kernel = most.locals > kernels.short_locals ? kernels.farthest : is_near ? kernels.near : kernels.far;
  return {false, kernel, kernels.threads, room.bytes, room.near_vectors};
}

/// room: of a resident solve.
inline cudaError_t launch_solve(const SolvePlan& plan, const view::SceneView<float>& view, const LinkRoom& room,
                                cudaStream_t stream) {
  std::uint32_t argument = plan.argument;
  void* arguments[] = {const_cast<view::SceneView<float>*>(&view), &argument, const_cast<LinkRoom*>(&room)};
  return cudaLaunchCooperativeKernel(plan.kernel, view.patches.patch_count, plan.threads, arguments, plan.shared_bytes,
                                     stream);
}

}  // namespace tensormass::backend::cuda
