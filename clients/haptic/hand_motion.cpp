#include "haptic/hand_motion.h"

namespace tensormass::haptic {

Eigen::Vector3d rotation_between(const Eigen::Quaterniond& from, const Eigen::Quaterniond& to) {
  const Eigen::AngleAxisd turn(to.normalized() * from.normalized().conjugate());
  return turn.angle() * turn.axis();
}

HandMotion motion_between(const DevicePose& from, const DevicePose& to) {
  HandMotion motion;
  motion.moved_m = to.position_m - from.position_m;
  motion.turned_rad = rotation_between(from.orientation, to.orientation);
  if (from.jaw_angle_rad && to.jaw_angle_rad) motion.jaws_opened_rad = *to.jaw_angle_rad - *from.jaw_angle_rad;
  return motion;
}

}  // namespace tensormass::haptic
