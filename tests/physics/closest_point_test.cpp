#include "physics/contact/closest_point.h"

#include <algorithm>
#include <random>

#include <gtest/gtest.h>
#include <Eigen/Dense>

namespace tensormass::physics {
namespace {

using Point = Vec3<double>;

Point at(const Point (&x)[3], const Vec3<double>& w) { return x[0] * w[0] + x[1] * w[1] + x[2] * w[2]; }

double distance_to_segment(const Point& p, const Point& a, const Point& b) {
  const double squared = (b - a).squaredNorm();
  const double t = squared > 0 ? std::clamp((p - a).dot(b - a) / squared, 0.0, 1.0) : 0;
  return (p - a - t * (b - a)).norm();
}

/// Returns the distance from a triangle by cases that share nothing with the code under test: to the plane if the foot
/// lies inside, else to the nearest edge.
double brute_force_distance(const Point& p, const Point (&x)[3]) {
  const Point n = (x[1] - x[0]).cross(x[2] - x[0]).normalized();
  const Point foot = p - n * n.dot(p - x[0]);
  bool inside = true;
  for (int i = 0; i < 3; ++i) inside = inside && n.dot((x[(i + 1) % 3] - x[i]).cross(foot - x[i])) >= 0;
  if (inside) return std::abs(n.dot(p - x[0]));
  double best = 1e30;
  for (int i = 0; i < 3; ++i) best = std::min(best, distance_to_segment(p, x[i], x[(i + 1) % 3]));
  return best;
}

/// Returns the number of weights above zero: three on a face, two on an edge, one at a vertex.
int support(const Vec3<double>& weights) { return static_cast<int>((weights.array() > 0).count()); }

TEST(ClosestPoint, AgreesWithBruteForce) {
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(-1, 1);
  const auto point = [&] { return Point(uniform(random), uniform(random), uniform(random)); };
  int faces = 0, edges = 0, vertices = 0;
  for (int i = 0; i < 20'000; ++i) {
    const Point x[3] = {point(), point(), point()};
    if ((x[1] - x[0]).cross(x[2] - x[0]).norm() < 1e-3) continue;
    const Point p = 1.5 * point();
    const ClosestPoint<double> closest = closest_point_on_triangle(p, x[0], x[1], x[2]);
    ASSERT_NEAR(closest.weights.sum(), 1, 1e-12);
    ASSERT_GE(closest.weights.minCoeff(), 0);
    ASSERT_NEAR((p - at(x, closest.weights)).norm(), brute_force_distance(p, x), 1e-9) << "triangle " << i;
    if (closest.feature == TriangleFeature::kFace) {
      ++faces;
    } else if (closest.feature < TriangleFeature::kVertex0) {
      ++edges;
      const int edge = static_cast<int>(closest.feature) - static_cast<int>(TriangleFeature::kEdge01);
      EXPECT_EQ(closest.weights[(edge + 2) % 3], 0) << "a point of an edge has no weight at the opposite corner";
      EXPECT_EQ(support(closest.weights), 2);
    } else {
      ++vertices;
      EXPECT_EQ(closest.weights[static_cast<int>(closest.feature) - static_cast<int>(TriangleFeature::kVertex0)], 1);
    }
  }
  EXPECT_GT(std::min({faces, edges, vertices}), 1000) << "too few points near one kind of feature";
}

TEST(ClosestPoint, DegenerateTriangleReturnsAPointOnIt) {
  const Point a(1, 2, 3);
  const auto same = closest_point_on_triangle<double>(Point(0, 0, 0), a, a, a);
  EXPECT_TRUE(same.weights.allFinite());
  EXPECT_NEAR(same.weights.sum(), 1, 1e-12);

  const Point line[3] = {{0, 0, 0}, {1, 0, 0}, {2, 0, 0}};
  const auto flat = closest_point_on_triangle<double>(Point(1.5, 1, 0), line[0], line[1], line[2]);
  EXPECT_TRUE(flat.weights.allFinite());
  EXPECT_NEAR((at(line, flat.weights) - Point(1.5, 0, 0)).norm(), 0, 1e-12);
}

/// Compares with sampled pairs. Every eighth pair of segments is parallel, every ninth has a segment without length.
TEST(ClosestOnSegments, NoSampledPairIsCloser) {
  std::mt19937 random(11);
  std::uniform_real_distribution<double> uniform(-1, 1);
  const auto point = [&] { return Point(uniform(random), uniform(random), uniform(random)); };
  for (int i = 0; i < 2'000; ++i) {
    const Point a = point(), b = i % 9 == 0 ? a : point(), c = point(),
                d = i % 8 == 0 ? Point(c + 0.7 * (b - a)) : point();
    const SegmentPair<double> pair = closest_on_segments(a, b, c, d);
    for (const double place : {pair.first, pair.second}) ASSERT_TRUE(place >= 0 && place <= 1) << place;
    const Point p = a + pair.first * (b - a), q = c + pair.second * (d - c);
    for (int k = 0; k <= 50; ++k) {
      ASSERT_GE(distance_to_segment(a + k / 50.0 * (b - a), c, d), (p - q).norm() - 1e-12) << "pair " << i;
    }
  }
}

TEST(SegmentCrossesTriangle, FindsThePointOnBoth) {
  std::mt19937 random(12);
  std::uniform_real_distribution<double> uniform(-1, 1);
  const auto point = [&] { return Point(uniform(random), uniform(random), uniform(random)); };
  int crossings = 0;
  for (int i = 0; i < 5'000; ++i) {
    const Point x[3] = {point(), point(), point()}, p = point(), q = point();
    const SegmentCrossing<double> found = segment_crosses_triangle(p, q, x[0], x[1], x[2]);
    const double side = (x[1] - x[0]).cross(x[2] - x[0]).dot(p - x[0]) * (x[1] - x[0]).cross(x[2] - x[0]).dot(q - x[0]);
    if (!found.crosses) {
      if (side < 0) {  // the line through p and q meets the plane outside of the triangle
        const Point n = (x[1] - x[0]).cross(x[2] - x[0]);
        const Point foot = p + (q - p) * (n.dot(x[0] - p) / n.dot(q - p));
        EXPECT_GT(brute_force_distance(foot, x), 0);
      }
      continue;
    }
    ++crossings;
    EXPECT_LE(side, 0);
    EXPECT_NEAR(found.weights.sum(), 1, 1e-12);
    EXPECT_GE(found.weights.minCoeff(), -1e-12);
    EXPECT_LT((at(x, found.weights) - (p + found.fraction * (q - p))).norm(), 1e-9);
  }
  EXPECT_GT(crossings, 300);
  const Point a(0, 0, 0), b(1, 0, 0), c(0, 1, 0);
  EXPECT_FALSE(segment_crosses_triangle<double>({0.1, 0.1, 0}, {0.2, 0.1, 0}, a, b, c).crosses) << "in its plane";
}

}  // namespace
}  // namespace tensormass::physics
