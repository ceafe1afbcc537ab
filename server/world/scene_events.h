#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>

#include "core/scalar.h"
#include "world/fixed_name.h"
#include "world/guard.h"

/// What happened in a scene, for people and scores. An edit is in edits.h; what it did is an event.
namespace tensormass::world {

/// Numbers of v1::SceneEvent::Kind.
enum class EventKind : std::uint8_t {
  kAblated = 1,  ///< value: volume [m³]
  kPieceFree,    ///< value: volume [m³]
  kSevered,      ///< value: number of springs
  kAdjusted,
  kReset,
  kRestored,
  kGuard,   ///< a guard stopped the scene
  kHeld,    ///< a recovery began
  kBroken,  ///< value: number of springs
  kCut,     ///< value: area [m²]
  kCutBegun,
  kCutEnded,  ///< value: area [m²]; work_j
  kToolAdded,
  kToolRemoved,
  kAttachmentAdded,    ///< value: number of springs
  kAttachmentRemoved,  ///< value: number of springs
};

struct SceneEvent {
  static constexpr std::uint32_t kNone = std::numeric_limits<std::uint32_t>::max();

  EventKind kind = EventKind::kReset;
  std::uint64_t step = 0;            ///< steps of the scene when it happened
  std::uint32_t body = kNone;        ///< place in model::Model::bodies
  std::uint32_t tool = kNone;        ///< place in model::Model::tools at that time
  FixedName tool_name = {};          ///< empty: that of `tool`, which the log fills in
  std::uint32_t attachment = kNone;  ///< place in model::Model::attachments at that time
  FixedName attachment_name = {};    ///< empty: that of `attachment`, which the log fills in
  double value = 0;                  ///< follows from the kind
  double work_j = 0;                 ///< spent on fracture, for kCutEnded
  std::optional<Vec3<double>> position_m = {};
  GuardEvent guard = {};  ///< for kGuard and kHeld
  // The log fills these in.
  std::uint64_t sequence = 0;  ///< counts from 1
  std::uint64_t server_time_ns = 0;
};

/// The last events of a scene. A value of fixed size: adding and copying allocate nothing.
class EventLog {
 public:
  static constexpr std::size_t kKept = 64;

  void add(const SceneEvent& event, std::uint64_t server_time_ns) {
    SceneEvent& slot = events_[count_ % kKept];
    slot = event;
    slot.sequence = ++count_;
    slot.server_time_ns = server_time_ns;
  }
  std::size_t size() const { return static_cast<std::size_t>(std::min<std::uint64_t>(count_, kKept)); }
  /// i: from the oldest one on
  const SceneEvent& operator[](std::size_t i) const { return events_[(count_ - size() + i) % kKept]; }

 private:
  std::array<SceneEvent, kKept> events_{};
  std::uint64_t count_ = 0;
};

}  // namespace tensormass::world
