#include "world/hold.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace tensormass::world {

namespace {

using physics::Pose;

/// Share of the largest load to which a tool that gives way relieves itself.
constexpr double kRelieved = 0.97;
/// Share of what the tool bears in a step, below which a trial has moved it back too far.
constexpr double kLeastKept = 0.6;
/// Share of the largest load below which the tool follows the hand again.
constexpr double kRegrips = 0.8;
/// Bounds of the stiffness that trials can show, relative to that of the whole contact.
constexpr double kSoftest = 1e-4;
/// A tool that has backed off advances by this share of the way in the next step.
constexpr double kCautious = 0.125;
/// Largest speed at which a tool moves back, in its largest speeds.
constexpr double kFastestBack = 4;
/// A tool that backs off step after step stays this near to the hand, in its own sizes: it then comes back soon, and
/// does not strike the tissue at its largest speed.
constexpr double kFarthestBack = 2;

Vec3<double> load_of(const Hold::Load& load, std::size_t freedom) {
  if (freedom == 0) return load.force_n;
  if (freedom == 1) return load.torque_n_m;
  return {load.joints[freedom - 2], 0, 0};
}

Vec3<double> way_between(const Pose& from, const Pose& to, std::size_t freedom) {
  if (freedom == 0) return to.position_m - from.position_m;
  if (freedom == 1) return physics::rotation_vector(from, to);
  return {to.joint_values[freedom - 2] - from.joint_values[freedom - 2], 0, 0};
}

void move(Pose& pose, std::size_t freedom, const Vec3<double>& way) {
  if (freedom == 0) {
    pose.position_m += way;
  } else if (freedom == 1) {
    const double angle = way.norm();
    if (!(angle > 0)) return;
    const Eigen::Quaterniond turned = (Eigen::AngleAxisd(angle, way / angle) * physics::rotation(pose)).normalized();
    pose.orientation = {turned.w(), turned.x(), turned.y(), turned.z()};
  } else {
    pose.joint_values[freedom - 2] += way[0];
  }
}

}  // namespace

double Hold::largest(std::size_t freedom) const {
  if (freedom == 0) return tool_->max_force_n;
  return freedom == 1 ? tool_->max_torque_n_m : tool_->max_joint_load;
}

/// Largest load of a freedom in this step.
double Hold::bearable(std::size_t freedom, double rise) const {
  return std::min(largest(freedom),
                  load_of(start_.load, freedom).norm() + rise * kLargestRisePerS * dt_s_ * largest(freedom));
}

/// Stiffness of the contact itself in a trial: tissue behind it only makes it softer.
double Hold::stiffest(std::size_t freedom, const Load& load) const {
  const double k = tool_->stiffest_contact_n_per_m(load.young_modulus_pa);
  return freedom == 0 ? k : k * arm_m() * arm_m();
}

/// Way that the largest speed allows in a step, but not past half the tool [m].
double Hold::way_in(double dt_s) const { return std::min(tool_->max_speed_m_per_s * dt_s, tool_->radius_m / 2); }

/// Largest way of a freedom in this step [m or rad].
double Hold::way_of_step(std::size_t freedom) const { return freedom == 0 ? way_m_ : way_m_ / arm_m(); }

/// Returns the pose as near to the start of the step and as much within the ranges of the joints as it must be.
Pose Hold::within_reach(Pose pose) const {
  for (std::size_t f = 0; f < freedoms(); ++f) {
    const Vec3<double> way = way_between(start_.pose, pose, f);
    const double excess = way.norm() - kFastestBack * way_of_step(f);
    if (excess > 0) move(pose, f, -excess * way.normalized());
  }
  for (std::size_t j = 0; j < tool_->joints.size(); ++j) {
    pose.joint_values[j] = std::clamp(pose.joint_values[j], tool_->joints[j].least, tool_->joints[j].most);
  }
  return pose;
}

double Hold::share(const Load& load, double rise) const {
  double share = 0;
  for (std::size_t f = 0; f < freedoms(); ++f) {
    const double one = load_of(load, f).norm() / bearable(f, rise);
    if (!(one <= std::numeric_limits<double>::max())) return std::numeric_limits<double>::infinity();
    share = std::max(share, one);
  }
  return share;
}

Pose Hold::begin(const Pose& start, const Load& load, const Pose& wanted, double dt_s) {
  start_ = last_ = {start, load};
  wanted_ = wanted;
  dt_s_ = dt_s;
  way_m_ = way_in(dt_s);
  gives_way_ = has_over_ = false;
  Pose end = wanted;
  if (state_.reach_m > 0) {
    double way = (wanted.position_m - start.position_m).norm();
    for (std::size_t f = 1; f < freedoms(); ++f) way = std::max(way, arm_m() * way_between(start, wanted, f).norm());
    if (way > state_.reach_m) {
      end = physics::between(start, wanted, state_.reach_m / way);
      gives_way_ = true;
    } else {
      state_.reach_m = 0;
    }
  }
  for (std::size_t f = 0; f < freedoms(); ++f) {
    const double size = load_of(load, f).norm();
    double& k = state_.stiffness[f];
    if (k == 0) continue;
    if (size == 0) {
      // Contact is lost, and the hand is ahead: the tool must not come back at its largest speed.
      k = 0;
      state_.reach_m = kCautious * way_m_;
      continue;
    }
    const Vec3<double> out = load_of(load, f) / size;
    const double advance = -out.dot(way_between(start, end, f));
    const double borne = (kRelieved * bearable(f, kAims) - size) / k;
    if (advance > borne) {
      move(end, f, (advance - borne) * out);
      gives_way_ = true;
    } else if (size < kRegrips * largest(f)) {
      k = 0;
    }
  }
  return gives_way_ ? within_reach(end) : end;
}

Pose Hold::give_way(const Pose& tried, const Load& load) {
  gives_way_ = true;
  if (too_far_back(load)) {
    last_ = {tried, load};
    return physics::between(tried, over_, 0.5);
  }
  over_ = tried;
  has_over_ = true;
  Pose end = tried;
  for (std::size_t f = 0; f < freedoms(); ++f) {
    const Vec3<double> q = load_of(load, f);
    const double size = q.norm();
    if (!(size > bearable(f, kAims))) continue;
    const Vec3<double> out = q / size;
    const double advance = -out.dot(way_between(last_.pose, tried, f));
    const double rise = size - out.dot(load_of(last_.load, f));
    double& k = state_.stiffness[f];
    double shown = rise / advance;
    const double most = stiffest(f, load);
    if (!(std::isfinite(shown) && shown > 0)) shown = k > 0 ? k / 2 : most;
    k = std::clamp(shown, kSoftest * most, most);
    move(end, f, std::min((size - kRelieved * bearable(f, kAims)) / k, kFastestBack * way_of_step(f)) * out);
  }
  last_ = {tried, load};
  return within_reach(end);
}

Pose Hold::back_off(double distance, const Load& tried, const Vec3<double>& hand_m) {
  gives_way_ = true;
  has_over_ = false;
  Pose end = start_.pose;
  const double distance_m = distance * way_m_;
  for (const Vec3<double>& out :
       {start_.load.force_n, tried.force_n, Vec3<double>(start_.pose.position_m - wanted_.position_m)}) {
    const double size = out.norm();
    if (!(size > 0 && std::isfinite(size))) continue;
    end.position_m += out * (distance_m / size);
    break;
  }
  const Vec3<double> back = end.position_m - hand_m;
  const double farthest_m = std::max(kFarthestBack * arm_m(), (start_.pose.position_m - hand_m).norm());
  if (back.norm() > farthest_m) end.position_m = hand_m + farthest_m * back.normalized();
  for (std::size_t j = 0; j < tool_->joints.size(); ++j) {
    const double load = start_.load.joints[j] != 0 ? start_.load.joints[j] : tried.joints[j];
    if (load != 0 && std::isfinite(load)) end.joint_values[j] += std::copysign(distance_m / arm_m(), load);
  }
  end = within_reach(end);
  state_.reach_m =
      std::max(kCautious * std::max(distance_m, (wanted_.position_m - end.position_m).norm()), 1e-3 * way_m_);
  return end;
}

bool Hold::too_far_back(const Load& load) const { return has_over_ && share(load, kAims) < kLeastKept; }

void Hold::wait(double time_s, double dt_s) {
  // end_step doubles the reach.
  state_.reach_m = std::max(way_in(dt_s) * std::exp2(-time_s / dt_s), std::numeric_limits<double>::min());
}

void Hold::end_step() { state_.reach_m *= 2; }

}  // namespace tensormass::world
