#include "backend/cuda/stage_kernels.h"

#include "backend/cuda/launch.cuh"
#include "step/run.h"

// TM_REAL, float or double, comes from the build.
namespace tensormass::backend::cuda {

template <class Real>
const void* stage_kernel(const model::Model& model, const step::Stage& stage) {
  const void* kernel = nullptr;
  step::with_stage(model, stage,
                   [&](auto type) { kernel = reinterpret_cast<const void*>(&run_stage<decltype(type), Real>); });
  return kernel;
}

template const void* stage_kernel<TM_REAL>(const model::Model&, const step::Stage&);

}  // namespace tensormass::backend::cuda
