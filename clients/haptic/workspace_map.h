#pragma once

// Places the small workspace of a haptic device in the scene:
//
//     p_scene = scene_center_m + scale · R (p_device − device_center_m)          q_scene = R q_device
//     F_device = Rᵀ F_scene
//
// p position, q orientation, F force on the hand, R rotation.
//
// The force is rotated and not scaled: 1 N in the scene is 1 N in the hand, whatever the scale. The hand then feels a
// spring of the scene as `scale` times as stiff, because it moves 1/scale as far against the same force. DeviceInfo
// states the device's limits in the scene's frame, so they are divided by the scale (to_scene). Energy of the hand and
// energy in the scene also differ by that constant factor. What is passive in the scene is therefore passive in the
// hand, and the passivity controller of the loop, which counts in the scene, remains right.
//
// Units: m, N. Pure functions, for any thread.

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "haptic/device.h"

namespace tensormass::haptic {

struct WorkspaceMap {
  /// Point of the device's frame that lies on scene_center_m.
  Eigen::Vector3d device_center_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d scene_center_m = Eigen::Vector3d::Zero();
  /// From the device's frame to the scene's. Must be a unit quaternion.
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  /// Metres in the scene for a metre of the hand. Must be positive.
  double scale = 1.0;

  DevicePose to_scene(const DevicePose& device) const {
    return {scene_center_m + scale * (rotation * (device.position_m - device_center_m)), rotation * device.orientation};
  }

  Eigen::Vector3d force_to_device(const Eigen::Vector3d& force_n) const { return rotation.conjugate() * force_n; }

  /// The device's limits as the scene sees them.
  DeviceInfo to_scene(DeviceInfo device) const {
    device.max_stiffness_n_per_m /= scale;
    device.max_damping_n_s_per_m /= scale;
    return device;
  }
};

/// The rotation about the scene's axes x, y and z, in this order [degrees].
inline Eigen::Quaterniond rotation_about_axes(const Eigen::Vector3d& angles_deg) {
  const Eigen::Vector3d angles = angles_deg * (EIGEN_PI / 180.0);
  return Eigen::AngleAxisd(angles.z(), Eigen::Vector3d::UnitZ()) *
         Eigen::AngleAxisd(angles.y(), Eigen::Vector3d::UnitY()) *
         Eigen::AngleAxisd(angles.x(), Eigen::Vector3d::UnitX());
}

}  // namespace tensormass::haptic
