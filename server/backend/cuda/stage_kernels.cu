#include "backend/cuda/stage_kernels.h"

#include "backend/cuda/launch.cuh"
#include "backend/cuda/rows.cuh"
#include "backend/cuda/solve_team.cuh"
#include "step/run.h"

// TM_REAL, float or double, comes from the build.
namespace tensormass::backend::cuda {

template <class StageType, class Real>
__global__ void __launch_bounds__(kMaxBlockThreads)
    run_solve(const __grid_constant__ view::SceneView<Real> view,
              const __grid_constant__ view::ElementView<Real> elements) {
  SolveTeam<Real> team(view.solve.report);
  StageType::run(team, view, elements);
}

template <class Real>
const void* stage_kernel(const model::Model& model, const step::Stage& stage) {
  const void* kernel = nullptr;
  step::with_stage(model, stage, [&](auto type) {
    using Stage = decltype(type);
    if constexpr (Stage::kInfo.kind == step::StageKind::kSolve) {
      kernel = reinterpret_cast<const void*>(&run_solve<Stage, Real>);
    } else {
      kernel = reinterpret_cast<const void*>(&run_stage<Stage, Real>);
    }
  });
  return kernel;
}

template const void* stage_kernel<TM_REAL>(const model::Model&, const step::Stage&);

template <class Real>
const void* gather_kernel(int shape) {
  const void* kernel = nullptr;
  physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
    using Shape = typename decltype(tag)::Type;
    if (index == shape) kernel = reinterpret_cast<const void*>(&gather_rows<Shape, Real>);
  });
  return kernel;
}

template const void* gather_kernel<TM_REAL>(int);

}  // namespace tensormass::backend::cuda
