#include "haptic/workspace_map.h"

#include <gtest/gtest.h>

namespace tensormass::haptic {
namespace {

WorkspaceMap turned_and_scaled() {
  // A quarter turn about z: the hand's right (x) is the scene's y.
  return {{0.0, -0.1, 0.15}, {1.0, 2.0, 3.0}, rotation_about_axes({0.0, 0.0, 90.0}), 2.0};
}

DevicePose at(const Eigen::Vector3d& position_m) { return {position_m, Eigen::Quaterniond::Identity()}; }

TEST(WorkspaceMap, TheCentreLiesOnTheCentre) {
  const WorkspaceMap map = turned_and_scaled();
  EXPECT_TRUE(map.to_scene(at({0.0, -0.1, 0.15})).position_m.isApprox(map.scene_center_m, 1e-15));
}

TEST(WorkspaceMap, RotatesAndScalesMotion) {
  const DevicePose scene = turned_and_scaled().to_scene(at({0.01, -0.1, 0.15}));
  EXPECT_TRUE(scene.position_m.isApprox(Eigen::Vector3d(1.0, 2.02, 3.0), 1e-15)) << scene.position_m;
  EXPECT_NEAR(scene.orientation.angularDistance(rotation_about_axes({0.0, 0.0, 90.0})), 0.0, 1e-7);
}

TEST(WorkspaceMap, TurnsTheGripWithTheFrame) {
  // The grip's own turn comes first, then the frame's.
  const Eigen::Quaterniond grip = rotation_about_axes({30.0, 0.0, 0.0});
  const Eigen::Quaterniond scene = turned_and_scaled().to_scene(DevicePose{Eigen::Vector3d::Zero(), grip}).orientation;
  EXPECT_TRUE((scene * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d::UnitY(), 1e-12));
}

TEST(WorkspaceMap, RotatesForcesBackAndDoesNotScaleThem) {
  const Eigen::Vector3d force = turned_and_scaled().force_to_device({0.0, 3.0, 0.5});
  EXPECT_TRUE(force.isApprox(Eigen::Vector3d(3.0, 0.0, 0.5), 1e-12)) << force;
}

TEST(WorkspaceMap, RotatesATorqueAsAForceAndLeavesTheJaws) {
  const Wrench device = turned_and_scaled().to_device({{0.0, 3.0, 0.5}, {0.0, 0.1, 0.2}, -0.4});
  EXPECT_TRUE(device.force_n.isApprox(Eigen::Vector3d(3.0, 0.0, 0.5), 1e-12));
  EXPECT_TRUE(device.torque_n_m.isApprox(Eigen::Vector3d(0.1, 0.0, 0.2), 1e-12)) << device.torque_n_m;
  EXPECT_EQ(device.jaw_torque_n_m, -0.4);
  const DeviceInfo scene = turned_and_scaled().to_scene(DeviceInfo{"device", 3.0, 200.0, 5.0, 0.4, 2.0, 0.1, 0.3, 0.2});
  EXPECT_EQ(scene.max_torque_n_m, 0.4);
  EXPECT_EQ(scene.max_angular_stiffness_n_m_per_rad, 2.0);
  EXPECT_EQ(scene.max_angular_damping_n_m_s, 0.1);
}

// Work in the hand is work in the scene over the scale, for every motion and force: passivity survives the map.
TEST(WorkspaceMap, KeepsTheSignOfWork) {
  WorkspaceMap map = turned_and_scaled();
  map.rotation = rotation_about_axes({20.0, -50.0, 110.0});
  const Eigen::Vector3d from{0.02, -0.1, 0.1}, to{-0.03, 0.0, 0.2}, force{1.0, -2.0, 0.7};
  const Eigen::Vector3d in_scene = map.to_scene(at(to)).position_m - map.to_scene(at(from)).position_m;
  EXPECT_NEAR(map.force_to_device(force).dot(to - from), force.dot(in_scene) / map.scale, 1e-12);
}

TEST(WorkspaceMap, LeavesTheJawsAsTheyAre) {
  const DevicePose pose{Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity(), 0.4};
  EXPECT_EQ(turned_and_scaled().to_scene(pose).jaw_angle_rad, 0.4);
}

// A hand that moves 1 mm moves 2 mm in the scene, so a spring of 100 N/m there is 200 N/m in the hand.
TEST(WorkspaceMap, DividesTheLimitsOfStiffnessAndDampingByTheScale) {
  const DeviceInfo scene = turned_and_scaled().to_scene(DeviceInfo{"device", 3.0, 200.0, 5.0});
  EXPECT_EQ(scene.max_force_n, 3.0);
  EXPECT_EQ(scene.max_stiffness_n_per_m, 100.0);
  EXPECT_EQ(scene.max_damping_n_s_per_m, 2.5);
}

TEST(WorkspaceMap, RotatesAboutTheAxesOfTheSceneInTurn) {
  // -90 degrees about x: up in the device (z) is up in a scene with y up.
  const Eigen::Quaterniond y_up = rotation_about_axes({-90.0, 0.0, 0.0});
  EXPECT_TRUE((y_up * Eigen::Vector3d::UnitZ()).isApprox(Eigen::Vector3d::UnitY(), 1e-12));
  // First about x, then about the scene's z.
  const Eigen::Quaterniond both = rotation_about_axes({90.0, 0.0, 90.0});
  EXPECT_TRUE((both * Eigen::Vector3d::UnitY()).isApprox(Eigen::Vector3d::UnitZ(), 1e-12));
  EXPECT_TRUE((both * Eigen::Vector3d::UnitX()).isApprox(Eigen::Vector3d::UnitY(), 1e-12));
}

}  // namespace
}  // namespace tensormass::haptic
