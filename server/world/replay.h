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
    bool diagnosed = false, rejected = false, evaluates_all = false;
    bool checks = false;                                      ///< the caller wants a check after it
    std::vector<std::pair<std::size_t, ReceivedPose>> poses;  ///< tool, target
    std::vector<EditPointer> edits;                           ///< before it
    /// The poses are for tools that an edit before it brings: read_poses reads them once that edit is done.
    bool waits_for_tools = false;
  };
  std::vector<Step> steps;
};

/// Checks the steps of a request, and finds the edits of each. scene_hash: of the loaded scene. Errors name the step
/// and the field. Values and snapshots of edits are checked when they are done.
/// Poses after an edit that changes tools are left for read_poses.
Result<Replay> read_replay(const model::Model& model, std::uint64_t scene_hash, const v1::ReplaySceneRequest& request);
/// Reads the poses of steps that waited for their tools. first: place of the first step in the request
Result<void> read_poses(const model::Model& model, const v1::ReplaySceneRequest& request, std::size_t first,
                        std::span<Replay::Step> steps);

}  // namespace tensormass::world
