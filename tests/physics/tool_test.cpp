#include "physics/tool/tool.h"

#include <cmath>
#include <random>
#include <string>

#include <gtest/gtest.h>

#include "physics/lists.h"
#include "physics/tool/pose.h"

/// Properties that every kind of tool must have. The lists are those of physics/lists.h: a new thin kind there is
/// tested here without a change. A solid has tests in tests/contact/solid_test.cpp, too.
namespace tensormass::physics {
namespace {

template <class List>
struct AsTestTypes;
template <class... Types>
struct AsTestTypes<TypeList<Types...>> {
  using All = ::testing::Types<Types...>;
};

struct ToolNames {
  template <class Kind>
  static std::string GetName(int) {
    return std::string(Kind::kName);
  }
};

template <class Kind>
class EveryTool : public ::testing::Test {
 protected:
  using Placed = PlacedTool<double>;

  double uniform(double least, double most) { return std::uniform_real_distribution<double>(least, most)(random_); }
  Vec3<double> point(double reach) { return {uniform(-reach, reach), uniform(-reach, reach), uniform(-reach, reach)}; }

  /// Returns a tool of about the size 1, anywhere and turned.
  Placed tool() {
    Placed out{};
    const Vec3<double> position = point(1);
    const Mat3<double> turned = Eigen::Quaterniond::UnitRandom().toRotationMatrix();
    for (int c = 0; c < 3; ++c) out.position_m[c] = position[c];
    for (int c = 0; c < 9; ++c) out.rotation[c] = turned(c / 3, c % 3);
    out.radius_m = uniform(0.1, 0.5);
    for (std::size_t i = 0; i < Kind::kParameters.size(); ++i) out.parameters[i] = uniform(0.5, 1.5);
    for (std::size_t i = 0; i < Kind::kJoints.size(); ++i) {
      const ToolParameter& joint = Kind::kJoints[i];
      out.joint_values[i] = joint.least + uniform(0.2, 1) * (joint.most - joint.least);
    }
    return out;
  }
  /// Returns a point of the core: between two core points, or the only one.
  Vec3<double> point_of_core(const Placed& tool) {
    if (Kind::kCorePoints == 1) return Kind::core_point(tool, 0);
    const auto i = std::uniform_int_distribution<std::uint32_t>(0, Kind::kCorePoints - 2)(random_);
    const Vec3<double> from = Kind::core_point(tool, i), to = Kind::core_point(tool, i + 1);
    return from + uniform(0, 1) * (to - from);
  }

  std::mt19937 random_{5};
};

TYPED_TEST_SUITE(EveryTool, AsTestTypes<ThinTools>::All, ToolNames);

TYPED_TEST(EveryTool, CorePointsAreOnTheCoreInOrder) {
  for (int trial = 0; trial < 50; ++trial) {
    const auto tool = this->tool();
    for (std::uint32_t i = 0; i < TypeParam::kCorePoints; ++i) {
      const Vec3<double> x = TypeParam::core_point(tool, i);
      const CorePoint<double> closest = TypeParam::closest_core_point(tool, x);
      EXPECT_LT((closest.position - x).norm(), 1e-14);
      EXPECT_NEAR(closest.place, i, 1e-14);
      EXPECT_NEAR(TypeParam::distance(tool, x), -tool.radius_m, 1e-14);
    }
  }
}

TYPED_TEST(EveryTool, NoPointOfTheCoreIsCloserThanTheDistanceSays) {
  for (int trial = 0; trial < 50; ++trial) {
    const auto tool = this->tool();
    const Vec3<double> x = this->point(3);
    const double distance = TypeParam::distance(tool, x) + tool.radius_m;
    EXPECT_NEAR((x - TypeParam::closest_core_point(tool, x).position).norm(), distance, 1e-14);
    for (int sample = 0; sample < 100; ++sample) {
      EXPECT_GE((x - this->point_of_core(tool)).norm(), distance - 1e-14);
    }
  }
}

TYPED_TEST(EveryTool, GradientIsTheDerivativeOfTheDistance) {
  constexpr double kStep = 1e-6;
  for (int trial = 0; trial < 200; ++trial) {
    const auto tool = this->tool();
    const Vec3<double> x = this->point(3), gradient = TypeParam::gradient(tool, x);
    EXPECT_NEAR(gradient.norm(), 1, 1e-14);
    for (int c = 0; c < 3; ++c) {
      const Vec3<double> h = kStep * Vec3<double>::Unit(c);
      const double slope =
          (TypeParam::distance(tool, Vec3<double>(x + h)) - TypeParam::distance(tool, Vec3<double>(x - h))) /
          (2 * kStep);
      EXPECT_NEAR(gradient[c], slope, 1e-7);
    }
  }
}

TYPED_TEST(EveryTool, ShapeMovesWithItsFrame) {
  for (int trial = 0; trial < 50; ++trial) {
    const auto tool = this->tool();
    auto moved = tool;
    const Mat3<double> turn = Eigen::Quaterniond::UnitRandom().toRotationMatrix();
    const Vec3<double> shift = this->point(2), position = turn * tool.position() + shift, x = this->point(3);
    for (int c = 0; c < 3; ++c) moved.position_m[c] = position[c];
    for (int axis = 0; axis < 3; ++axis) {
      const Vec3<double> turned = turn * tool.axis(axis);
      for (int c = 0; c < 3; ++c) moved.rotation[3 * c + axis] = turned[c];
    }
    EXPECT_NEAR(TypeParam::distance(moved, Vec3<double>(turn * x + shift)), TypeParam::distance(tool, x), 1e-13);
  }
}

TYPED_TEST(EveryTool, CorePointsMoveWithTheJointsAsJointMotionSays) {
  constexpr double kStep = 1e-6;
  for (int trial = 0; trial < 50; ++trial) {
    const auto tool = this->tool();
    for (std::size_t j = 0; j < TypeParam::kJoints.size(); ++j) {
      auto less = tool, more = tool;
      less.joint_values[j] -= kStep;
      more.joint_values[j] += kStep;
      for (std::uint32_t i = 0; i < TypeParam::kCorePoints; ++i) {
        const Vec3<double> x = TypeParam::core_point(tool, i);
        const Vec3<double> slope = (TypeParam::core_point(more, i) - TypeParam::core_point(less, i)) / (2 * kStep);
        EXPECT_LT((TypeParam::joint_motion(tool, j, x, x) - slope).norm(), 1e-9) << "core point " << i;
      }
    }
  }
}

/// Samples the triangle densely. No sample may be deeper in the tool than the best candidate.
TYPED_TEST(EveryTool, TheDeepestPointOfATriangleIsACandidate) {
  constexpr int kSamples = 40;
  for (int trial = 0; trial < 300; ++trial) {
    const auto tool = this->tool();
    const Vec3<double> x[3] = {this->point(2), this->point(2), this->point(2)};
    const auto at = [&](const Vec3<double>& w) { return Vec3<double>(x[0] * w[0] + x[1] * w[1] + x[2] * w[2]); };
    double least = 1e30;
    TypeParam::for_each_candidate(
        tool, x[0], x[1], x[2], [&](const Vec3<double>& weights, const CorePoint<double>& core) {
          EXPECT_NEAR(weights.sum(), 1, 1e-12);
          EXPECT_GE(weights.minCoeff(), -1e-12);
          EXPECT_LT((TypeParam::closest_core_point(tool, core.position).position - core.position).norm(), 1e-13);
          EXPECT_NEAR(TypeParam::closest_core_point(tool, core.position).place, core.place, 1e-12);
          const double distance = (at(weights) - core.position).norm() - tool.radius_m;
          EXPECT_GE(distance, TypeParam::distance(tool, at(weights)) - 1e-13);
          least = std::min(least, distance);
        });
    for (int i = 0; i <= kSamples; ++i) {
      for (int j = 0; i + j <= kSamples; ++j) {
        const Vec3<double> weights = Vec3<double>(i, j, kSamples - i - j) / kSamples;
        ASSERT_GE(TypeParam::distance(tool, at(weights)), least - 1e-12) << "triangle " << trial;
      }
    }
  }
}

TEST(Pose, BetweenIsExactAtTheStartAndReachesTheEnd) {
  const Pose from{{1, 2, 3}, {1, 0, 0, 0}, {0.5}}, to{{2, 0, 3}, {std::sqrt(0.5), 0, std::sqrt(0.5), 0}, {1.5}};
  const Pose start = between(from, to, 0), half = between(from, to, 0.5), end = between(from, to, 1);
  EXPECT_EQ(start.position_m, from.position_m);
  EXPECT_EQ(start.orientation, from.orientation);
  EXPECT_LT((half.position_m - Vec3<double>(1.5, 1, 3)).norm(), 1e-15);
  EXPECT_NEAR(half.joint_values[0], 1, 1e-15);
  EXPECT_NEAR(rotation_vector(from, half)[1], M_PI / 4, 1e-14);
  EXPECT_LT((end.position_m - to.position_m).norm(), 1e-15);
  EXPECT_NEAR(rotation(end).angularDistance(rotation(to)), 0, 1e-7);
}

TEST(Pose, RotationVectorIsAngleTimesAxisOfTheShorterTurn) {
  const Vec3<double> axis = Vec3<double>(1, -2, 0.5).normalized();
  const auto turned = [&](double angle, double sign) {
    const Eigen::Quaterniond q(Eigen::AngleAxisd(angle, axis));
    return Pose{{}, {sign * q.w(), sign * q.x(), sign * q.y(), sign * q.z()}};
  };
  for (const double angle : {0.0, 1e-9, 0.3, 3.0}) {
    for (const double sign : {1.0, -1.0}) {  // both quaternions stand for the same rotation
      EXPECT_LT((rotation_vector(turned(0.2, 1), turned(0.2 + angle, sign)) - angle * axis).norm(), 1e-12) << angle;
    }
  }
}

/// A box of 0.6 × 0.8 × 1.2 m with edges of this radius, turned.
PlacedTool<double> box(double edge_radius_m) {
  PlacedTool<double> out{};
  const Mat3<double> turned = Eigen::AngleAxisd(0.7, Vec3<double>(1, 2, 3).normalized()).toRotationMatrix();
  for (int c = 0; c < 9; ++c) out.rotation[c] = turned(c / 3, c % 3);
  for (int c = 0; c < 3; ++c) out.position_m[c] = 0.1 * c;
  const ToolParameters parameters{0.6, 0.8, 1.2, edge_radius_m};
  for (std::size_t i = 0; i < parameters.size(); ++i) out.parameters[i] = parameters[i];
  out.radius_m = BoxSolid::length_m(parameters);
  return out;
}

TEST(BoxSolid, TheWayAlongTheGradientEndsOnTheSurface) {
  constexpr double kStep = 1e-7;
  std::mt19937 random(4);
  std::uniform_real_distribution<double> uniform(-1, 1);
  for (const double edge_radius_m : {0.0, 0.1, 0.3}) {
    const auto tool = box(edge_radius_m);
    EXPECT_NEAR(BoxSolid::distance(tool, tool.position()), -0.3, 1e-12);
    for (int trial = 0; trial < 500; ++trial) {
      const Vec3<double> x(uniform(random), uniform(random), uniform(random));
      const double distance = BoxSolid::distance(tool, x);
      const Vec3<double> gradient = BoxSolid::gradient(tool, x);
      EXPECT_NEAR(gradient.norm(), 1, 1e-12);
      EXPECT_NEAR(BoxSolid::distance(tool, Vec3<double>(x - distance * gradient)), 0, 1e-12);
      // The distance has no derivative where two faces are equally near.
      Vec3<double> slope;
      for (int c = 0; c < 3; ++c) {
        const Vec3<double> h = kStep * Vec3<double>::Unit(c);
        slope[c] = (BoxSolid::distance(tool, Vec3<double>(x + h)) - BoxSolid::distance(tool, Vec3<double>(x - h))) /
                   (2 * kStep);
      }
      if (std::abs(slope.norm() - 1) > 1e-6) continue;
      EXPECT_LT((gradient - slope).norm(), 1e-6);
    }
  }
}

/// Corners are where they should be: half a diagonal away, less what the rounding takes.
TEST(BoxSolid, HasItsCornersWhereItsSizeSays) {
  for (const double r : {0.0, 0.1}) {
    const auto tool = box(r);
    const Vec3<double> corner = tool.position() + tool.to_scene(Vec3<double>(0.3, -0.4, 0.6));
    EXPECT_NEAR(BoxSolid::distance(tool, corner), r * (std::sqrt(3.0) - 1), 1e-12);
  }
}

TEST(Plane, IsSolidBelow) {
  PlacedTool<double> tool = box(0);
  const Vec3<double> x(0.3, 0.5, -0.7);
  EXPECT_NEAR(Plane::distance(tool, x), tool.axis(2).dot(x - tool.position()), 1e-15);
  EXPECT_EQ(Plane::gradient(tool, x), tool.axis(2));
  EXPECT_LT(Plane::distance(tool, Vec3<double>(tool.position() - tool.axis(2))), 0);
}

}  // namespace
}  // namespace tensormass::physics
