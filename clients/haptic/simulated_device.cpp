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

}  // namespace

SimulatedDevice::SimulatedDevice(const SimulatedDeviceOptions& options, const HandScript& script, Clock& clock)
    : options_(options), script_(script), clock_(clock) {}

Result<void> SimulatedDevice::open() {
  if (!is_positive(options_.mass_kg) || !is_positive(options_.hand_stiffness_n_per_m)) {
    return invalid("simulated device: mass [kg] and the hand's stiffness [N/m] must be positive and finite");
  }
  if (!is_not_negative(options_.damping_n_s_per_m) || !is_not_negative(options_.hand_damping_n_s_per_m)) {
    return invalid("simulated device: damping [N s/m] must be finite and not negative");
  }
  const double stiffness = options_.hand_stiffness_n_per_m / options_.mass_kg;
  const double damping = (options_.hand_damping_n_s_per_m + options_.damping_n_s_per_m) / options_.mass_kg;
  transition_ = oscillator_transition(stiffness, damping, kStepS);
  // With transition matrix Φ, a constant force u per mass rests at x = u / stiffness, so its response over a sub-step
  // is (I − Φ) (1/stiffness, 0)ᵀ u.
  input_ = (Eigen::Matrix2d::Identity() - transition_).col(0) / stiffness;
  const HandScript::Target start = script_.at(0.0);
  position_m_ = start.position_m;
  velocity_m_per_s_.setZero();
  force_n_.setZero();
  start_ns_ = clock_.now_ns();
  steps_done_ = 0;
  open_ = true;
  return {};
}

Result<DevicePose> SimulatedDevice::read() {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "simulated device: read before open");
  advance_to_now();
  return DevicePose{position_m_, Eigen::Quaterniond::Identity()};
}

Result<void> SimulatedDevice::write_force(const Eigen::Vector3d& force_n) {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "simulated device: write before open");
  advance_to_now();
  force_n_ = force_n;
  return {};
}

void SimulatedDevice::close() noexcept {
  force_n_.setZero();
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
  const Eigen::Vector3d input = (force_n_ + options_.hand_stiffness_n_per_m * target.position_m +
                                 options_.hand_damping_n_s_per_m * target.velocity_m_per_s) /
                                options_.mass_kg;
  const Eigen::Vector3d position = transition_(0, 0) * position_m_ + transition_(0, 1) * velocity_m_per_s_;
  const Eigen::Vector3d velocity = transition_(1, 0) * position_m_ + transition_(1, 1) * velocity_m_per_s_;
  position_m_ = position + input_(0) * input;
  velocity_m_per_s_ = velocity + input_(1) * input;
}

}  // namespace tensormass::haptic
