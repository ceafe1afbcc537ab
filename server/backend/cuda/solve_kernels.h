#pragma once

#include <cstdint>
#include <span>

/// The kernels of the fused solves, as pointers: resident_solve.cu and streamed_solve.cu compile them.
namespace tensormass::backend::cuda {

/// resident_solve (resident_solve.cuh) for one size of patches.
struct ResidentKernel {
  unsigned threads;
  std::uint32_t rows, held;
  const void* whole;   ///< Whole = true
  const void* partly;  ///< Whole = false
};
/// Returns the kernels from the smallest patches to the largest. Fewer rows leave more registers to each thread, and so
/// hold more of the matrix.
/// linked: those for a scene with links (link_blocks.cuh).
std::span<const ResidentKernel> resident_kernels(bool linked);

/// streamed_solve (streamed_solve.cuh). Its signature: the scene's view and near_vectors.
struct StreamedKernels {
  unsigned threads;
  const void* near;      ///< p in shared memory
  const void* far;       ///< p in device memory
  const void* farthest;  ///< likewise, for patches with more locals than short_locals
  std::uint32_t short_locals;
};
StreamedKernels streamed_kernels();

}  // namespace tensormass::backend::cuda
