#include "mesh/cut_predicates.h"

#include <algorithm>
#include <limits>
#include <random>
#include <vector>

#include <gtest/gtest.h>

namespace tensormass::mesh {
namespace {

/// Points of a lattice so small that most of them lie in common planes, on common lines, or on one another.
std::vector<LatticePoint> few_places(std::uint32_t seed, std::size_t count) {
  std::mt19937 random(seed);
  std::uniform_int_distribution<std::int64_t> coordinate(0, 2);
  std::vector<LatticePoint> points;
  for (std::size_t i = 0; i < count; ++i) {
    points.push_back({{coordinate(random), coordinate(random), coordinate(random)}, 10 * i});
  }
  std::shuffle(points.begin(), points.end(), random);
  return points;
}

TEST(Orientation, OfATetrahedronIsPositive) {
  const LatticePoint o{{0, 0, 0}, 0}, x{{1, 0, 0}, 1}, y{{0, 1, 0}, 2}, z{{0, 0, 1}, 3};
  EXPECT_EQ(orientation(o, x, y, z), 1);
  EXPECT_EQ(orientation(o, y, x, z), -1);
}

TEST(Orientation, IsExactForTheLargestCoordinates) {
  const std::int64_t m = kMaxLatticeCoordinate;
  // Points on the plane x + y + z = 0 and one step to each side of it.
  const LatticePoint p{{m, -m, 0}, 0}, q{{-m, 0, m}, 1}, r{{1, m - 1, -m}, 2};
  const LatticePoint below{{0, 0, -1}, 3}, above{{0, 0, 1}, 3};
  EXPECT_EQ(orientation(p, q, r, below), -orientation(p, q, r, above));
}

TEST(Orientation, ChangesSignWithEverySwap) {
  for (std::uint32_t seed = 0; seed < 2000; ++seed) {
    std::vector<LatticePoint> p = few_places(seed, 4);
    const int sign = orientation(p[0], p[1], p[2], p[3]);
    ASSERT_NE(sign, 0);
    for (std::size_t i = 0; i < 3; ++i) {
      std::swap(p[i], p[i + 1]);
      ASSERT_EQ(orientation(p[0], p[1], p[2], p[3]), -sign) << seed;
      std::swap(p[i], p[i + 1]);
    }
  }
}

/// The answers fit some points in space, although many of the given points coincide. Among five points λ_i p_i and λ_i
/// both sum to 0, with λ_i = ± the volume of the others: so the λ_i never all have one sign.
TEST(Orientation, IsThatOfOneArrangement) {
  for (std::uint32_t seed = 0; seed < 5000; ++seed) {
    const std::vector<LatticePoint> p = few_places(seed, 5);
    int sum = 0;
    for (std::size_t left_out = 0; left_out < 5; ++left_out) {
      std::vector<LatticePoint> q = p;
      q.erase(q.begin() + static_cast<long>(left_out));
      sum += (left_out % 2 == 0 ? 1 : -1) * orientation(q[0], q[1], q[2], q[3]);
    }
    ASSERT_LT(std::abs(sum), 5) << seed;
  }
}

/// A closed line crosses a closed surface an even number of times: nothing slips through an edge or a corner, and
/// nothing is crossed twice there.
TEST(Crossing, OfAClosedSurfaceIsEven) {
  std::size_t crossed = 0, degenerate = 0;
  for (std::uint32_t seed = 0; seed < 20000; ++seed) {
    const std::vector<LatticePoint> p = few_places(seed, 7);
    const int faces[4][3] = {{0, 2, 1}, {0, 1, 3}, {1, 2, 3}, {0, 3, 2}};
    std::size_t count = 0;
    for (std::size_t side = 0; side < 3; ++side) {
      for (const auto& [i, j, k] : faces) {
        const auto at = crossing(p[4 + side], p[4 + (side + 1) % 3], p[static_cast<std::size_t>(i)],
                                 p[static_cast<std::size_t>(j)], p[static_cast<std::size_t>(k)]);
        if (!at) continue;
        ++count;
        ASSERT_GE(*at, 0.0);
        ASSERT_LE(*at, 1.0);
        degenerate += *at == 0.0 || *at == 1.0;
      }
    }
    ASSERT_EQ(count % 2, 0u) << seed;
    crossed += count;
  }
  EXPECT_GT(crossed, 1000u);
  EXPECT_GT(degenerate, 1000u);  // otherwise the test does not test what it should
}

TEST(Crossing, IsWhereThePlaneIs) {
  const LatticePoint p{{0, 0, 30}, 2}, q{{100, 0, 30}, 3}, r{{0, 100, 30}, 4};
  const LatticePoint a{{10, 10, 0}, 0}, b{{10, 10, 40}, 1};
  EXPECT_DOUBLE_EQ(crossing(a, b, p, q, r).value(), 0.75);
  EXPECT_DOUBLE_EQ(crossing(b, a, p, q, r).value(), 0.25);
  EXPECT_FALSE(crossing(a, {{10, 10, 29}, 1}, p, q, r));
  EXPECT_FALSE(crossing({{90, 90, 0}, 0}, {{90, 90, 40}, 1}, p, q, r));
}

TEST(Crossing, PutsAllNodesOfThePlaneOnOneSide) {
  for (const std::array<std::int64_t, 3>& normal :
       {std::array<std::int64_t, 3>{0, 0, 1}, {1, 0, 0}, {1, 1, 1}, {-2, 1, 0}}) {
    // Three points of the plane through (50, 50, 50), far apart.
    const auto in_plane = [&](std::int64_t u, std::int64_t v) {
      std::array<std::int64_t, 3> at{50, 50, 50};
      const std::array<std::int64_t, 3> s{normal[1], -normal[0], 0};
      const std::array<std::int64_t, 3> t{normal[2], 0, -normal[0]}, w{0, normal[2], -normal[1]};
      const bool flat = normal[0] == 0;
      for (std::size_t i = 0; i < 3; ++i) at[i] += u * (flat ? std::int64_t{i == 0} : s[i]) + v * (flat ? w[i] : t[i]);
      return at;
    };
    const LatticePoint p{in_plane(-900, -900), 1000}, q{in_plane(900, -900), 1001}, r{in_plane(0, 1800), 1002};
    std::vector<int> sides;
    std::uint64_t index = 0;
    for (std::int64_t u = -3; u <= 3; ++u) {
      for (std::int64_t v = -3; v <= 3; ++v) sides.push_back(orientation(p, q, r, {in_plane(u, v), index++}));
    }
    EXPECT_EQ(std::count(sides.begin(), sides.end(), sides[0]), 49);
  }
}

TEST(LatticeOfABox, RoundsAndRefuses) {
  const std::vector<Eigen::Vector3d> points{{1.0, 1.0, 1.0}, {3.0, 2.0, 1.5}};
  const Lattice lattice(points);
  EXPECT_EQ(lattice.at(points[0]).value(), (std::array<std::int64_t, 3>{0, 0, 0}));
  EXPECT_EQ(lattice.at(points[1]).value(),
            (std::array<std::int64_t, 3>{kLatticeSteps, kLatticeSteps / 2, kLatticeSteps / 4}));
  EXPECT_TRUE(lattice.at({-1e4, 0.0, 0.0}));
  EXPECT_FALSE(lattice.at({-1e5, 0.0, 0.0}));
  EXPECT_FALSE(lattice.at({0.0, std::numeric_limits<double>::quiet_NaN(), 0.0}));
  EXPECT_FALSE(lattice.at({0.0, 0.0, std::numeric_limits<double>::infinity()}));
  // All nodes in one place: no side to divide.
  EXPECT_TRUE(Lattice(std::vector<Eigen::Vector3d>{{1.0, 1.0, 1.0}}).at({1.0, 1.0, 1.0}));
}

}  // namespace
}  // namespace tensormass::mesh
