#pragma once

#include <string_view>

#include "model/model.h"
#include "tensormass/v1/control.pb.h"

namespace tensormass::model {

/// A stage in words, for the plan and for profiles.
struct StageText {
  std::string_view name;
  std::string_view reads;
  std::string_view writes;
};
StageText text(StageKind kind);

/// What a machine does, for the rate that is to be expected of a scene.
struct MachineRates {
  double bytes_per_s = 0;
  double operations_per_s = 0;
  double stage_latency_s = 0;      ///< start of one stage
  double iteration_latency_s = 0;  ///< one exchange between patches
};
/// What a scene computes, what it holds and what it leaves out.
v1::SceneReport make_report(const Model& model, const MachineRates& machine);

}  // namespace tensormass::model
