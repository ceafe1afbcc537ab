#include "haptic/hand_motion.h"

#include <Eigen/Geometry>

namespace tensormass::haptic {

HandMotion motion_between(const DevicePose& from, const DevicePose& to) {
  HandMotion motion;
  motion.moved_m = to.position_m - from.position_m;
  // A device's quaternion may be off unit length by 1 %.
  const Eigen::AngleAxisd turn(to.orientation.normalized() * from.orientation.normalized().conjugate());
  motion.turned_rad = turn.angle() * turn.axis();
  if (from.jaw_angle_rad && to.jaw_angle_rad) motion.jaws_opened_rad = *to.jaw_angle_rad - *from.jaw_angle_rad;
  return motion;
}

}  // namespace tensormass::haptic
