#pragma once

#include <cstddef>
#include <vector>

#include <gtest/gtest.h>

#include "world/runner.h"

/// A whole recording as a request that repeats it.
namespace tensormass::tests {

struct Recorded {
  v1::ReplaySceneRequest request;  ///< asks for all checks
  std::vector<v1::StateCheck> checks;
};

/// Takes what was recorded so far.
inline Recorded take_recorded(const world::StartedRecording& started) {
  Recorded out;
  out.request.set_scene_hash(started.start.scene_hash());
  v1::RecordSceneResponse response;
  while (started.recording->take(response)) {
    out.request.mutable_steps()->MergeFrom(response.steps());
    out.request.mutable_edits()->MergeFrom(response.edits());
    out.checks.insert(out.checks.end(), response.checks().begin(), response.checks().end());
  }
  for (const v1::StateCheck& check : out.checks) out.request.add_check_indices(check.index());
  return out;
}

/// Fails unless the states of a replay are those of the recording, to the last bit.
inline void expect_repeated(const v1::ReplaySceneResponse& replayed, const std::vector<v1::StateCheck>& checks) {
  ASSERT_EQ(static_cast<std::size_t>(replayed.checks_size()), checks.size());
  for (std::size_t i = 0; i < checks.size(); ++i) {
    EXPECT_EQ(replayed.checks(static_cast<int>(i)).hash(), checks[i].hash()) << "step " << checks[i].step();
  }
}

/// Fails unless another load of the scene repeats a recording from its start to the last bit.
inline void expect_repeats(world::Runner& other, const world::StartedRecording& started, const Recorded& recorded) {
  if (started.start.has_adjustments()) {
    const auto adjusted = other.adjust(started.start.adjustments());
    ASSERT_TRUE(adjusted) << adjusted.error().message;
  }
  const auto restored = other.restore(started.start.snapshot());
  ASSERT_TRUE(restored) << restored.error().message;
  const auto replayed = other.replay(recorded.request);
  ASSERT_TRUE(replayed) << replayed.error().message;
  expect_repeated(*replayed, recorded.checks);
}

}  // namespace tensormass::tests
