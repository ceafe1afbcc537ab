#include "world/recording.h"

#include <chrono>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "backend/backend.h"
#include "model/compile.h"
#include "support/scenes.h"
#include "world/ring.h"

namespace tensormass::world {
namespace {

TEST(ARing, HandsOverInOrderAndKnowsItsRoom) {
  Ring<int> ring(3);
  EXPECT_EQ(ring.front(), nullptr);
  int next_in = 0, next_out = 0;
  for (int round = 0; round < 10; ++round) {
    while (ring.room() > 0) {
      ring.back() = next_in++;
      ring.push();
    }
    EXPECT_EQ(next_in - next_out, 3);
    for (int i = 0; i < 2; ++i) {
      ASSERT_NE(ring.front(), nullptr);
      EXPECT_EQ(*ring.front(), next_out++);
      ring.pop();
    }
    EXPECT_EQ(ring.room(), 2u);
  }
}

class ARecording : public testing::Test {
 protected:
  ARecording() {
    const auto backend = backend::make_cpu_backend(1);
    const v1::Scene scene = tests::block_with_probe(false, 4);
    auto compiled = model::compile(scene, backend->patch_policy(model::requested_cpu_threads(scene)));
    if (!compiled) throw std::runtime_error(compiled.error().message);
    model = std::make_shared<const model::Model>(std::move(*compiled));
  }

  static void end_steps(Recording& recording, std::uint64_t count) {
    for (std::uint64_t i = 0; i < count; ++i) recording.end_step({.step = i + 1, .cg_limit = 7});
  }

  std::shared_ptr<const model::Model> model;
  v1::RecordSceneResponse response;
};

TEST_F(ARecording, KeepsThePoseThatAStepTook) {
  Recording recording(*model, {});
  ReceivedPose received;
  received.pose = {{0.1, 0.2, 0.3}, {0.6, 0, 0.8, 0}, {}};
  received.stamp.sequence = 5;
  received.valid_for_s = 0.25;
  recording.take_pose(0, {});
  recording.take_pose(0, received);  // the newer one counts
  end_steps(recording, 2);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.steps_size(), 2);
  ASSERT_EQ(response.steps(0).poses_size(), 1);
  const v1::RecordedPose& pose = response.steps(0).poses(0);
  EXPECT_EQ(pose.tool(), "probe");
  EXPECT_EQ(pose.sequence(), 5u);
  EXPECT_EQ(response.steps(0).cg_iteration_limit(), 7u);
  EXPECT_EQ(response.steps(1).poses_size(), 0) << "a pose belongs to one step";
  const auto read = read_pose(pose, model->tools[0], "pose");
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->pose.position_m, received.pose.position_m);
  EXPECT_EQ(read->pose.orientation, received.pose.orientation);
  EXPECT_EQ(read->valid_for_s, 0.25);
  EXPECT_FALSE(recording.take(response));
}

TEST_F(ARecording, KeepsThatAPoseHasExpired) {
  ReceivedPose received;
  received.pose.orientation = {1, 0, 0, 0};
  received.valid_for_s = kExpired;
  v1::RecordedPose pose;
  write_pose("probe", received, 0, pose);
  auto read = read_pose(pose, model->tools[0], "pose");
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->valid_for_s, kExpired);
  pose.set_valid_for_s(0.5);
  read = read_pose(pose, model->tools[0], "pose");
  ASSERT_FALSE(read);
  EXPECT_NE(read.error().message.find("has expired and valid_for_s"), std::string::npos) << read.error().message;
}

TEST_F(ARecording, SaysWhichStepsFoundNoRoom) {
  Recording recording(*model, {.room_for_steps = 4});
  end_steps(recording, 10);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.steps_size(), 4);
  EXPECT_EQ(response.lost_size(), 0) << "nobody knows yet how many are lost";
  end_steps(recording, 1);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.lost_size(), 1);
  EXPECT_EQ(response.lost(0).first_index(), 5u);
  EXPECT_EQ(response.lost(0).count(), 6u);
  ASSERT_EQ(response.steps_size(), 1);
  EXPECT_EQ(response.steps(0).index(), 11u);
}

TEST_F(ARecording, SaysAtItsEndWhichLastStepsWereLost) {
  Recording recording(*model, {.room_for_steps = 4});
  end_steps(recording, 6);
  recording.close();
  ASSERT_TRUE(recording.take(response));
  EXPECT_EQ(response.steps_size(), 4);
  ASSERT_EQ(response.lost_size(), 1);
  EXPECT_EQ(response.lost(0).first_index(), 5u);
  EXPECT_EQ(response.lost(0).count(), 2u);
  EXPECT_FALSE(recording.take(response)) << "once is enough";
}

TEST_F(ARecording, AStepIsLostTogetherWithItsPoses) {
  Recording recording(*model, {.room_for_steps = 2});
  for (int i = 0; i < 3; ++i) {
    recording.take_pose(0, {});
    end_steps(recording, 1);
  }
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.steps_size(), 2);
  for (const v1::RecordedStep& step : response.steps()) EXPECT_EQ(step.poses_size(), 1);
}

TEST_F(ARecording, CountsChecksThatFindNoRoom) {
  Recording recording(*model, {.check_every_steps = 2, .room_for_checks = 1});
  const std::vector<double> zeros(4 * std::size_t{model->layout.row_count});
  int due = 0;
  for (int i = 0; i < 6; ++i) {
    end_steps(recording, 1);
    if (!recording.check_due()) continue;
    ++due;
    recording.take_check(i + 1, {zeros, zeros, {}, 0}, model);
  }
  EXPECT_EQ(due, 3);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.checks_size(), 1);
  EXPECT_EQ(response.checks(0).index(), 2u);
  EXPECT_EQ(response.lost_checks(), 2u);
}

TEST_F(ARecording, IsAbandonedByAReaderThatDoesNotLookForALease) {
  Recording waits(*model, {.lease = std::chrono::hours(1)});
  EXPECT_FALSE(waits.abandoned());
  Recording short_one(*model, {.lease = std::chrono::milliseconds(0)});
  while (!short_one.abandoned()) std::this_thread::yield();
  int freed = 0;
  short_one.on_evicted([&] { ++freed; });
  short_one.evict();
  EXPECT_EQ(freed, 1);
  EXPECT_TRUE(short_one.evicted());
  EXPECT_TRUE(short_one.closed());
  waits.on_evicted([&] { ++freed; });
  waits.on_evicted({});
  waits.evict();
  EXPECT_EQ(freed, 1) << "the reader has gone";
}

TEST_F(ARecording, AResetDropsThePosesOfAStepThatDidNotCome) {
  Recording recording(*model, {});
  recording.take_pose(0, {});
  recording.take_edit({std::make_shared<const Edit>(Reset{}), 0});
  end_steps(recording, 2);
  ASSERT_TRUE(recording.take(response));
  EXPECT_TRUE(response.steps(0).reset());
  EXPECT_EQ(response.steps(0).poses_size(), 0);
  EXPECT_EQ(response.steps(0).edits(), 1u);
  ASSERT_EQ(response.edits_size(), 1);
  EXPECT_EQ(response.edits(0).index(), 1u);
  EXPECT_TRUE(response.edits(0).has_reset());
  EXPECT_FALSE(response.steps(1).reset());
}

TEST_F(ARecording, AStepIsLostTogetherWithItsEdits) {
  Recording recording(*model, {.room_for_edits = 2});
  for (int i = 0; i < 3; ++i) {
    recording.take_edit({std::make_shared<const Edit>(Reset{}), 0});
    end_steps(recording, 1);
  }
  end_steps(recording, 1);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.steps_size(), 3);
  EXPECT_EQ(response.edits_size(), 2);
  ASSERT_EQ(response.lost_size(), 1);
  EXPECT_EQ(response.lost(0).first_index(), 3u);
  EXPECT_EQ(response.steps(2).index(), 4u);
  EXPECT_EQ(response.steps(2).edits(), 0u) << "what was lost does not come with a later step";
}

/// A restored snapshot may be large, so a message ends after one, and few of them wait.
TEST_F(ARecording, SnapshotsThatWaitHaveABound) {
  Recording recording(*model, {});
  const auto restore = [&](std::size_t bytes) {
    recording.take_edit({std::make_shared<const Edit>(Restore{std::string(bytes, 'x')}), 5});
    end_steps(recording, 1);
  };
  restore(limits::kMaxRecordedEditBytes + 1);
  end_steps(recording, 1);  // it has no edit, so it has room
  restore(1);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.edits_size(), 1) << "the first fits whatever it takes";
  EXPECT_EQ(response.edits(0).restore().size(), limits::kMaxRecordedEditBytes + 1);
  EXPECT_EQ(response.edits(0).step(), 5u);
  EXPECT_EQ(response.steps_size(), 1);
  restore(Recording::kMaxEditBytes);
  restore(1);
  ASSERT_TRUE(recording.take(response));
  ASSERT_EQ(response.lost_size(), 1);
  EXPECT_EQ(response.lost(0).first_index(), 3u);
  ASSERT_EQ(response.steps_size(), 2);
  EXPECT_EQ(response.steps(1).index(), 4u);
  ASSERT_TRUE(recording.take(response));
  EXPECT_EQ(response.steps(0).index(), 5u);
}

}  // namespace
}  // namespace tensormass::world
