#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "model/model.h"
#include "tensormass/v1/stream.pb.h"
#include "world/step_clock.h"
#include "world/tool.h"

/// Conversion of a scene's values to the messages of the protocol.
namespace tensormass::world {

/// A step: its number, its end in simulated time and on the server's clock, when it was computed, and the version of
/// the v1::Topology that its positions have.
struct StepStamp {
  std::uint64_t step = 0;
  double simulated_time_s = 0;
  std::uint64_t server_time_ns = 0;
  Clock::time_point began{}, ended{};
  std::uint64_t topology_version = 0;
};

/// Visible positions, tools and broken springs of a step, from the loop to the publisher.
struct FrameSlot {
  StepStamp stamp;
  std::vector<float> positions;
  std::vector<ToolReading> tools;
  std::vector<std::uint8_t> broken_springs;  ///< as World::broken_springs
};

/// Tools of a step, from the loop to the publisher.
struct FeedbackSlot {
  StepStamp stamp;
  std::vector<ToolReading> tools;
};

std::uint64_t unix_time_ns();

/// Returns a number larger than all before, from the clock unless that was set back. Any thread may call it.
std::uint64_t new_topology_version();

v1::Topology make_topology(const model::Model& model, std::uint64_t version);

/// positions: [visible_count, 3] m
/// broken_springs: as World::broken_springs
void fill_frame(const model::Model& model, const StepStamp& stamp, std::span<const float> positions,
                std::span<const ToolReading> tools, std::span<const std::uint8_t> broken_springs, v1::Frame& out);

void fill_feedback(const model::Model& model, const StepStamp& stamp, std::size_t tool, const ToolReading& reading,
                   v1::ToolFeedback& out);

/// Time for which a client may use a step's local model [s]: it covers a few missing steps or a short network delay.
double local_model_validity_s(const model::Model& model);

}  // namespace tensormass::world
