#pragma once

#include "tensormass/v1/scene.pb.h"

namespace tensormass::control {

/// What a load will need, estimated from the counts in its message. Doubles, because a message of a few bytes may ask
/// for more than 64 bits hold.
struct SceneCost {
  double elements = 0;
  double nodes = 0;
  double bytes = 0;      ///< at the peak of the load
  double compile_s = 0;  ///< on one core of 2024
};

/// Allocates nothing that grows with the scene. The numbers of a shape were measured on grids (docs/decisions/
/// strangers.md). They are upper bounds there, and within a factor of two for other meshes.
SceneCost estimate_cost(const v1::Scene& scene);

}  // namespace tensormass::control
