#include "world/loop_outputs.h"

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/on_runner.h"
#include "support/scenes.h"
#include "world/runner.h"

/// Results wait in their mailboxes while the world goes on.
namespace tensormass::world {
namespace {

class Outputs : public tests::OnBackend {};
class SceneEvents : public tests::OnRunner {};

TEST_P(Outputs, AFrameHasTheTopologyOfItsStep) {
  const auto world = start(tests::block_with_probe());
  world->set_topology_version(7);
  LoopOutputs outputs(*world);
  outputs.gather_frame();
  outputs.publish(true);
  world->set_topology_version(8);  // before the publisher has come to take the frame

  v1::Frame frame;
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.topology_version(), 7u);

  ASSERT_TRUE(world->step(true));
  outputs.take_step(Clock::now());
  outputs.publish(true);
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.topology_version(), 8u);
  EXPECT_EQ(outputs.frame().topology_version(), 8u);
}

/// Changes of one body: a dead triangle, and an appended one with a vertex of its own.
SurfaceChangesPointer burnt(const World& world, std::uint32_t revision) {
  SurfaceChanges changes{.revision = revision, .appended_vertex_count = 1, .bodies = {}};
  changes.bodies.push_back(
      {{3}, {world.model().visible.vertex_count}, {{0, 1, world.model().bodies[0].vertex_count}}, {2}, {}});
  return std::make_shared<const SurfaceChanges>(std::move(changes));
}

TEST_P(Outputs, LeaveTheNewestChangesForEachReader) {
  const auto world = start(tests::block_with_probe());
  world->set_topology_version(7);
  LoopOutputs outputs(*world);
  v1::SurfaceChanges taken;
  EXPECT_FALSE(outputs.take_changes(taken) || outputs.changes(taken)) << "nothing has changed yet";
  outputs.set_changes(burnt(*world, 1));
  outputs.set_changes(burnt(*world, 2));
  ASSERT_TRUE(outputs.take_changes(taken));
  EXPECT_EQ(taken.revision(), 2u) << "the newest is enough";
  EXPECT_EQ(taken.topology_version(), 7u);
  ASSERT_EQ(taken.bodies_size(), 1);
  EXPECT_EQ(taken.bodies(0).dead_triangles(), std::string("\3\0\0\0", 4));
  EXPECT_EQ(taken.bodies(0).appended_triangles().size(), 12u);
  EXPECT_EQ(taken.bodies(0).appended_kinds(), std::string(1, '\2'));
  EXPECT_FALSE(outputs.take_changes(taken)) << "once";
  for (int i = 0; i < 2; ++i) {
    v1::SurfaceChanges shown;
    ASSERT_TRUE(outputs.changes(shown)) << "as often as it is asked";
    EXPECT_EQ(shown.SerializeAsString(), taken.SerializeAsString());
  }
}

/// A frame that waits keeps the revision of its step.
TEST_P(Outputs, AFrameHasTheRevisionOfItsStep) {
  const auto world = start(tests::block_with_probe());
  LoopOutputs outputs(*world);
  outputs.gather_frame();
  outputs.publish(true);
  outputs.set_changes(std::make_shared<const SurfaceChanges>(SurfaceChanges{.revision = 5, .bodies = {}}));
  v1::Frame frame;
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.revision(), 0u);
  outputs.publish(true);
  ASSERT_TRUE(outputs.take_frame(frame));
  EXPECT_EQ(frame.revision(), 5u);
  ASSERT_TRUE(world->step(true));
  outputs.take_step(Clock::now());
  EXPECT_EQ(outputs.frame().revision(), 5u);
}

TEST_P(Outputs, GoOnWithChangesAndEvents) {
  const auto world = start(tests::block_with_probe()), next = start(tests::block_with_probe());
  LoopOutputs outputs(*world);
  outputs.set_changes(burnt(*world, 4));
  outputs.add_event({.kind = EventKind::kSevered, .value = 3});
  outputs.go_on_with(*next);
  outputs.take_step(Clock::now());
  outputs.add_event({.kind = EventKind::kAdjusted});
  v1::SceneEvents events;
  ASSERT_TRUE(outputs.take_events(events));
  ASSERT_EQ(events.events_size(), 2);
  EXPECT_EQ(events.events(1).sequence(), 2u);
  v1::SurfaceChanges changes;
  ASSERT_TRUE(outputs.take_changes(changes));
  EXPECT_EQ(changes.revision(), 4u);
  EXPECT_EQ(outputs.stamp().revision, 4u);
}

TEST_P(Outputs, KeepTheLast64Events) {
  const auto world = start(tests::block_with_probe());
  LoopOutputs outputs(*world);
  v1::SceneEvents events;
  EXPECT_FALSE(outputs.take_events(events));
  for (std::uint32_t i = 1; i <= 100; ++i) outputs.add_event({.kind = EventKind::kAblated, .step = i, .body = 0});
  ASSERT_TRUE(outputs.take_events(events));
  ASSERT_EQ(events.events_size(), 64);
  for (int i = 0; i < 64; ++i) {
    EXPECT_EQ(events.events(i).sequence(), 37u + i);
    EXPECT_EQ(events.events(i).step(), 37u + i);
    EXPECT_EQ(events.events(i).body(), world->model().bodies[0].name);
    EXPECT_GT(events.events(i).server_time_ns(), 0u);
  }
}

/// What a scene tells of calls.
TEST_P(SceneEvents, TellOfAdjustmentsResetsAndRestores) {
  const auto runner = load(tests::block_with_probe());
  v1::SceneEvents events;
  EXPECT_FALSE(runner->take_events(events)) << "a load makes no event";
  ASSERT_TRUE(runner->step(3));
  const auto snapshot = runner->snapshot();
  ASSERT_TRUE(snapshot);
  ASSERT_TRUE(runner->reset());
  ASSERT_TRUE(runner->restore(snapshot->snapshot()));
  v1::SceneAdjustments softer;
  softer.add_bodies()->set_body(runner->topology()->bodies(0).name());
  softer.mutable_bodies(0)->set_stiffness_factor(0.5);
  ASSERT_TRUE(runner->adjust(softer));
  ASSERT_TRUE(runner->take_events(events));
  EXPECT_EQ(events.topology_version(), runner->topology()->version());
  std::vector<std::pair<int, std::uint64_t>> found;
  for (const v1::SceneEvent& event : events.events()) found.emplace_back(event.kind(), event.step());
  using Kind = v1::SceneEvent;
  EXPECT_EQ(found, (std::vector<std::pair<int, std::uint64_t>>{
                       {Kind::KIND_RESET, 0}, {Kind::KIND_RESTORED, 3}, {Kind::KIND_ADJUSTED, 3}}));
  v1::SurfaceChanges changes;
  EXPECT_FALSE(runner->changes(changes));
}

TM_ON_EACH_BACKEND(Outputs);
TM_ON_EACH_BACKEND(SceneEvents);

}  // namespace
}  // namespace tensormass::world
