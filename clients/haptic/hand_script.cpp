#include "haptic/hand_script.h"

#include <cmath>
#include <numbers>

#include <Eigen/Geometry>

#include "haptic/checks.h"

namespace tensormass::haptic {
namespace {

constexpr double kApproachEnd = 0.25;
constexpr double kPressEnd = 0.40;
constexpr double kCirclesEnd = 0.80;
constexpr double kLiftEnd = 0.95;

// Moves from `from` to `to` while u goes from 0 to 1 in `duration_s`: s = 10 u³ − 15 u⁴ + 6 u⁵ (Flash and Hogan 1985).
HandScript::Target minimum_jerk(const Eigen::Vector3d& from, const Eigen::Vector3d& to, double u, double duration_s) {
  const double s = u * u * u * (10.0 + u * (-15.0 + 6.0 * u));
  const double ds_du = 30.0 * u * u * (1.0 - u) * (1.0 - u);
  return {from + s * (to - from), ds_du / duration_s * (to - from)};
}

}  // namespace

Result<HandScript> HandScript::create(const HandScriptOptions& options) {
  if (!options.home_m.allFinite() || !options.contact_m.allFinite()) {
    return invalid("the hand's path: home and contact must be finite positions");
  }
  if (!options.direction.allFinite() || options.direction.norm() < 1e-12) {
    return invalid("the hand's path: the direction of the press is zero or not finite; give one as 0,0,-1");
  }
  if (!is_positive(options.period_s)) return invalid("the hand's path: the period must be positive and finite [s]");
  if (!is_not_negative(options.depth_m)) {
    return invalid("the hand's path: the depth must be finite and not negative [m]");
  }
  if (!is_not_negative(options.circle_radius_m) || !is_not_negative(options.circle_count)) {
    return invalid("the hand's path: radius and count of the circles must be finite and not negative");
  }
  return HandScript(options);
}

HandScript::HandScript(const HandScriptOptions& options) : options_(options) {
  options_.direction.normalize();
  bottom_m_ = options_.contact_m + options_.depth_m * options_.direction;
  tangent_u_ = options_.direction.unitOrthogonal();
  tangent_v_ = options_.direction.cross(tangent_u_);
}

double HandScript::phase(double time_s) const {
  return time_s / options_.period_s - std::floor(time_s / options_.period_s);
}

bool HandScript::circles(double time_s) const {
  const double now = phase(time_s);
  return now >= kPressEnd && now < kCirclesEnd;
}

HandScript::Target HandScript::at(double time_s) const {
  const double period = options_.period_s;
  const double phase = this->phase(time_s);
  const auto segment = [&](double begin, double end, const Eigen::Vector3d& from, const Eigen::Vector3d& to) {
    return minimum_jerk(from, to, (phase - begin) / (end - begin), (end - begin) * period);
  };
  if (phase < kApproachEnd) return segment(0.0, kApproachEnd, options_.home_m, options_.contact_m);
  if (phase < kPressEnd) return segment(kApproachEnd, kPressEnd, options_.contact_m, bottom_m_);
  if (phase < kCirclesEnd) {
    if (options_.circle_radius_m == 0.0) return {bottom_m_, Eigen::Vector3d::Zero()};
    // The radius follows sin²(πu), so the circles start and end at rest.
    const double u = (phase - kPressEnd) / (kCirclesEnd - kPressEnd);
    const double du_dt = 1.0 / ((kCirclesEnd - kPressEnd) * period);
    const double radius = options_.circle_radius_m * std::pow(std::sin(std::numbers::pi * u), 2);
    const double dradius_du = options_.circle_radius_m * std::numbers::pi * std::sin(2.0 * std::numbers::pi * u);
    const double dangle_du = 2.0 * std::numbers::pi * options_.circle_count;
    const double angle = dangle_du * u;
    const Eigen::Vector3d radial = std::cos(angle) * tangent_u_ + std::sin(angle) * tangent_v_;
    const Eigen::Vector3d along = std::cos(angle) * tangent_v_ - std::sin(angle) * tangent_u_;
    return {bottom_m_ + radius * radial, du_dt * (dradius_du * radial + radius * dangle_du * along)};
  }
  if (phase < kLiftEnd) return segment(kCirclesEnd, kLiftEnd, bottom_m_, options_.home_m);
  return {options_.home_m, Eigen::Vector3d::Zero()};
}

}  // namespace tensormass::haptic
