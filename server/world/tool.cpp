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

/// Returns the pose that a way from one pose to another comes to, if no point may move farther than reach_m. Sets the
/// poses of the shape at both ends.
Pose ToolMotion::approach(const Pose& from, const Pose& to, double reach_m) {
  from_ = shape_of(from);
  to_ = shape_of(to);
  // The shape must not jump through tissue, so the speed of its core points is limited, for rotations too.
  const double way = longest_way(from_, to_);
  if (way <= reach_m) return to;
  to_ = physics::between(from_, to_, reach_m / way);
  Pose reached = to_;
  reached.position_m = to_.position_m - lever(to_);
  return reached;
}

/// Returns a load with its torque about the tool's position.
backend::ToolForce ToolMotion::on_hand(const backend::ToolForce& load) const {
  backend::ToolForce out = load;
  out.torque_n_m += lever().cross(load.force_n);
  return out;
}

/// Puts the tool, and the hand of one with a mass, at a pose.
void ToolMotion::jump(const Pose& pose) {
  current_.pose = pose;
  current_.hand_m = pose.position_m;
  current_.velocity_m_per_s.setZero();
  felt_ = {};
  felt_.position_m = pose.position_m;
}

void ToolMotion::leave(double dt_s) {
  current_.leaves = true;
  hold_.wait(kFadeS, dt_s);
}

void ToolMotion::come_out(const Pose& pose, double dt_s) {
  jump(pose);
  current_.leaves = false;
  current_.fade = kLetGo;
  comes_back_ = true;
  hold_.restore({});
  hold_.wait(kFadeS, dt_s);
}

void ToolMotion::move(double dt_s, const backend::ToolForce& load) {
  before_ = current_;
  dt_s_ = dt_s;
  current_.target_age_s += dt_s;
  const bool valid = current_.target_age_s <= valid_for_s_;
  // A retired tool may jump: it touches nothing.
  if (retired() && valid) jump(target_);
  const double rises_s = valid && !current_.leaves ? dt_s : -dt_s;
  current_.fade = planned_fade_ = std::clamp(current_.fade + rises_s / kFadeS, 0.0, 1.0);
  comes_back_ = comes_back_ && !present() && !retired();

  const double reach_m = tool_->max_speed_m_per_s * dt_s;
  Pose hand = current_.pose;
  if (has_mass()) hand.position_m = current_.hand_m;
  hand = approach(hand, target_, reach_m);
  if (has_mass()) {
    pull(hand, dt_s);
  } else {
    current_.pose = hand;
    current_.hand_m = hand.position_m;
  }
  if (tool_->fixed) return;
  const Pose end = hold_.begin(before_.pose, on_hand(load), current_.pose, dt_s);
  if (hold_.gives_way()) {
    end_at(end);
  } else {
    slip();
  }
}

void ToolMotion::give_way(const backend::ToolForce& load) { end_at(hold_.give_way(current_.pose, on_hand(load))); }

void ToolMotion::back_off(double distance, const backend::ToolForce& tried) {
  current_.fade = planned_fade_;
  end_at(hold_.back_off(distance, on_hand(tried), target_.position_m));
}

/// Moves the end of the step.
void ToolMotion::end_at(const Pose& pose) {
  current_.pose = pose;
  to_ = shape_of(pose);
  if (!has_mass()) return;
  current_.velocity_m_per_s = (pose.position_m - before_.pose.position_m) / dt_s_;
  slip();
}

/// Lets the hand of a tool with a mass slip, so that the coupling does not pull by more than the largest force.
void ToolMotion::slip() {
  if (!has_mass()) return;
  const Vec3<double> force_n = force_on_hand_n();
  const double size = force_n.norm();
  if (!(size > tool_->max_force_n)) return;
  current_.hand_m_per_s = current_.velocity_m_per_s;
  current_.hand_m =
      current_.pose.position_m - force_n * (tool_->max_force_n / (size * tool_->coupling_stiffness_n_per_m));
}

/// Moves a tool with a mass by the coupling to the hand's new place.
void ToolMotion::pull(const Pose& hand, double dt_s) {
  const Coupling coupling{tool_->mass_kg, tool_->coupling_stiffness_n_per_m, tool_->coupling_damping_n_s_per_m};
  const Vec3<double> start_m = current_.pose.position_m;
  current_.hand_m_per_s = (hand.position_m - current_.hand_m) / dt_s;
  current_.hand_m = hand.position_m;
  Pose pulled = hand;
  pulled.position_m = start_m + dt_s * coupled_velocity(coupling, start_m, current_.velocity_m_per_s, current_.hand_m,
                                                        current_.hand_m_per_s, felt_, dt_s);
  current_.pose = approach(current_.pose, pulled, tool_->max_speed_m_per_s * dt_s);
  current_.velocity_m_per_s = (current_.pose.position_m - start_m) / dt_s;
}

void ToolMotion::feel(const Vec3<double>& force_n, const Mat3<double>& stiffness_n_per_m, double modulus_pa) {
  felt_ = world::feel(felt_, current_.pose.position_m, force_n, stiffness_n_per_m,
                      tool_->stiffest_contact_n_per_m(modulus_pa));
}

}  // namespace tensormass::world
