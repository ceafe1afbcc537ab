#pragma once

// Places the small workspace of a haptic device in the scene:
//
//     p_scene = scene_center_m + scale · R (p_device − device_center_m)          q_scene = R q_device
//     F_device = Rᵀ F_scene          M_device = Rᵀ M_scene
//
// p position, q orientation, F force and M torque on the hand, R rotation.
//
// The force is rotated and not scaled: 1 N in the scene is 1 N in the hand, whatever the scale. The hand then feels a
// spring of the scene as `scale` times as stiff, because it moves 1/scale as far against the same force. DeviceInfo
// states the device's limits in the scene's frame, so they are divided by the scale (to_scene). Energy of the hand and
// energy in the scene also differ by that constant factor. What is passive in the scene is therefore passive in the
// hand, and the passivity controller of the loop, which counts in the scene, remains right.
//
// A torque is not scaled either, and angles are the same in hand and scene.
//
// Units: m, N, N m. Pure functions, for any thread.

#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "haptic/checks.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// The part of the scene in which a device works.
struct Workspace {
  /// The grip's place in the scene when the device opens. From there it moves relative to its first position, so the
  /// tool neither jumps nor appears inside tissue, however the device is mounted.
  Eigen::Vector3d scene_center_m = Eigen::Vector3d::Zero();
  /// From the device's frame (x to the right, y forward, z up) to the scene's.
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  /// Metres in the scene for a metre of the hand.
  double scale = 1.0;
};

/// Fails with kInvalidArgument on a workspace without meaning. device: its name, for the message.
inline Result<void> check(const Workspace& workspace, const std::string& device) {
  if (!is_positive(workspace.scale)) return invalid(device + ": the workspace's scale must be positive and finite");
  if (!is_position(workspace.scene_center_m) || !is_rotation(workspace.rotation)) {
    return invalid(device + ": the workspace's centre and rotation must be finite, the rotation a unit quaternion");
  }
  return {};
}

struct WorkspaceMap {
  /// Point of the device's frame that lies on scene_center_m.
  Eigen::Vector3d device_center_m = Eigen::Vector3d::Zero();
  Eigen::Vector3d scene_center_m = Eigen::Vector3d::Zero();
  /// From the device's frame to the scene's. Must be a unit quaternion.
  Eigen::Quaterniond rotation = Eigen::Quaterniond::Identity();
  /// Metres in the scene for a metre of the hand. Must be positive.
  double scale = 1.0;

  DevicePose to_scene(const DevicePose& device) const {
    return {scene_center_m + scale * (rotation * (device.position_m - device_center_m)), rotation * device.orientation,
            device.jaw_angle_rad, device.pressed};
  }

  Eigen::Vector3d force_to_device(const Eigen::Vector3d& force_n) const { return rotation.conjugate() * force_n; }
  Wrench to_device(const Wrench& scene) const {
    return {force_to_device(scene.force_n), rotation.conjugate() * scene.torque_n_m, scene.jaw_torque_n_m};
  }

  /// The device's limits as the scene sees them.
  DeviceInfo to_scene(DeviceInfo device) const {
    device.max_stiffness_n_per_m /= scale;
    device.max_damping_n_s_per_m /= scale;
    return device;
  }
};

/// Returns the map that puts the device's first position on the workspace's centre.
inline WorkspaceMap map_from(const Eigen::Vector3d& first_position_m, const Workspace& workspace) {
  return {first_position_m, workspace.scene_center_m, workspace.rotation.normalized(), workspace.scale};
}

/// The axes of a maker's frame. All devices of this client speak of x to the right, y forward (away from the hand) and
/// z up, so that one rotation of the workspace suits them all.
struct DeviceAxes {
  /// From the maker's frame to that of this client. A rotation: a reflection would turn torques the wrong way round.
  Eigen::Matrix3d turn = Eigen::Matrix3d::Identity();

  Eigen::Vector3d from_maker(const Eigen::Vector3d& v) const { return turn * v; }
  Eigen::Vector3d to_maker(const Eigen::Vector3d& v) const { return turn.transpose() * v; }
  /// A rotation is expressed in the other axes, so no rotation stays no rotation.
  Eigen::Quaterniond from_maker(const Eigen::Matrix3d& rotation) const {
    return Eigen::Quaterniond(Eigen::Matrix3d(turn * rotation * turn.transpose()));
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
