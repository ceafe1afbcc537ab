#include "world/messages.h"

#include <algorithm>
#include <cstring>
#include <numeric>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/scenes.h"

namespace tensormass::world {
namespace {

model::Model two_bodies_and_a_probe() {
  v1::Scene scene = tests::block_with_probe(false, 2);
  *scene.add_bodies() = scene.bodies(0);
  scene.mutable_bodies(1)->set_name("second");
  tests::set(*scene.mutable_bodies(1)->mutable_color_srgb(), 0.5, 0.25, 0);
  auto model = model::compile(scene, {});
  return std::move(model.value());
}

TEST(Messages, TopologyNamesEachBodysShareOfTheFrame) {
  const model::Model model = two_bodies_and_a_probe();
  const v1::Topology topology = make_topology(model, 42);
  EXPECT_EQ(topology.scene(), "block");
  EXPECT_EQ(topology.version(), 42u);
  EXPECT_EQ(topology.gravity_m_per_s2().y(), -9.81);
  ASSERT_EQ(topology.bodies_size(), 2);
  std::uint32_t next = 0;
  for (const v1::BodySurface& body : topology.bodies()) {
    EXPECT_EQ(body.first_vertex(), next);
    next += body.vertex_count();
    ASSERT_EQ(body.nodes().size(), 4 * body.vertex_count());
    ASSERT_EQ(body.triangles().size() % 12, 0u);
    std::vector<std::uint32_t> corners(body.triangles().size() / 4);
    std::memcpy(corners.data(), body.triangles().data(), body.triangles().size());
    for (const std::uint32_t corner : corners) EXPECT_LT(corner, body.vertex_count());
  }
  EXPECT_EQ(next, model.visible.count());
  EXPECT_FALSE(topology.bodies(0).has_color_srgb()) << "the viewer chooses";
  EXPECT_EQ(topology.bodies(1).color_srgb().y(), 0.25);
  ASSERT_EQ(topology.tools_size(), 1);
  EXPECT_EQ(topology.tools(0).name(), "probe");
  EXPECT_EQ(topology.tools(0).radius_m(), 0.01);
  EXPECT_EQ(topology.tools(0).tool().spherical_probe().radius_m(), 0.01) << "as the scene describes it";
}

TEST(Messages, TopologyHasThePictureOfABody) {
  v1::Scene scene = tests::block_with_probe(false, 2);
  const std::vector<double> vertices{0, 0, 0, 1e-3, 0, 0, 0, 1e-3, 0};
  const std::vector<std::uint32_t> triangle{0, 1, 2};
  const std::vector<float> coordinates{0, 0, 1, 0, 0, 1};
  const auto bytes = [](const auto& items) {
    return std::string(reinterpret_cast<const char*>(items.data()), items.size() * sizeof(items[0]));
  };
  v1::Body& body = *scene.mutable_bodies(0);
  body.mutable_skin()->mutable_packed()->set_vertex_positions(bytes(vertices));
  body.mutable_skin()->mutable_packed()->set_triangles(bytes(triangle));
  body.mutable_texture()->set_image("\xff\xd8\xff and the rest");
  body.mutable_texture()->set_coordinates(bytes(coordinates));
  const auto model = model::compile(scene, {});
  ASSERT_TRUE(model) << model.error().message;
  const v1::Topology topology = make_topology(*model, 1);
  EXPECT_EQ(topology.bodies(0).texture_image(), body.texture().image());
  EXPECT_EQ(topology.bodies(0).texture_coordinates(), body.texture().coordinates());
}

/// The block's bottom is fixed: 3 × 3 nodes of a grid of 2 × 2 cells across.
TEST(Messages, TopologyNamesFixedVertices) {
  const model::Model model = two_bodies_and_a_probe();
  const v1::Topology topology = make_topology(model, 1);
  for (int b = 0; b < 2; ++b) {
    const model::BodyModel& body = model.bodies[static_cast<std::size_t>(b)];
    const std::string& bytes = topology.bodies(b).fixed_vertices();
    std::vector<std::uint32_t> fixed(bytes.size() / 4);
    std::memcpy(fixed.data(), bytes.data(), bytes.size());
    EXPECT_EQ(fixed.size(), 9u);
    EXPECT_TRUE(std::is_sorted(fixed.begin(), fixed.end()));
    for (const std::uint32_t vertex : fixed) {
      ASSERT_LT(vertex, body.vertex_count);
      const std::uint32_t row = model.layout.row_of_node[body.node_begin + body.vertex_nodes[vertex]];
      EXPECT_EQ(model.rest[4 * std::size_t{row} + 1], 0) << "at the bottom";
    }
  }
}

TEST(Messages, FeedbackEchoesThePoseAndCarriesTheLocalModel) {
  const model::Model model = two_bodies_and_a_probe();
  ToolReading reading;
  reading.newest = {.sequence = 3, .client_time_ns = 4, .client_id = 5};
  reading.pose = {{1, 2, 3}, {0.5, 0.5, 0.5, 0.5}, {}};
  reading.force_n = {6, 7, 8};
  reading.torque_n_m = {9, 10, 11};
  reading.stiffness_n_per_m << 1, 2, 3, 4, 5, 6, 7, 8, 9;
  v1::ToolFeedback feedback;
  for (int i = 0; i < 2; ++i) fill_feedback(model, {12, 0.5, 13}, 0, reading, feedback);  // twice: nothing piles up
  EXPECT_EQ(feedback.tool(), "probe");
  EXPECT_EQ(feedback.step(), 12u);
  EXPECT_EQ(feedback.server_time_ns(), 13u);
  EXPECT_EQ(feedback.pose_sequence(), 3u);
  EXPECT_EQ(feedback.client_time_ns(), 4u);
  EXPECT_EQ(feedback.client_id(), 5u);
  EXPECT_EQ(feedback.position_m().z(), 3);
  EXPECT_EQ(feedback.orientation().x(), 0.5);
  EXPECT_EQ(feedback.force_n().y(), 7);
  EXPECT_EQ(feedback.torque_n_m().z(), 11);
  ASSERT_EQ(feedback.local_model().stiffness_n_per_m_size(), 9);
  for (int i = 0; i < 9; ++i) EXPECT_EQ(feedback.local_model().stiffness_n_per_m(i), i + 1) << "row-major";
  EXPECT_EQ(feedback.local_model().valid_for_s(), local_model_validity_s(model));
}

TEST(Messages, FeedbackCarriesWhatHoldsABlade) {
  const model::Model model = two_bodies_and_a_probe();
  ToolReading reading;
  v1::ToolFeedback feedback;
  reading.yielding = {{0, 1, 0}, 300, 0.4};
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_EQ(feedback.local_model().yielding().direction().y(), 1);
  EXPECT_EQ(feedback.local_model().yielding().stiffness_n_per_m(), 300);
  EXPECT_EQ(feedback.local_model().yielding().limit_n(), 0.4);
  reading.yielding = {};
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_FALSE(feedback.local_model().has_yielding());
}

TEST(Messages, AToolIsClaimedUntilItIsRetired) {
  const model::Model model = two_bodies_and_a_probe();
  ToolReading reading;
  v1::ToolFeedback feedback;
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_FALSE(feedback.claimed());
  reading.newest.claims = true;
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_TRUE(feedback.claimed());
  reading.retired = true;
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_FALSE(feedback.claimed());
}

TEST(Messages, VersionsOfTopologiesRise) {
  std::uint64_t last = unix_time_ns();
  // Faster than the clock ticks.
  for (int i = 0; i < 100'000; ++i) {
    const std::uint64_t next = new_topology_version();
    ASSERT_GT(next, last);
    last = next;
  }
}

/// The local model of a tool with a mass belongs to the place of the hand, and the tool is elsewhere.
TEST(Messages, FeedbackOfAToolWithAMassHasAnAnchor) {
  model::Model model = two_bodies_and_a_probe();
  ToolReading reading;
  reading.hand_m = {1, 2, 3};
  v1::ToolFeedback feedback;
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_FALSE(feedback.local_model().has_anchor_m());
  model.tools[0].mass_kg = 0.1;
  fill_feedback(model, {}, 0, reading, feedback);
  EXPECT_EQ(feedback.local_model().anchor_m().y(), 2);
}

/// The times are those of the server's clock, so a client that adds transport needs no common clock.
TEST(Messages, FeedbackSaysWhereItsTimeWent) {
  using std::chrono::milliseconds;
  const model::Model model = two_bodies_and_a_probe();
  const Clock::time_point now = Clock::now();
  const StepStamp stamp{12, 0.5, 13, now - milliseconds(50), now - milliseconds(20)};
  ToolReading reading;
  v1::ToolFeedback feedback;
  fill_feedback(model, stamp, 0, reading, feedback);
  EXPECT_EQ(feedback.pose_waited_s(), 0) << "there was no pose";
  reading.newest.arrived = now - milliseconds(60);
  fill_feedback(model, stamp, 0, reading, feedback);
  EXPECT_NEAR(feedback.pose_waited_s(), 0.01, 1e-9);
  EXPECT_NEAR(feedback.step_s(), 0.03, 1e-9);
  EXPECT_GE(feedback.published_after_s(), 0.02);
}

TEST(Messages, LocalModelOutlivesAFewMissingSteps) {
  model::Model model = two_bodies_and_a_probe();
  model.rate_hz = 10;
  EXPECT_NEAR(local_model_validity_s(model), 0.3, 1e-12);
  model.rate_hz = 1000;
  EXPECT_NEAR(local_model_validity_s(model), 0.02, 1e-12) << "a short hiccup of the network";
}

TEST(Messages, FrameHoldsThePositionsUnchanged) {
  const model::Model model = two_bodies_and_a_probe();
  std::vector<float> positions(3 * std::size_t{model.visible.count()});
  std::iota(positions.begin(), positions.end(), 1.0f);
  const std::vector<ToolReading> tools(1);
  v1::Frame frame;
  for (int i = 0; i < 2; ++i) fill_frame(model, {7, 0.25, 9}, positions, tools, {}, frame);
  EXPECT_EQ(frame.step(), 7u);
  EXPECT_EQ(frame.simulated_time_s(), 0.25);
  EXPECT_EQ(frame.server_time_ns(), 9u);
  EXPECT_EQ(frame.tools_size(), 1);
  ASSERT_EQ(frame.positions().size(), sizeof(float) * positions.size());
  EXPECT_EQ(std::memcmp(frame.positions().data(), positions.data(), frame.positions().size()), 0);
  EXPECT_TRUE(frame.attachment_points().empty() && frame.broken_springs().empty()) << "the scene has no attachments";
}

/// The world has appended vertices behind all visible points; a frame has them behind the vertices.
TEST(Messages, FrameHasAppendedVerticesBehindTheOthers) {
  model::Model model = two_bodies_and_a_probe();
  model.visible.vertex_count -= 2;  // the last two points are ends of springs
  const std::size_t points = model.visible.count();
  std::vector<float> positions(3 * (points + 4));  // room for two more
  std::iota(positions.begin(), positions.end(), 1.0f);
  const std::vector<ToolReading> tools(1);
  StepStamp stamp{7, 0.25, 9};
  stamp.revision = 3;
  stamp.appended_vertex_count = 2;
  v1::Frame frame;
  fill_frame(model, stamp, positions, tools, {}, frame);
  EXPECT_EQ(frame.revision(), 3u);
  std::vector<float> found(frame.positions().size() / sizeof(float)),
      ends(frame.attachment_points().size() / sizeof(float));
  std::memcpy(found.data(), frame.positions().data(), frame.positions().size());
  std::memcpy(ends.data(), frame.attachment_points().data(), frame.attachment_points().size());
  std::vector<float> wanted(positions.begin(), positions.begin() + 3 * (points - 2));
  wanted.insert(wanted.end(), positions.begin() + 3 * points, positions.begin() + 3 * (points + 2));
  EXPECT_EQ(found, wanted);
  EXPECT_EQ(ends, std::vector<float>(positions.begin() + 3 * (points - 2), positions.begin() + 3 * points));
}

TEST(Messages, EventsSayInWordsWhatHappened) {
  const model::Model model = two_bodies_and_a_probe();
  const FixedName probe("probe"), ligament("ligament");
  EventsSlot slot{{}, 42};
  slot.log.add({.kind = EventKind::kAblated,
                .step = 5,
                .body = 1,
                .tool_name = probe,
                .value = 2e-9,
                .position_m = Vec3<double>(1, 2, 3)},
               7);
  slot.log.add({.kind = EventKind::kSevered, .value = 1}, 8);
  slot.log.add({.kind = EventKind::kSevered, .tool_name = probe, .attachment_name = ligament, .value = 3}, 8);
  slot.log.add({.kind = EventKind::kBroken, .attachment_name = ligament, .value = 2}, 8);
  slot.log.add({.kind = EventKind::kHeld,
                .guard = {.step = 9, .first = {Breach::kNotFinite}, .last = {}, .outcome = GuardEvent::Outcome::kHeld}},
               9);
  slot.log.add({.kind = EventKind::kCutEnded, .body = 1, .tool_name = probe, .value = 2e-6, .work_j = 3e-4}, 10);
  slot.log.add({.kind = EventKind::kToolRemoved, .tool_name = FixedName("gone")}, 11);
  slot.log.add({.kind = EventKind::kAttachmentAdded, .attachment_name = FixedName("clip"), .value = 4}, 12);
  slot.log.add({.kind = EventKind::kAttachmentRemoved, .attachment_name = FixedName("clip"), .value = 1}, 13);
  v1::SceneEvents events;
  fill_events(model, slot, events);
  EXPECT_EQ(events.topology_version(), 42u);
  ASSERT_EQ(events.events_size(), 9);
  EXPECT_EQ(events.events(7).text(), "attachment 'clip' was added: 4 springs");
  EXPECT_EQ(events.events(8).text(), "attachment 'clip' was removed: 1 spring");
  EXPECT_EQ(events.events(8).kind(), v1::SceneEvent::KIND_ATTACHMENT_REMOVED);
  EXPECT_EQ(events.events(8).attachment(), "clip");
  EXPECT_EQ(events.events(0).text(), "2 mm³ of body 'second' burnt away by 'probe'");
  EXPECT_EQ(events.events(0).tool(), "probe");
  EXPECT_EQ(events.events(0).position_m().z(), 3);
  EXPECT_EQ(events.events(0).server_time_ns(), 7u);
  EXPECT_EQ(events.events(1).text(), "1 spring severed");
  EXPECT_FALSE(events.events(1).has_position_m());
  EXPECT_TRUE(events.events(1).attachment().empty());
  EXPECT_EQ(events.events(2).text(), "3 springs of attachment 'ligament' severed by 'probe'");
  EXPECT_EQ(events.events(2).attachment(), "ligament");
  EXPECT_EQ(events.events(3).text(), "2 springs of attachment 'ligament' broke");
  EXPECT_NE(events.events(4).text().find("the tissue was held"), std::string::npos) << events.events(4).text();
  EXPECT_EQ(events.events(5).text(), "a cut of body 'second' by 'probe' ends: 2 mm² and 0.3 mJ");
  EXPECT_EQ(events.events(5).work_j(), 3e-4);
  EXPECT_EQ(events.events(6).text(), "tool 'gone' was removed");
  for (int kind = v1::SceneEvent::KIND_ABLATED; kind <= v1::SceneEvent::KIND_ATTACHMENT_REMOVED; ++kind) {
    EventsSlot one{{}, 1};
    one.log.add({.kind = static_cast<EventKind>(kind)}, 1);
    fill_events(model, one, events);
    EXPECT_FALSE(events.events(0).text().empty()) << kind;
  }
}

}  // namespace
}  // namespace tensormass::world
