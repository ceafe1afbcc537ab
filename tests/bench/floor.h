#pragma once

#include "step/stages.h"

namespace tensormass::bench {

/// Returns the bytes that a step must move at least: those of its stages, with every iteration of the solve. Leaves out
/// stages that run now and then. Stages cost what step/stages.h says, and a fused solve costs what the stages cost that
/// it replaces.
inline double floor_bytes(const model::Model& model) {
  const auto bytes = [&model](step::StageKind kind) { return step::cost(model, {&step::info(kind)}).bytes; };
  double sum = 0;
  for (const step::Stage& stage : step::list_stages(model)) {
    const step::StageInfo& info = *stage.info;
    if (!step::runs_every_step(info)) continue;
    sum += step::cost(model, stage).bytes * (step::costs_an_iteration(info) ? model.cg_max_iterations : 1);
    if (info.scope == step::Scope::kFusedOnDevice)
      sum += bytes(step::StageKind::kScaleEdges) + bytes(step::StageKind::kAdvance);
    if (info.kind == step::StageKind::kResidentSolve) sum += bytes(step::StageKind::kFactorize);
  }
  return sum;
}

}  // namespace tensormass::bench
