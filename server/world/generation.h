#pragma once

#include <cstdint>
#include <memory>

#include "model/compile.h"
#include "model/model.h"
#include "tensormass/v1/adjustment.pb.h"
#include "tensormass/v1/stream.pb.h"
#include "world/pose_inbox.h"

namespace tensormass::world {

/// A scene between two adjustments, cuts, or changes of its tools or attachments. Constant: a thread that has it knows
/// the values of a state. Inboxes of tools that go on are the same ones.
struct Generation {
  std::uint64_t number = 0;  ///< counts them
  std::shared_ptr<const model::Model> model;
  std::uint64_t scene_hash = 0;
  v1::SceneAdjustments adjustments;
  bool is_adjusted = false;  ///< its values are not those of the load
  model::SceneCuts cuts;     ///< what its bodies have; also in `adjustments`
  PoseInboxes inboxes = {};  ///< [tool]
  std::shared_ptr<const v1::Topology> topology = {};

  /// Returns whether a reset brings other buffers: it heals cuts and takes added attachments out.
  bool was_altered() const { return !cuts.empty() || !adjustments.attachments().attachments().empty(); }
};
using GenerationPointer = std::shared_ptr<const Generation>;

}  // namespace tensormass::world
