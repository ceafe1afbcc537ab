#pragma once

#include <cstddef>

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

/// Each kernel has a CoarseScene as its only argument.
struct CoarseKernels {
  const void* errors;  ///< e; blocks of any size, several for each patch
  const void* sums;    ///< R; likewise
  const void* losses;  ///< δ; likewise
  const void* matrix;  ///< E: a block for each pair of aggregates
  const void* invert;  ///< W: one block, with coarse_scratch(n) doubles of shared memory
  const void* solve;   ///< conjugate gradients: cooperative, a block of kCoarseThreads for each patch
};
template <class Real>
CoarseKernels coarse_kernels();

}  // namespace tensormass::backend::cuda
