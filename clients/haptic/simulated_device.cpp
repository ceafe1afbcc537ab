#include "haptic/simulated_device.h"

#include <algorithm>
#include <cmath>

#include "haptic/checks.h"

namespace tensormass::haptic {
namespace {

// The target is constant within a sub-step. At 0.1 ms its jumps are far below the resolution of a 1 kHz loop.
constexpr std::int64_t kStepNs = 100'000;
constexpr double kStepS = static_cast<double>(kStepNs) / kNsPerS;
// Longer stalls, of a stopped process for example, are skipped. Replaying them would take the whole tick.
constexpr std::int64_t kMaxStepsAtOnce = 10'000;

// Returns exp(A h), which advances (x, x')ᵀ of x'' = −stiffness x − damping x' by h. Both are per mass: [1/s²], [1/s].
// With s = −damping/2 and d² = s² − stiffness it is e^{sh} [cosh(dh) I + sinh(dh)/d (A − s I)]; for d² < 0 cosh and
// sinh become cos and sin.
Eigen::Matrix2d oscillator_transition(double stiffness, double damping, double h) {
  const Eigen::Matrix2d a{{0.0, 1.0}, {-stiffness, -damping}};
  const double s = -0.5 * damping;
  const double d_squared = s * s - stiffness;
  const double d = std::sqrt(std::abs(d_squared));
  // sin(dh)/d and sinh(dh)/d both tend to h.
  const bool critical = d * h < 1e-8;
  double even = 0.0, odd = 0.0;
  if (d_squared < 0.0) {
    const double decay = std::exp(s * h);
    even = decay * std::cos(d * h);
    odd = decay * (critical ? h : std::sin(d * h) / d);
  } else {
    // One exponential for each mode, e^{(s±d)h}: for a stiff damper e^{sh} underflows and cosh(dh) overflows. The sum
    // s + d would cancel, so it is computed as stiffness / (s − d). This is safe, because s is negative here.
    const double slow = std::exp(stiffness / (s - d) * h), fast = std::exp((s - d) * h);
    even = 0.5 * (slow + fast);
    odd = slow * (critical ? h : -std::expm1(-2.0 * d * h) / (2.0 * d));
  }
  return even * Eigen::Matrix2d::Identity() + odd * (a - s * Eigen::Matrix2d::Identity());
}

Oscillator oscillator_of(double mass, double stiffness, double damping) {
  Oscillator o;
  o.transition = oscillator_transition(stiffness / mass, damping / mass, kStepS);
  // With transition matrix Φ, a constant u rests at x = u / stiffness, so its response over a sub-step is
  // (I − Φ) (1/stiffness, 0)ᵀ u, with stiffness and u per mass.
  o.input = (Eigen::Matrix2d::Identity() - o.transition).col(0) / (stiffness / mass);
  return o;
}

/// Advances x and v by a sub-step. `u` is per mass.
template <class Value>
void advance(const Oscillator& o, const Value& u, Value& x, Value& v) {
  const Value position = o.transition(0, 0) * x + o.transition(0, 1) * v;
  const Value velocity = o.transition(1, 0) * x + o.transition(1, 1) * v;
  x = position + o.input(0) * u;
  v = velocity + o.input(1) * u;
}

Eigen::Quaterniond rotation_of(const Eigen::Vector3d& vector_rad) {
  return Eigen::Quaterniond(Eigen::AngleAxisd(vector_rad.norm(), vector_rad.stableNormalized()));
}

}  // namespace

SimulatedDevice::SimulatedDevice(const SimulatedDeviceOptions& options, const HandScript& script, Clock& clock)
    : options_(options), script_(script), clock_(clock) {
  if (!options_.jaw_angle_rad) options_.info.max_jaw_torque_n_m = 0.0;
}

Result<void> SimulatedDevice::open() {
  if (!is_positive(options_.mass_kg) || !is_positive(options_.hand_stiffness_n_per_m)) {
    return invalid("simulated device: mass [kg] and the hand's stiffness [N/m] must be positive and finite");
  }
  if (!is_not_negative(options_.damping_n_s_per_m) || !is_not_negative(options_.hand_damping_n_s_per_m)) {
    return invalid("simulated device: damping [N s/m] must be finite and not negative");
  }
  if (!is_positive(options_.inertia_kg_m2) || !is_positive(options_.hand_angular_stiffness_n_m_per_rad)) {
    return invalid("simulated device: inertia [kg m²] and the hand's stiffness [N m/rad] must be positive and finite");
  }
  if (!is_not_negative(options_.angular_damping_n_m_s) || !is_not_negative(options_.hand_angular_damping_n_m_s)) {
    return invalid("simulated device: damping [N m s] must be finite and not negative");
  }
  if (const double jaws_rad = options_.jaw_angle_rad.value_or(0.0); !(jaws_rad >= 0 && jaws_rad <= kMaxJawAngleRad)) {
    return invalid("simulated device: the jaws' angle [rad] is out of its range");
  }
  translation_ = oscillator_of(options_.mass_kg, options_.hand_stiffness_n_per_m,
                               options_.hand_damping_n_s_per_m + options_.damping_n_s_per_m);
  rotation_ = oscillator_of(options_.inertia_kg_m2, options_.hand_angular_stiffness_n_m_per_rad,
                            options_.hand_angular_damping_n_m_s + options_.angular_damping_n_m_s);
  const HandScript::Target start = script_.at(0.0);
  position_m_ = start.position_m;
  velocity_m_per_s_.setZero();
  turn_rad_.setZero();
  turning_rad_per_s_.setZero();
  jaws_rad_ = options_.jaw_angle_rad.value_or(0.0);
  jaws_rad_per_s_ = 0.0;
  held_ = {};
  start_ns_ = clock_.now_ns();
  steps_done_ = 0;
  open_ = true;
  return {};
}

Result<DevicePose> SimulatedDevice::read() {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "simulated device: read before open");
  advance_to_now();
  DevicePose pose{position_m_, rotation_of(turn_rad_)};
  // The stops of the jaws.
  if (options_.jaw_angle_rad) pose.jaw_angle_rad = std::clamp(jaws_rad_, 0.0, kMaxJawAngleRad);
  pose.pressed = options_.presses_button && script_.circles(static_cast<double>(steps_done_) * kStepS);
  return pose;
}

Result<void> SimulatedDevice::write(const Wrench& wrench) {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "simulated device: write before open");
  advance_to_now();
  held_ = wrench;
  return {};
}

void SimulatedDevice::close() noexcept {
  held_ = {};
  open_ = false;
}

void SimulatedDevice::advance_to_now() {
  const std::int64_t due = (clock_.now_ns() - start_ns_) / kStepNs;
  steps_done_ = std::max(steps_done_, due - kMaxStepsAtOnce);
  for (; steps_done_ < due; ++steps_done_) step(static_cast<double>(steps_done_) * kStepS);
}

void SimulatedDevice::step(double time_s) {
  // The target at the middle of the sub-step is used for the whole sub-step.
  const HandScript::Target target = script_.at(time_s + 0.5 * kStepS);
  const Eigen::Vector3d input = (held_.force_n + options_.hand_stiffness_n_per_m * target.position_m +
                                 options_.hand_damping_n_s_per_m * target.velocity_m_per_s) /
                                options_.mass_kg;
  advance(translation_, input, position_m_, velocity_m_per_s_);
  advance<Eigen::Vector3d>(rotation_, held_.torque_n_m / options_.inertia_kg_m2, turn_rad_, turning_rad_per_s_);
  if (!options_.jaw_angle_rad) return;
  const double grip_n_m = options_.hand_angular_stiffness_n_m_per_rad * *options_.jaw_angle_rad;
  advance(rotation_, (held_.jaw_torque_n_m + grip_n_m) / options_.inertia_kg_m2, jaws_rad_, jaws_rad_per_s_);
}

}  // namespace tensormass::haptic
