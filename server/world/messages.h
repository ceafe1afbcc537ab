#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "model/model.h"
#include "tensormass/v1/changes.pb.h"
#include "tensormass/v1/event.pb.h"
#include "tensormass/v1/stream.pb.h"
#include "world/scene_events.h"
#include "world/step_clock.h"
#include "world/surface_changes.h"
#include "world/tool.h"

/// Conversion of a scene's values to the messages of the protocol.
namespace tensormass::world {

/// A step: its number, its end in simulated time and on the server's clock, when it was computed, the version of the
/// v1::Topology and the revision of the SurfaceChanges that its positions have, and how often tools had changed.
struct StepStamp {
  std::uint64_t step = 0;
  double simulated_time_s = 0;
  std::uint64_t server_time_ns = 0;
  Clock::time_point began{}, ended{};
  std::uint64_t topology_version = 0;
  std::uint32_t revision = 0, appended_vertex_count = 0;
  std::uint32_t part_changes = 0;
};

/// Visible positions, tools and broken springs of a step, from the loop to the publisher.
struct FrameSlot {
  StepStamp stamp;
  std::vector<float> positions;  ///< as World::visible_positions
  ToolReadings tools;
  std::vector<std::uint8_t> broken_springs;  ///< as World::broken_springs
};

/// Tools of a step, from the loop to the publisher.
struct FeedbackSlot {
  StepStamp stamp;
  ToolReadings tools;
};

/// Changes of the surface, from the loop to those who send them.
struct ChangesSlot {
  SurfaceChangesPointer changes;  ///< nullptr: none so far
  std::uint64_t topology_version = 0;
};

/// Events so far, from the loop to the publisher.
struct EventsSlot {
  EventLog log;
  std::uint64_t topology_version = 0;
};

std::uint64_t unix_time_ns();

/// Returns a number larger than all before, from the clock unless that was set back. Any thread may call it.
std::uint64_t new_topology_version();

v1::Topology make_topology(const model::Model& model, std::uint64_t version);
/// Puts the tools and attachments of a model in place of those of a topology.
void fill_parts(const model::Model& model, v1::Topology& out);
void fill_shape(const model::ToolModel& tool, v1::ToolShape& out);

/// positions: [visible_count + stamp.appended_vertex_count, 3] m or more: the visible points of the model, then the
/// appended vertices
/// broken_springs: as World::broken_springs
void fill_frame(const model::Model& model, const StepStamp& stamp, std::span<const float> positions,
                std::span<const ToolReading> tools, std::span<const std::uint8_t> broken_springs, v1::Frame& out);

void fill_feedback(const model::Model& model, const StepStamp& stamp, std::size_t tool, const ToolReading& reading,
                   v1::ToolFeedback& out);

void fill_changes(const ChangesSlot& slot, v1::SurfaceChanges& out);

/// Writes the events in words, too.
void fill_events(const model::Model& model, const EventsSlot& slot, v1::SceneEvents& out);

/// Time for which a client may use a step's local model [s]: it covers a few missing steps or a short network delay.
double local_model_validity_s(const model::Model& model);

}  // namespace tensormass::world
