#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstring>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"
#include "world/loop_outputs.h"

/// Attachments as clients see them: ends of springs in topology and frames, and which springs are broken.
namespace tensormass::world {
namespace {

template <class Item>
std::vector<Item> unpacked(const std::string& bytes) {
  std::vector<Item> items(bytes.size() / sizeof(Item));
  EXPECT_EQ(items.size() * sizeof(Item), bytes.size());
  std::memcpy(items.data(), bytes.data(), bytes.size());
  return items;
}

/// Bits of the 8 springs of "strong", then of the 9 of "weak" (tests::hanging_block).
const std::string kNone, kAllWeak{"\x00\xff\x01", 3};

class Attachments : public tests::OnBackend {
 protected:
  /// Returns the frame that a publisher would take now.
  static v1::Frame published(World& world, LoopOutputs& outputs) {
    outputs.take_step(Clock::now());
    world.gather_visible();
    outputs.publish(true);
    v1::Frame frame;
    EXPECT_TRUE(outputs.take_frame(frame));
    return frame;
  }
};

TEST_P(Attachments, NameTheEndsOfTheirSpringsAndFramesHaveThem) {
  v1::Scene scene = tests::hanging_block();
  const auto world = start(scene);
  const model::Model& m = world->model();
  const v1::Topology topology = make_topology(m, 1);
  ASSERT_EQ(topology.attachments_size(), 2);
  EXPECT_EQ(topology.attachment_point_count(), 18u) << "17 nodes of the hanging block, and one that all are linked to";
  std::uint32_t vertices = 0;
  for (const v1::BodySurface& body : topology.bodies()) vertices += body.vertex_count();

  for (int i = 0; i < 5; ++i) ASSERT_TRUE(world->step(true));
  LoopOutputs outputs(*world);
  const v1::Frame frame = published(*world, outputs);
  EXPECT_EQ(frame.positions().size(), 12 * std::size_t{vertices}) << "positions are those of surfaces alone";
  const auto points = unpacked<std::array<float, 3>>(frame.attachment_points());
  ASSERT_EQ(points.size(), topology.attachment_point_count());
  const std::vector<double> hanging = world->positions(m.bodies[1]), above = world->positions(m.bodies[0]);
  for (int a = 0; a < 2; ++a) {
    const v1::AttachmentSprings& attachment = topology.attachments(a);
    EXPECT_EQ(attachment.name(), scene.attachments(a).name());
    const auto springs = unpacked<std::array<std::uint32_t, 2>>(attachment.springs());
    const auto lengths = unpacked<float>(attachment.rest_lengths_m());
    ASSERT_EQ(springs.size(), a == 0 ? 8u : 9u);
    ASSERT_EQ(lengths.size(), springs.size());
    EXPECT_DOUBLE_EQ(attachment.stiffness_n_per_m(), 500.0 / static_cast<double>(springs.size())) << "one spring's";
    EXPECT_EQ(attachment.has_breaking_force_n(), a == 1);
    for (std::size_t i = 0; i < springs.size(); ++i) {
      const std::uint32_t node = scene.attachments(a).region().nodes().indices(static_cast<int>(i));
      const auto at = [&](std::uint32_t of_node) { return m.rest.data() + 4 * m.layout.row_of_node[of_node]; };
      const double *from = at(m.bodies[1].node_begin + node), *to = at(0);
      double squared = 0;
      for (std::size_t c = 0; c < 3; ++c) {
        EXPECT_FLOAT_EQ(points.at(springs[i][0])[c], static_cast<float>(hanging[3 * node + c]));
        EXPECT_FLOAT_EQ(points.at(springs[i][1])[c], static_cast<float>(above[c]));
        squared += (from[c] - to[c]) * (from[c] - to[c]);
      }
      EXPECT_FLOAT_EQ(lengths[i], static_cast<float>(std::sqrt(squared)));
    }
  }
  EXPECT_NEAR(topology.attachments(1).breaking_force_n(), 1e-5, 1e-18) << "one spring's";
}

/// A backend sorts springs by row; clients see them in the order of the scene.
TEST_P(Attachments, KnowThePlaceOfEachSpring) {
  const auto world = start(tests::hanging_block());
  const model::Model& m = world->model();
  EXPECT_FALSE(std::is_sorted(m.links.spring_places.begin(), m.links.spring_places.end())) << "the order differs";
  std::size_t number = 0;
  for (const model::VisibleAttachment& attachment : m.attachments) {
    for (const auto& ends : attachment.springs) {
      const std::size_t place = m.links.spring_places[number++];
      for (std::size_t end = 0; end < 2; ++end) {
        EXPECT_EQ(m.links.spring_rows[2 * place + end], m.visible.rows[4 * (m.visible.vertex_count + ends[end])]);
      }
    }
  }
  EXPECT_EQ(number, m.links.spring_count());
}

TEST_P(Attachments, FramesSayWhichSpringsAreBroken) {
  const auto world = start(tests::hanging_block());
  LoopOutputs outputs(*world);
  EXPECT_EQ(published(*world, outputs).broken_springs(), kNone);
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_EQ(published(*world, outputs).broken_springs(), kAllWeak);
  EXPECT_EQ(outputs.frame().broken_springs(), kAllWeak) << "whoever asks gets the same";
  const World::Saved torn = world->save();

  world->reset();
  EXPECT_EQ(published(*world, outputs).broken_springs(), kNone) << "a reset mends them";
  world->restore(torn);
  EXPECT_EQ(published(*world, outputs).broken_springs(), kAllWeak) << "and a snapshot remembers";
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(published(*world, outputs).broken_springs(), kAllWeak);
}

/// A spring that breaks does so in the frame of that step.
TEST_P(Attachments, FramesCountAsManyBrokenSpringsAsTheStatus) {
  v1::Scene scene = tests::hanging_block();
  scene.mutable_attachments(0)->set_breaking_force_n(4);  // less than the weight: these tear one after the other
  const auto world = start(scene);
  LoopOutputs outputs(*world);
  std::vector<std::uint32_t> counts;
  for (int i = 0; i < 100; ++i) {
    ASSERT_TRUE(world->step(true));
    std::uint32_t count = 0;
    const std::string broken = published(*world, outputs).broken_springs();
    for (const char bits : broken) count += std::popcount(static_cast<unsigned char>(bits));
    EXPECT_EQ(count, world->last().broken_springs) << "step " << i + 1;
    if (counts.empty() || counts.back() != count) counts.push_back(count);
  }
  EXPECT_EQ(counts.back(), 17u);
  EXPECT_GT(counts.size(), 2u) << "not all at once";
}

/// A scene without frames has no points that a viewer could draw.
TEST_P(Attachments, AreNotSeenWithoutFrames) {
  v1::Scene scene = tests::hanging_block();
  scene.mutable_streams()->set_frame_rate_hz(0);
  const auto world = start(scene);
  EXPECT_EQ(make_topology(world->model(), 1).attachments_size(), 0);
  ASSERT_TRUE(world->step(false));
}

TM_ON_EACH_BACKEND(Attachments);

}  // namespace
}  // namespace tensormass::world
