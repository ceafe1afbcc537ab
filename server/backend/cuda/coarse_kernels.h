#pragma once

#include <cstddef>
#include <cstdint>

#include "solver/coarse_rows.h"
#include "view/scene.h"

/// The kernels of a solve with a coarse level (solver/coarse_rows.h), as pointers: coarse_kernels.cu is compiled once
/// for each type of Real. coarse_stages.cuh launches them.
namespace tensormass::backend::cuda {

/// What a kernel of the coarse level reads and writes.
template <class Real>
struct CoarseScene {
  view::SceneView<Real> scene;
  view::CoarseView<Real> coarse;
  solver::CoarseLists lists;
};

/// Threads of a block in the kernels that reduce or exchange.
inline constexpr unsigned kCoarseThreads = 512;

/// Shared memory of the solve [bytes]: W and Wᵀ, which would be read from L2 in each iteration otherwise. In double
/// precision they do not fit.
template <class Real>
constexpr std::size_t coarse_shared_bytes(std::uint32_t unknowns) {
  return sizeof(Real) == sizeof(float) ? 2 * std::size_t{solver::triangle_reals(unknowns)} * sizeof(Real) : 0;
}

/// Each kernel has a CoarseScene as its only argument.
struct CoarseKernels {
  const void* errors;  ///< e; blocks of any size, several for each patch
  const void* sums;    ///< R; likewise
  const void* losses;  ///< δ; likewise
  const void* matrix;  ///< E: a block for each pair of aggregates
  const void* invert;  ///< W: one block of kCoarseThreads
  /// Conjugate gradients: cooperative, a block of kCoarseThreads for each patch, coarse_shared_bytes of shared memory.
  const void* solve;
};
template <class Real>
CoarseKernels coarse_kernels();

}  // namespace tensormass::backend::cuda
