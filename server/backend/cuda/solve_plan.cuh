#pragma once

#include <algorithm>

#include <cuda_runtime.h>

#include "backend/cuda/resident_solve.cuh"
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

/// Largest number of rows of a patch, own and halo, for which direction and residual certainly stay in shared memory.
/// There is then also room for the tiles' q, if the matrix is streamed, and for PatchVolume.
inline std::uint32_t most_kept_rows(const cudaDeviceProp& device) {
  constexpr std::size_t kStaticBytes = 2048;  // most that the kernels declare themselves
  constexpr std::size_t kBytesPerRow = 2 * kStreamedBytesPerCell + kStreamedBytesPerVector;
  return static_cast<std::uint32_t>((device.sharedMemPerBlockOptin - kStaticBytes) / kBytesPerRow);
}

/// Chooses the first kernel that the largest patch fits: resident solves first, then the streamed one. As much as
/// possible of the matrix or of the vectors stays on the chip.
inline SolvePlan plan_solve(const matrix::Layout& layout) {
  const std::uint32_t most_locals = layout.largest_patch();
  std::uint32_t most_rows = 0, most_halo = 0;
  for (std::uint32_t p = 0; p < layout.patch_count; ++p) {
    const std::uint32_t rows = layout.patch_rows[p + 1] - layout.patch_rows[p];
    const std::uint32_t halo = layout.patch_halo[p + 1] - layout.patch_halo[p];
    most_rows = std::max(most_rows, rows);
    most_halo = std::max(most_halo, halo);
  }
  SolvePlan plan;
  // Smaller kernels first: fewer rows leave more registers to each thread, and so hold more of the matrix.
  const auto consider = [&]<unsigned Threads, int Rows, int Held>() {
    if (plan.kernel != nullptr || most_rows > Threads * Rows) return;
    const auto whole = reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, true>);
    const auto partly = reinterpret_cast<const void*>(&resident_solve<Threads, Rows, Held, false>);
    const std::size_t vectors = most_locals * kResidentBytesPerRow + most_halo * kResidentBytesPerHaloRow + 16;
    const std::size_t most = minimum(allow_all_shared_bytes(whole), allow_all_shared_bytes(partly));
    if (vectors > most || most_locals * 16 > 0xFFFF) return;
    std::uint32_t needed = 0;
    for (std::uint32_t p = 0; p < layout.patch_count; ++p) {
      std::uint32_t columns = 0;
      for (std::uint32_t i = layout.patch_rows[p] / view::kSliceRows; i < layout.patch_rows[p + 1] / view::kSliceRows;
           ++i) {
        const std::uint32_t width = layout.slice_begin[i + 1] - layout.slice_begin[i];
        columns += width > Held ? width - Held : 0;
      }
      needed = std::max(needed, columns);
    }
    const auto room = static_cast<std::uint32_t>((most - vectors) / kResidentBytesPerColumn);
    plan = {true, needed <= room ? whole : partly, Threads, 0, std::min(needed, room)};
    plan.shared_bytes = vectors + plan.argument * kResidentBytesPerColumn;
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
    plan.shared_bytes = std::min(most_rows, matrix::kTilesAtOnce * tile_rows) * kStreamedBytesPerCell;
    // Shared memory that stays free serves as L1 cache for the rest.
    std::size_t most = allow_all_shared_bytes(near);
    for (const void* kernel : {far, farthest}) most = std::min(most, allow_all_shared_bytes(kernel));
    const auto place = [&](StreamedVectors which, std::size_t bytes) {
      bytes = (bytes + 15) / 16 * 16;
      if (plan.shared_bytes + bytes > most) return;
      plan.shared_bytes += bytes;
      plan.argument |= which;
    };
    place(kNearDirection, most_locals * kStreamedBytesPerCell);
    place(kNearResidual, most_locals * kStreamedBytesPerVector);
    place(kNearSolution, most_rows * kStreamedBytesPerVector);
    const bool is_near = (plan.argument & kNearDirection) != 0;
    plan.kernel = most_locals > Neighbour<std::uint16_t>::kMostLocals ? farthest : is_near ? near : far;
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
