#include <array>
#include <cstring>

#include <gtest/gtest.h>

#include "cut_blades.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

constexpr int kCuts = 10'000, kCutsInARow = 10;

/// Volume [m³] and mass-weighted position [m⁴] of all copies, with the mass of an element spread evenly over its nodes.
std::pair<double, Vector3d> sums(const testing::CutScene& scene, const std::vector<double>& volumes_m3) {
  double volume = 0.0;
  Vector3d moment = Vector3d::Zero();
  for (std::uint32_t element = 0; element < scene.topology.element_count(); ++element) {
    const auto nodes = scene.topology.nodes(element);
    const double each = volumes_m3[element] / static_cast<double>(nodes.size());
    const auto add = [&](const PartShares* shares) {
      volume += volumes_m3[element] * (shares == nullptr ? 1.0 : shares->volume);
      for (std::size_t k = 0; k < nodes.size(); ++k) {
        moment += each * (shares == nullptr ? 1.0 : shares->nodes[k]) * scene.mesh.nodes[nodes[k]];
      }
    };
    if (scene.cut.first_part(element) == kNone) add(nullptr);
    for (std::uint32_t p = scene.cut.first_part(element); p != kNone; p = scene.cut.parts()[p].next) {
      add(&scene.cut.parts()[p].shares);
    }
  }
  return {volume, moment};
}

class RandomCuts : public ::testing::TestWithParam<Shape> {};
INSTANTIATE_TEST_SUITE_P(Shapes, RandomCuts, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST_P(RandomCuts, LeaveASoundMesh) {
  constexpr std::uint32_t kCells = 4;
  std::mt19937 random(11);
  const int rounds = kCuts / kCutsInARow / static_cast<int>(kShapes.size()) + 1;
  std::size_t cut_edges = 0, parted = 0, divided = 0, pieces = 0, of_reference = 0;
  std::uint8_t most_parts = 0;
  std::vector<CutPart> before;
  double most_shift = 0.0;
  std::size_t shifts = 0;
  for (int round = 0; round < rounds; ++round) {
    static std::unique_ptr<testing::CutScene> scene;
    static std::vector<double> volumes_m3;
    if (round % 20 == 0) {
      scene = std::make_unique<testing::CutScene>(
          testing::random_mesh(static_cast<std::uint32_t>(round), kCells, 1.0, GetParam()));
      volumes_m3.clear();
      for_each_element(scene->mesh, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
        volumes_m3.push_back(element_geometry(scene->mesh, shape, nodes).volume_m3);
      });
    }
    Cut& cut = scene->cut;
    const auto [volume_before, moment_before] = sums(*scene, volumes_m3);
    for (int i = 0; i < kCutsInARow; i += 2) {
      // Two blades at a time, in turns.
      const std::array paths{testing::random_path(random, kCells), testing::random_path(random, kCells)};
      for (std::size_t step = 1; step < std::max(paths[0].size(), paths[1].size()); ++step) {
        for (const testing::Path& path : paths) {
          if (step >= path.size()) continue;
          const Sweep sweep = scene->search.sweep(path[step - 1], path[step], scene->room);
          ASSERT_FALSE(sweep.refused);
          before.assign(cut.parts().begin(), cut.parts().end());
          const CutChange change = cut.cut(sweep.edges);
          ASSERT_FALSE(change.refused);
          for (std::size_t p = 0; p < before.size(); ++p) {
            if (before[p].corners != cut.parts()[p].corners) continue;
            const double shift = std::abs(before[p].shares.volume - cut.parts()[p].shares.volume);
            most_shift = std::max(most_shift, shift);
            shifts += shift > 1e-12;
          }
          cut_edges += change.edges.size();
          for (const std::uint32_t element : change.elements) {
            testing::expect_sound_parts(cut, element);
            most_parts = std::max(most_parts, cut.labels(element).count);
            ASSERT_FALSE(HasFatalFailure());
          }
        }
      }
    }
    parted += cut.parts().size();
    for (std::uint32_t element = 0; element < scene->topology.element_count(); ++element) {
      testing::expect_sound_parts(cut, element);
    }
    const auto [volume, moment] = sums(*scene, volumes_m3);
    ASSERT_NEAR(volume, volume_before, 1e-12);
    ASSERT_LT((moment - moment_before).norm() / volume, 1e-12);
    std::vector<CutPiece> found(scene->topology.element_count());
    const std::size_t count = cut.pieces(found);
    double volume_of_pieces = 0.0;
    for (std::size_t i = 0; i < count; ++i) volume_of_pieces += found[i].volume_m3;
    ASSERT_NEAR(volume_of_pieces, volume, 1e-12);
    pieces += count - 1;
    if (round % 2 == 0) {
      const CutSurface surface = visible_surface(cut);
      testing::expect_watertight(surface);
      divided += surface.divided_edges;
    }
    if (round % 16 == 0) {
      testing::expect_reference_classes(*scene);
      ++of_reference;
    }
    ASSERT_FALSE(HasFatalFailure()) << "round " << round;
    cut.reset();
    ASSERT_EQ(cut.parts().size() + cut.virtual_nodes().size(), 0u);
  }
  std::printf("%zu edges cut, %zu parts, at most %d of an element, %zu loose pieces, %zu edges divided\n", cut_edges,
              parted, most_parts, pieces, divided);
  std::printf("%zu times a part with unchanged corners got another share, by at most %.3f\n", shifts, most_shift);
  EXPECT_GT(cut_edges, 7'000u);
  EXPECT_GT(parted, 5'000u);
  EXPECT_GT(most_parts, 2);
  EXPECT_GT(pieces, 10u);
  EXPECT_GT(of_reference, 5u);
}

TEST_P(RandomCuts, DoNotDependOnTheirOrder) {
  testing::CutScene scene(testing::random_mesh(1, 3, 1.0, GetParam()));
  std::mt19937 random(5);
  std::size_t parts = 0;
  for (int set = 0; set < 8; ++set) {
    // Ten cuts, no edge in two of them.
    std::vector<std::vector<CutEdge>> cuts;
    std::set<std::uint32_t> taken;
    while (cuts.size() < 10) {
      auto& cut = cuts.emplace_back();
      const testing::Path path = testing::random_path(random, 3);
      for (std::size_t step = 1; step < path.size(); ++step) {
        for (const CutEdge& edge : scene.search.sweep(path[step - 1], path[step], scene.room).edges) {
          if (taken.insert(edge.edge).second) cut.push_back(edge);
        }
      }
    }
    std::vector<std::uint64_t> first;
    for (int order = 0; order < 20; ++order) {
      scene.cut.reset();
      std::vector<CutEdge> singly;
      for (const auto& cut : cuts) {
        ASSERT_FALSE(order < 18 && scene.cut.cut(cut).refused);
        singly.insert(singly.end(), cut.begin(), cut.end());
      }
      // The last orders are edge by edge.
      std::shuffle(singly.begin(), singly.end(), random);
      for (const CutEdge& edge : singly) {
        ASSERT_FALSE(order >= 18 && scene.cut.cut({&edge, 1}).refused);
      }
      const std::vector<std::uint64_t> state = testing::canonical(scene.cut);
      if (order == 0) first = state;
      ASSERT_EQ(state, first) << "order " << order;
      std::shuffle(cuts.begin(), cuts.end(), random);
    }
    parts += scene.cut.parts().size();
  }
  EXPECT_GT(parts, 100u);
}

TEST_P(RandomCuts, LeaveAMeshWithHolesSound) {
  // Elements hang together by single nodes and edges as well.
  testing::CutScene scene(testing::random_mesh(6, 4, 0.5, GetParam()));
  std::mt19937 random(6);
  for (int i = 0; i < 40; ++i) {
    const testing::Path path = testing::random_path(random, 4);
    for (std::size_t step = 1; step < path.size(); ++step) scene.move(path[step - 1], path[step]);
    for (std::uint32_t element = 0; element < scene.topology.element_count(); ++element) {
      testing::expect_sound_parts(scene.cut, element);
    }
    ASSERT_FALSE(HasFailure()) << "cut " << i;
  }
  EXPECT_GT(scene.cut.parts().size(), 50u);
}

}  // namespace
}  // namespace tensormass::mesh
