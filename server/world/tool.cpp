#include "world/tool.h"

#include <algorithm>

#include "physics/lists.h"

namespace tensormass::world {

/// Returns a bound on the way of each core point, or of the surface of a solid, from one pose of the shape to another
/// [m]: the way of the shape's origin, which is straight, plus the arc about it, plus the way of its joints.
double ToolMotion::longest_way(const Pose& from, const Pose& to) const {
  const auto first = tool_->placed<double>(from, from), last = tool_->placed<double>(to, from);
  double arm = tool_->reach_m, by_joints = 0;
  physics::with_tool(tool_->kind, [&](auto kind) {
    using Kind = typename decltype(kind)::Type;
    if constexpr (!Kind::kIsSolid) {
      for (std::uint32_t i = 0; i < Kind::kCorePoints; ++i) {
        const Vec3<double> at_first = Kind::core_point(first, i), at_last = Kind::core_point(last, i);
        arm = std::max({arm, (at_first - first.position()).norm(), (at_last - last.position()).norm()});
        double way = 0;
        for (std::size_t j = 0; j < Kind::kJoints.size(); ++j) {
          way += (Kind::joint_motion(last, j, at_last, at_last) * last.joints_moved[j]).norm();
        }
        by_joints = std::max(by_joints, way);
      }
    }
  });
  return (to.position_m - from.position_m).norm() + arm * physics::rotation_vector(from, to).norm() + by_joints;
}

void ToolMotion::move(double dt_s) {
  before_ = current_;
  current_.target_age_s += dt_s;
  const bool valid = current_.target_age_s <= valid_for_s_;
  // A retired tool may jump: it touches nothing.
  if (retired() && valid) current_.pose = target_;
  current_.fade = std::clamp(current_.fade + (valid ? dt_s : -dt_s) / kFadeS, 0.0, 1.0);

  from_ = shape_of(current_.pose);
  to_ = shape_of(target_);
  // The shape must not jump through tissue, so the speed of its core points is limited, for rotations too.
  const double way = longest_way(from_, to_), reach = tool_->max_speed_m_per_s * dt_s;
  if (way > reach) {
    to_ = physics::between(from_, to_, reach / way);
    current_.pose = to_;
    current_.pose.position_m = to_.position_m - lever(to_);
  } else {
    current_.pose = target_;
  }
}

}  // namespace tensormass::world
