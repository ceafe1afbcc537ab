#pragma once

#include <string_view>

#include "model/model.h"
#include "step/stages.h"
#include "tensormass/v1/control.pb.h"

namespace tensormass::step {

/// What a machine can do, for the expected rate of a scene.
struct MachineRates {
  double bytes_per_s = 0;
  double operations_per_s = 0;
  double stage_latency_s = 0;      ///< start of one stage
  double iteration_latency_s = 0;  ///< one exchange between patches
};
/// The plan of a scene: its stages, its buffers, what it does not model, and the rate to expect.
v1::SceneReport make_report(const model::Model& model, const MachineRates& machine);

}  // namespace tensormass::step
