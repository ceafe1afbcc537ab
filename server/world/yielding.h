#pragma once

#include <span>

#include "backend/backend.h"
#include "model/model.h"
#include "world/tool.h"

namespace tensormass::world {

/// Returns what holds a scalpel along the direction in which it cuts.
///
///   limit       Σ toughness · length of the points that hold tissue [N]
///   1 / k       thickness / limit + 1 / (E · length): the springs of its points, and the tissue that bulges before
///               them. E: the largest of the body's surface; a body without a contact surface counts as rigid
///
/// fronts: of the points of one edge, at the end of a step. limit_n is 0 if none holds. Scissors have two edges that
/// cut against each other, so no such direction.
YieldingSpring yielding_of(const model::Model& model, std::size_t tool, const Pose& pose,
                           std::span<const backend::BladeFront> fronts);

/// Writes ToolReading::yielding of each scalpel that is where its hand is.
///
///   fronts     [points of all blades] at the end of a step
///   readings   [tool]
void read_yielding(const model::Model& model, std::span<const backend::BladeFront> fronts,
                   std::span<ToolReading> readings);

}  // namespace tensormass::world
