#pragma once

#include <cstdint>
#include <span>
#include <utility>
#include <vector>

#include "core/result.h"
#include "model/model.h"
#include "tensormass/v1/control.pb.h"
#include "world/edits.h"
#include "world/tool.h"

namespace tensormass::world {

/// Recorded steps that were checked for the scene that repeats them.
struct Replay {
  struct Step {
    std::uint64_t index = 0, step = 0;
    std::uint32_t cg_limit = 0;
    bool diagnosed = false, rejected = false;
    bool checks = false;                                      ///< the caller wants a check after it
    std::vector<std::pair<std::size_t, ReceivedPose>> poses;  ///< tool, target
    std::vector<EditPointer> edits;                           ///< before it
  };
  std::vector<Step> steps;
};

/// Checks the steps of a request, and finds the edits of each. scene_hash: of the loaded scene. Errors name the step
/// and the field. Values and snapshots of edits are checked when they are done.
Result<Replay> read_replay(const model::Model& model, std::uint64_t scene_hash, const v1::ReplaySceneRequest& request);

}  // namespace tensormass::world
