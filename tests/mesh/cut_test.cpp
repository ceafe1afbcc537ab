#include "mesh/cut.h"

#include <atomic>
#include <cstring>
#include <limits>

#include <gtest/gtest.h>

#include "cut_blades.h"
#include "support/operator_new.h"

namespace tensormass::tests {

std::atomic<std::size_t> allocations{0};

bool may_allocate(std::size_t) noexcept {
  ++allocations;
  return true;
}

}  // namespace tensormass::tests

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;
using testing::Blade;
using testing::CutScene;
using testing::wide_blade;

class CutOf : public ::testing::TestWithParam<Shape> {
 protected:
  static constexpr std::uint32_t kCells = 4;
  CutScene scene_{testing::unit_grid(kCells, GetParam())};

  std::vector<CutPiece> pieces() {
    std::vector<CutPiece> found(scene_.topology.element_count());
    found.resize(scene_.cut.pieces(found));
    return found;
  }
  void expect_sound() {
    for (std::uint32_t element = 0; element < scene_.topology.element_count(); ++element) {
      testing::expect_sound_parts(scene_.cut, element);
      if (HasFatalFailure()) return;
    }
    testing::expect_reference_classes(scene_);
    testing::expect_watertight(visible_surface(scene_.cut));
  }
};
INSTANTIATE_TEST_SUITE_P(Shapes, CutOf, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST_P(CutOf, ThroughTheBlockMakesTwoPieces) {
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(1.5, 0.45));
  const std::vector<CutPiece> found = pieces();
  ASSERT_EQ(found.size(), 2u);
  // The plane rises from 0.3 at x = −0.5 to 0.45 at 1.5: 0.375 in the middle. Crossings are kept off the nodes.
  EXPECT_NEAR(found[0].volume_m3, 0.375, 0.01);
  EXPECT_NEAR(found[0].volume_m3 + found[1].volume_m3, 1.0, 1e-12);
  EXPECT_EQ(found[0].row, 0u);
  expect_sound();
}

TEST_P(CutOf, ThatStopsLeavesOnePiece) {
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(0.55, 0.3));
  EXPECT_EQ(pieces().size(), 1u);
  EXPECT_GT(scene_.cut.parts().size(), 0u);
  EXPECT_GT(scene_.cut.virtual_nodes().size(), 0u);
  expect_sound();
  // The rest of the way frees it.
  scene_.move(wide_blade(0.55, 0.3), wide_blade(1.5, 0.3));
  EXPECT_EQ(pieces().size(), 2u);
  expect_sound();
}

TEST_P(CutOf, CanBeHealedAndCutAgain) {
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(1.5, 0.3));
  const auto first = testing::canonical(scene_.cut);
  const std::vector<CutPart> parts(scene_.cut.parts().begin(), scene_.cut.parts().end());
  scene_.cut.reset();
  EXPECT_EQ(pieces().size(), 1u);
  EXPECT_EQ(testing::canonical(scene_.cut).size(), 0u);
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(1.5, 0.3));
  EXPECT_EQ(testing::canonical(scene_.cut), first);
  for (std::size_t i = 0; i < parts.size(); ++i) EXPECT_EQ(scene_.cut.parts()[i].rows, parts[i].rows);
}

TEST_P(CutOf, CopiesStartFromTheRowThatTheyLeave) {
  // A copy of a node that gets another row gets a new one, whose parent is the row that it had.
  std::mt19937 random(3);
  std::vector<CutPart> before;
  for (int i = 0; i < 30; ++i) {
    const testing::Path path = testing::random_path(random, kCells);
    for (std::size_t step = 1; step < path.size(); ++step) {
      before.assign(scene_.cut.parts().begin(), scene_.cut.parts().end());
      const Sweep sweep = scene_.search.sweep(path[step - 1], path[step], scene_.room);
      const CutChange change = scene_.cut.cut(sweep.edges);
      ASSERT_FALSE(change.refused);
      ASSERT_EQ(change.first_part, before.size());
      for (std::uint32_t p = 0; p < scene_.cut.parts().size(); ++p) {
        const CutPart& part = scene_.cut.parts()[p];
        const auto nodes = scene_.topology.nodes(part.element);
        for (std::size_t k = 0; k < nodes.size(); ++k) {
          std::uint32_t old = nodes[k];
          if (p < change.first_part) old = before[p].rows[k];
          if (p >= change.first_part && part.parent != kNone && part.parent < change.first_part) {
            old = before[part.parent].rows[k];
          }
          if (part.rows[k] == old) continue;
          ASSERT_GE(part.rows[k], scene_.topology.node_count() + change.first_row) << "a row moves to new ones only";
          ASSERT_EQ(scene_.cut.virtual_nodes()[part.rows[k] - scene_.topology.node_count()].parent, old);
          ASSERT_TRUE(std::binary_search(change.parts.begin(), change.parts.end(), p)) << "changed, but not listed";
        }
      }
    }
  }
  EXPECT_GT(scene_.cut.virtual_nodes().size(), 30u);
}

// Blades that touch by chance: in the grid's planes, along its edges, through its nodes.

TEST_P(CutOf, InAPlaneOfNodesPutsThemOnOneSide) {
  scene_.move(wide_blade(-0.5, 0.5), wide_blade(1.5, 0.5));
  const std::vector<CutPiece> found = pieces();
  ASSERT_EQ(found.size(), 2u);
  EXPECT_NEAR(found[0].volume_m3 + found[1].volume_m3, 1.0, 1e-12);
  EXPECT_NEAR(found[0].volume_m3, 0.5, 0.05 / kCells + 1e-12);
  expect_sound();
}

TEST_P(CutOf, SlipsBetweenNoTwoSweeps) {
  // Each second sweep ends exactly along a row of nodes and edges, in the plane of nodes.
  scene_.move(wide_blade(-0.5, 0.5), wide_blade(1.5, 0.5));
  std::vector<bool> fast;
  for (std::uint32_t edge = 0; edge < scene_.topology.edge_count(); ++edge) fast.push_back(scene_.cut.is_cut(edge));
  scene_.cut.reset();
  for (int i = 0; i < 16; ++i) scene_.move(wide_blade(-0.5 + i / 8.0, 0.5), wide_blade(-0.375 + i / 8.0, 0.5));
  EXPECT_EQ(pieces().size(), 2u);
  for (std::uint32_t edge = 0; edge < scene_.topology.edge_count(); ++edge) {
    EXPECT_EQ(scene_.cut.is_cut(edge), fast[edge]) << edge;
  }
}

TEST_P(CutOf, InAWallOfTheSearchsCellsMakesTwoPieces) {
  // The search sorts edges into cells of this many lattice steps, and skips cells beside the blade's plane.
  const double per_side = std::cbrt(static_cast<double>(scene_.topology.edge_count()));
  const double cell = std::floor(static_cast<double>(kLatticeSteps) / per_side) / static_cast<double>(kLatticeSteps);
  for (double z = cell; z < 1.0; z += cell) {
    scene_.move(wide_blade(-0.5, z), wide_blade(1.5, z));
    EXPECT_EQ(pieces().size(), 2u) << z;
    scene_.cut.reset();
  }
}

TEST_P(CutOf, InADiagonalPlaneOfNodesMakesTwoPieces) {
  const Blade before{{-0.5, 1.5, -0.5}, {-0.5, 1.5, 1.5}}, after{{1.5, -0.5, -0.5}, {1.5, -0.5, 1.5}};
  scene_.move(before, after);
  EXPECT_EQ(pieces().size(), 2u);
  expect_sound();
}

TEST_P(CutOf, AlongAnEdgeAndThroughNodesIsSound) {
  const double h = 1.0 / kCells;
  // A narrow blade whose ends run along edges, from node to node, then on in another direction.
  const testing::Path path{
      {{0, 0, 0}, {0, h, 0}}, {{h, 0, 0}, {h, h, 0}}, {{h, 0, h}, {h, h, h}}, {{1, 0, 1}, {1, h, 1}}};
  for (std::size_t step = 1; step < path.size(); ++step) scene_.move(path[step - 1], path[step]);
  expect_sound();
  // Along itself, in no plane: the sweep has no area.
  scene_.move({{0, h, h}, {h, h, h}}, {{h, h, h}, {2 * h, h, h}});
  expect_sound();
  // From a node back to the same node.
  scene_.move({{h, h, h}, {h, h, h}}, {{1, 1, 1}, {1, 1, 1}});
  expect_sound();
}

TEST_P(CutOf, StartsInsideTheTissue) {
  scene_.move({{0.4, -0.5, 0.4}, {0.4, 1.5, 0.4}}, {{0.9, -0.5, 0.45}, {0.9, 1.5, 0.45}});
  EXPECT_EQ(pieces().size(), 1u);
  expect_sound();
}

TEST_P(CutOf, FastIsAsSlow) {
  // Eighths and sixteenths are lattice points, so both blades go through exactly the same plane.
  scene_.move(wide_blade(-0.5, 0.375), wide_blade(1.5, 0.4375));
  const auto fast = testing::canonical(scene_.cut);
  scene_.cut.reset();
  for (int i = 0; i < 32; ++i) {
    scene_.move(wide_blade(-0.5 + i / 16.0, 0.375 + i / 512.0),
                wide_blade(-0.4375 + i / 16.0, 0.375 + (i + 1) / 512.0));
  }
  const auto slow = testing::canonical(scene_.cut);
  ASSERT_EQ(fast.size(), slow.size());
  EXPECT_EQ(pieces().size(), 2u);
}

TEST_P(CutOf, OutsideOrAtRestCutsNothing) {
  EXPECT_EQ(scene_.move(wide_blade(-0.5, 1.1), wide_blade(1.5, 1.1)), 0u);
  EXPECT_EQ(scene_.move(wide_blade(-900.0, 400.0), wide_blade(900.0, 500.0)), 0u);
  EXPECT_EQ(scene_.move(wide_blade(0.3, 0.3), wide_blade(0.3, 0.3)), 0u);
  EXPECT_EQ(scene_.move(wide_blade(0.5, 0.5), wide_blade(0.5, 0.5)), 0u) << "at rest on nodes";
  EXPECT_EQ(scene_.cut.parts().size(), 0u);
}

TEST_P(CutOf, ByTwoBladesInOneElementMakesFourPieces) {
  const auto across = [](double y) { return Blade{{-0.5, 0.35, y}, {0.5, 0.35, y}, {1.5, 0.35, y}}; };
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(1.5, 0.32));
  scene_.move(across(-0.5), across(1.5));
  EXPECT_EQ(pieces().size(), 4u);
  expect_sound();
}

TEST_P(CutOf, SweepRefusesWhatItCannotRead) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const Blade good = wide_blade(-0.5, 0.3), other = wide_blade(1.5, 0.3);
  const auto refusal = [&](const Blade& before, const Blade& after, std::span<CutEdge> room) {
    const Sweep sweep = scene_.search.sweep(before, after, room);
    EXPECT_TRUE(sweep.refused);
    EXPECT_EQ(sweep.edges.size(), 0u);
    EXPECT_NE(words(sweep.refusal).find("blade"), std::string_view::npos);
    return sweep.refusal;
  };
  EXPECT_EQ(refusal({good[0]}, {other[0]}, scene_.room), SweepRefusal::kOddPoints);
  EXPECT_EQ(refusal(good, {other[0], other[1]}, scene_.room), SweepRefusal::kOddPoints);
  EXPECT_EQ(refusal(good, wide_blade(nan, 0.3), scene_.room), SweepRefusal::kPosition);
  EXPECT_EQ(refusal(wide_blade(1e9, 0.3), other, scene_.room), SweepRefusal::kPosition);
  EXPECT_EQ(refusal(good, other, std::span(scene_.room).first(10)), SweepRefusal::kTooManyEdges);
  EXPECT_GT(scene_.search.sweep(good, other, scene_.room).edges.size(), 10u) << "a refusal leaves no trace";
}

TEST_P(CutOf, IsRefusedAsAWhole) {
  scene_.move(wide_blade(-0.5, 0.3), wide_blade(0.5, 0.3));
  const CutReserve used{static_cast<std::uint32_t>(scene_.cut.parts().size()),
                        static_cast<std::uint32_t>(scene_.cut.virtual_nodes().size())};
  ASSERT_GT(used.rows, 0u);
  // As much as the first half needs, and a little more of one or the other.
  for (const CutReserve& reserve :
       {used, CutReserve{used.parts + 5, used.rows + 100000}, CutReserve{used.parts + 100000, used.rows + 1}}) {
    CutScene small(testing::unit_grid(kCells, GetParam()), reserve);
    small.move(wide_blade(-0.5, 0.3), wide_blade(0.5, 0.3));
    const auto before = testing::canonical(small.cut);
    const std::vector<CutPart> parts(small.cut.parts().begin(), small.cut.parts().end());
    const Blade across_before{{-0.5, 0.35, -0.5}, {1.5, 0.35, -0.5}}, across_after{{-0.5, 0.35, 1.5}, {1.5, 0.35, 1.5}};
    for (int attempt = 0; attempt < 2; ++attempt) {
      const Sweep sweep = small.search.sweep(across_before, across_after, small.room);
      const CutChange change = small.cut.cut(sweep.edges);
      ASSERT_TRUE(change.refused);
      EXPECT_EQ(change.refusal, reserve.parts < used.parts + 100000 ? CutRefusal::kPartsFull : CutRefusal::kRowsFull);
      EXPECT_NE(words(change.refusal).find("larger reserve"), std::string_view::npos);
      EXPECT_EQ(testing::canonical(small.cut), before);
      ASSERT_EQ(small.cut.parts().size(), parts.size());
      for (std::size_t i = 0; i < parts.size(); ++i) {
        EXPECT_EQ(small.cut.parts()[i].rows, parts[i].rows);
        EXPECT_EQ(small.cut.parts()[i].next, parts[i].next);
        EXPECT_EQ(small.cut.parts()[i].parent, parts[i].parent);
      }
    }
    for (std::uint32_t element = 0; element < small.topology.element_count(); ++element) {
      testing::expect_sound_parts(small.cut, element);
    }
    const std::array unknown{CutEdge{small.topology.edge_count(), 0.5}};
    EXPECT_EQ(small.cut.cut(unknown).refusal, CutRefusal::kUnknownEdge);
    for (const double crossing : {-0.1, 1.1, std::numeric_limits<double>::quiet_NaN()}) {
      // The first edge is good and must not stay cut.
      std::uint32_t whole = 0;
      while (small.cut.is_cut(whole)) ++whole;
      const CutChange change = small.cut.cut(std::array{CutEdge{whole, 0.5}, CutEdge{0, crossing}});
      EXPECT_TRUE(change.refused);
      EXPECT_EQ(change.refusal, CutRefusal::kCrossing);
      EXPECT_FALSE(small.cut.is_cut(whole));
    }
  }
}

TEST_P(CutOf, EditsAllocateNothing) {
  std::mt19937 random(4);
  std::vector<testing::Path> paths;
  for (int i = 0; i < 20; ++i) paths.push_back(testing::random_path(random, kCells));
  std::vector<CutPiece> room(1000);
  std::size_t parts = 0;
  const std::size_t before = tests::allocations;
  for (int round = 0; round < 2; ++round) {
    for (const testing::Path& path : paths) {
      for (std::size_t step = 1; step < path.size(); ++step) {
        scene_.cut.cut(scene_.search.sweep(path[step - 1], path[step], scene_.room).edges);
      }
      scene_.cut.pieces(room);
    }
    parts = scene_.cut.parts().size();
    scene_.cut.reset();
  }
  EXPECT_EQ(tests::allocations - before, 0u);
  EXPECT_GT(parts, 30u);
}

TEST(Cut, OfOneEdgeOfATetrahedronIsAFront) {
  CutScene scene(testing::unit_grid(1));
  const CutChange change = scene.cut.cut(std::array{CutEdge{0, 0.5}});
  EXPECT_EQ(change.edges.size(), 1u);
  EXPECT_GT(change.elements.size(), 0u);
  EXPECT_EQ(change.parts.size(), 0u);
  EXPECT_EQ(scene.cut.parts().size(), 0u);
  // A second crossing changes nothing; the first stays, off the node.
  EXPECT_EQ(scene.cut.cut(std::array{CutEdge{0, 0.9}}).edges.size(), 0u);
  EXPECT_EQ(scene.cut.crossing(0), 0.5);
  scene.cut.cut(std::array{CutEdge{1, 0.0}});
  EXPECT_EQ(scene.cut.crossing(1), kMinCrossing);
}

TEST(Cut, GoesThroughElementsOfSeveralShapes) {
  // Two blocks, tetrahedra and hexahedra, that share no nodes: one search and one state for all elements of a mesh.
  Mesh mesh = testing::unit_grid(2);
  const auto offset = static_cast<std::uint32_t>(mesh.nodes.size());
  const Mesh other = testing::unit_grid(2, Shape::kHexahedron);
  for (const Vector3d& node : other.nodes) mesh.nodes.push_back(node + Vector3d(0.0, 1.5, 0.0));
  mesh.blocks.push_back(other.blocks[0]);
  for (std::uint32_t& node : mesh.blocks[1].nodes) node += offset;
  CutScene scene(mesh);
  scene.move({{-0.5, -0.5, 0.3}, {-0.5, 3.0, 0.3}}, {{1.5, -0.5, 0.3}, {1.5, 3.0, 0.3}});
  std::array<CutPiece, 3> room;
  EXPECT_EQ(scene.cut.pieces(room), 4u) << "more than there is room for";
  EXPECT_NEAR(room[0].volume_m3, 0.3, 1e-7) << "a lattice step is 6e-8 of the box";
  for (std::uint32_t element = 0; element < scene.topology.element_count(); ++element) {
    testing::expect_sound_parts(scene.cut, element);
  }
}

}  // namespace
}  // namespace tensormass::mesh
