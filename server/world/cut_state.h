#pragma once

#include "core/result.h"
#include "model/model.h"
#include "world/node_state.h"

/// The state of a scene whose bodies were cut further.
namespace tensormass::world {

/// Returns what a state of `before` is in `after`, the same scene with more cuts. A node or element that a cut has
/// copied starts with the state of the one it was split from, so the displacement field does not change, and neither do
/// momentum and, where no cluster was divided (model/clusters.h), energy. Friction goes on on triangles that are as
/// they were.
///
/// Fails if the state holds what cannot be divided yet: viscoelastic stress of clusters, contact between bodies.
Result<NodeState> cut_state(const model::Model& before, const NodeState& state, const model::Model& after);

}  // namespace tensormass::world
