#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "model/model.h"
#include "tensormass/v1/stream.pb.h"
#include "world/pose_inbox.h"
#include "world/world.h"

/// From a scene's values to the messages of the protocol.
namespace tensormass::world {

/// What the loop knows of a tool after a step.
struct ToolSnapshot {
  ToolReading reading;
  std::uint64_t pose_sequence = 0;
  std::uint64_t client_time_ns = 0;
  std::uint64_t client_id = 0;
};

/// When a step ended, on both of the server's terms.
struct StepStamp {
  std::uint64_t step = 0;
  double simulated_time_s = 0;
  std::uint64_t server_time_ns = 0;
};

/// A step's visible positions and tools, as the loop leaves them for the publisher.
struct FrameSlot {
  StepStamp stamp;
  std::vector<float> positions;
  std::vector<ToolSnapshot> tools;
};

struct FeedbackSlot {
  StepStamp stamp;
  std::vector<ToolSnapshot> tools;
};

std::uint64_t unix_time_ns();

v1::Topology make_topology(const model::Model& model, std::uint64_t version);

/// positions: [visible_count, 3] m
void fill_frame(const model::Model& model, const StepStamp& stamp, std::span<const float> positions,
                std::span<const ToolSnapshot> tools, v1::Frame& out);

void fill_feedback(const model::Model& model, const StepStamp& stamp, std::size_t tool, const ToolSnapshot& snapshot,
                   v1::ToolFeedback& out);

/// How long a client may go on with a step's local model [s]: a few missing steps, or a short hiccup of the network.
double local_model_validity_s(const model::Model& model);

}  // namespace tensormass::world
