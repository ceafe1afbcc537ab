#pragma once

#include "model/model.h"
#include "step/stages.h"

/// The kernels of all stages, except those over elements (elements.h) and the fused solves (solve_kernels.h).
///
/// Kernels are compiled in files without the host's code, and the host gets them as pointers. So a change of the host's
/// code compiles no kernel, and kernels compile in parallel.
namespace tensormass::backend::cuda {

/// Returns the kernel of a stage, with the signature of run_stage (launch.cuh). stage_kernels.cu is compiled once for
/// each type of Real.
template <class Real>
const void* stage_kernel(const model::Model& model, const step::Stage& stage);

/// Returns gather_rows (rows.cuh), a block a slice, for a shape.
template <class Real>
const void* gather_kernel(int shape);

}  // namespace tensormass::backend::cuda
