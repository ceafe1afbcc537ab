#pragma once

#include "backend/cuda/team.cuh"
#include "view/scene.h"

namespace tensormass::backend::cuda {

/// The kernel of every stage. Fewer threads leave more registers to each.
template <class StageType, class Real, unsigned MaxThreads = kMaxBlockThreads>
__global__ void __launch_bounds__(MaxThreads) run_stage(const __grid_constant__ view::SceneView<Real> view,
                                                        const __grid_constant__ view::ElementView<Real> elements) {
  Team team;
  StageType::run(team, view, elements);
}

}  // namespace tensormass::backend::cuda
