#pragma once

#include <cstdint>
#include <optional>

#include "core/scalar.h"
#include "world/scene_events.h"

/// What a step or an edit of a world did, for events. Every number counts from the start of that step or edit, except
/// RemovedTissue, which counts from the load or the last reset.
namespace tensormass::world {

/// Springs of one attachment that broke by one cause.
struct BrokenSprings {
  std::uint32_t attachment = SceneEvent::kNone;  ///< as of SceneEvent; kNone in a scene without frames
  std::uint32_t tool = SceneEvent::kNone;        ///< the tool that severed them; kNone: an edit, or nobody
  bool severed = false;                          ///< false: pulled too hard, or their tissue was ablated
  std::uint32_t count = 0;
};

/// Tissue of a body that edits and tools have taken away.
struct RemovedTissue {
  double volume_m3 = 0;
  std::uint32_t tool = SceneEvent::kNone;       ///< the last that burnt some; kNone: the last was an edit
  std::optional<Vec3<double>> position_m = {};  ///< its tip then
};

}  // namespace tensormass::world
