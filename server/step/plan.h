#pragma once

#include <string_view>

#include "model/model.h"
#include "step/stages.h"

namespace tensormass::v1 {
class SceneReport;
}

namespace tensormass::step {

/// Speed of a machine, for the expected rate of a scene.
struct MachineRates {
  double bytes_per_s = 0;
  double operations_per_s = 0;
  double stage_latency_s = 0;      ///< start of one stage
  double iteration_latency_s = 0;  ///< one exchange between patches
};
/// Returns the plan of a scene: its stages, its buffers, the effects that it does not model, and the expected rate.
v1::SceneReport make_report(const model::Model& model, const MachineRates& machine);

}  // namespace tensormass::step
