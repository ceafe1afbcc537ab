#include "haptic/hand_motion.h"

#include <gtest/gtest.h>

namespace tensormass::haptic {
namespace {

Eigen::Quaterniond turned_by(const Eigen::Vector3d& vector_rad) {
  return Eigen::Quaterniond(Eigen::AngleAxisd(vector_rad.norm(), vector_rad.stableNormalized()));
}

TEST(HandMotion, IsTheDifferenceOfTwoPosesInTheScenesAxes) {
  const Eigen::Vector3d turn(0.01, -0.02, 0.03);
  const Eigen::Quaterniond start = turned_by({1.0, 2.0, -0.5});
  const DevicePose from{{0.1, 0.2, 0.3}, start, 0.4}, to{{0.2, 0.2, 0.1}, turned_by(turn) * start, 0.3};
  const HandMotion motion = motion_between(from, to);
  EXPECT_TRUE(motion.moved_m.isApprox(Eigen::Vector3d(0.1, 0.0, -0.2)));
  EXPECT_TRUE(motion.turned_rad.isApprox(turn, 1e-12)) << motion.turned_rad;
  EXPECT_DOUBLE_EQ(motion.jaws_opened_rad, 0.3 - 0.4);
}

TEST(HandMotion, TakesTheShortWayAndNoWayForTheSameRotation) {
  const Eigen::Quaterniond q = turned_by({0.0, 0.0, 0.1});
  const Eigen::Quaterniond same(-1.009 * q.w(), -1.009 * q.x(), -1.009 * q.y(), -1.009 * q.z());
  EXPECT_LT(rotation_between(q, same).norm(), 1e-12) << "the other sign and length of one rotation";
  EXPECT_EQ(rotation_between(q, q).norm(), 0.0);
  EXPECT_TRUE(rotation_between(turned_by({0.0, 0.0, 3.0}), turned_by({0.0, 0.0, -3.0}))
                  .isApprox(Eigen::Vector3d(0.0, 0.0, 2.0 * EIGEN_PI - 6.0), 1e-9));
}

TEST(HandMotion, JawsThatOnePoseLacksDoNotMove) {
  const DevicePose without, with{Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity(), 0.5};
  EXPECT_EQ(motion_between(without, with).jaws_opened_rad, 0.0);
  EXPECT_EQ(motion_between(with, without).jaws_opened_rad, 0.0);
}

}  // namespace
}  // namespace tensormass::haptic
