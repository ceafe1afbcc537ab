#include "haptic/loop.h"

#include <algorithm>
#include <cmath>
#include <random>

#include <spdlog/fmt/fmt.h>

#include "haptic/checks.h"

namespace tensormass::haptic {
namespace {

constexpr std::int64_t kDrainPollNs = 1'000'000;

/// Returns an id of a client or a session; both are from 1.
std::uint64_t random_id() {
  std::random_device random;
  return std::uniform_int_distribution<std::uint64_t>(1)(random);
}

/// Returns false for an invalid pose (see DevicePose).
bool is_valid(const DevicePose& pose) {
  const double jaws_rad = pose.jaw_angle_rad.value_or(0.0);
  return is_position(pose.position_m) && is_rotation(pose.orientation) && jaws_rad >= 0 && jaws_rad <= kMaxJawAngleRad;
}

/// Bounds the options by the device. fmin returns the device's bound if an option is NaN.
LoopOptions within(const DeviceInfo& info, LoopOptions options) {
  const auto bind = [](double& asked, double device) { asked = std::fmin(asked, device); };
  bind(options.limits.max_force_n, info.max_force_n);
  bind(options.renderer.max_stiffness_n_per_m, info.max_stiffness_n_per_m);
  bind(options.passivity.max_damping, info.max_damping_n_s_per_m);
  // A statement that is not a number counts as none.
  const auto stated = [](double device) { return is_positive(device) ? device : 0.0; };
  bind(options.torque.max_torque_n_m, stated(info.max_torque_n_m));
  bind(options.renderer.max_angular_stiffness_n_m_per_rad, stated(info.max_angular_stiffness_n_m_per_rad));
  bind(options.torque.max_damping_n_m_s, stated(info.max_angular_damping_n_m_s));
  bind(options.jaws.max_torque_n_m, stated(info.max_jaw_torque_n_m));
  bind(options.jaws.max_damping_n_m_s, stated(info.max_jaw_damping_n_m_s));
  // Power outside of 0 to 1 counts as zero: nothing burns by mistake.
  if (!(options.power_level >= 0.0 && options.power_level <= 1.0)) options.power_level = 0.0;
  if (options.client_id == 0) options.client_id = random_id();
  if (options.session == 0) options.session = random_id();
  return options;
}

}  // namespace

Loop::Loop(ForceGuard& guard, Link& link, Clock& clock, const LoopOptions& options)
    : guard_(guard),
      link_(link),
      clock_(clock),
      options_(within(guard.info(), options)),
      period_s_(1.0 / options_.rate_hz),
      renderer_(options_.renderer),
      passivity_(options_.passivity),
      torque_(options_.torque),
      jaws_(options_.jaws),
      power_(options_.power_level) {
  if (guard.info().max_torque_n_m > 0.0) report_.max_torque_n_m = 0.0;
  if (guard.info().max_jaw_torque_n_m > 0.0) report_.max_jaw_torque_n_m = 0.0;
}

Result<LoopReport> Loop::run(const std::atomic<bool>& stop) {
  const auto period_ns = static_cast<std::int64_t>(kNsPerS / options_.rate_hz);
  const std::int64_t start_ns = clock_.now_ns();
  std::int64_t deadline_ns = start_ns;
  Result<void> ok;
  while (ok && !stop) {
    deadline_ns += period_ns;
    while (!stop && clock_.now_ns() < deadline_ns) clock_.sleep_until_ns(deadline_ns);
    const std::int64_t wake_ns = clock_.now_ns();
    report_.seconds = static_cast<double>(wake_ns - start_ns) / kNsPerS;
    if (stop || report_.seconds > options_.duration_s) break;
    const std::int64_t missed = (wake_ns - deadline_ns) / period_ns;
    report_.missed_ticks += static_cast<std::uint64_t>(missed);
    report_.wake_up_lateness.add(wake_ns - deadline_ns);
    deadline_ns += missed * period_ns;
    ok = tick();
    report_.tick_duration.add(clock_.now_ns() - wake_ns);
  }
  guard_.release();
  take_power_off();
  if (!ok) return tl::make_unexpected(std::move(ok.error()));
  drain(stop);

  report_.poses_sent = latency_.last_sent() - report_.poses_not_taken;
  report_.last_sequence_sent = latency_.last_sent();
  report_.last_sequence_echoed = latency_.last_echoed();
  report_.poses_forgotten = latency_.forgotten();
  report_.round_trip = latency_.round_trip();
  report_.feedback_malformed = link_.malformed();
  report_.watchdog_trips = guard_.trips();
  return report_;
}

Result<void> Loop::tick() {
  const Result<DevicePose> pose = guard_.read();
  if (!pose) return tl::make_unexpected(pose.error());
  ++report_.ticks;
  if (!is_valid(*pose)) return tick_without(*pose);
  invalid_in_a_row_ = 0;
  const std::int64_t now_ns = clock_.now_ns();
  send(*pose, power_.level(pose->pressed, ours_));

  receive();

  const ForceRenderer::Output rendered = renderer_.render(pose->position_m, pose->orientation, now_ns);
  if (report_.feedback_received > 0) {
    report_.stale_ticks += rendered.stale;
    report_.stale_episodes += rendered.stale && !was_stale_;
    was_stale_ = rendered.stale;
  }
  if (rendered.stale) ours_ = false;
  const Wrench wrench = wrench_at(*pose, rendered);
  report(wrench);
  return guard_.write(wrench);
}

void Loop::send(const DevicePose& pose, double level) {
  const std::int64_t now_ns = clock_.now_ns();
  const std::uint64_t sequence = latency_.last_sent() + 1;
  latency_.sent(sequence, now_ns);
  report_.poses_with_power += level > 0.0;
  last_level_ = level;
  if (!link_.send({sequence, options_.client_id, now_ns, pose, options_.session, level})) ++report_.poses_not_taken;
}

void Loop::take_power_off() {
  power_.lock();
  if (last_level_ > 0.0 && last_pose_) send(*last_pose_, 0.0);
}

Wrench Loop::wrench_at(const DevicePose& pose, const ForceRenderer::Output& rendered) {
  const HandMotion motion = last_pose_ ? motion_between(*last_pose_, pose) : HandMotion{};
  last_pose_ = pose;
  // From the guard, because the watchdog may have set it to zero since the last tick.
  const Wrench held = guard_.held();
  Wrench wrench;
  const Eigen::Vector3d passive = passivity_.apply(motion.moved_m, held.force_n, rendered.force_n, period_s_);
  wrench.force_n = limit_force(passive, held.force_n, period_s_, options_.limits);
  wrench.torque_n_m = torque_.apply(motion.turned_rad, held.torque_n_m, rendered.torque_n_m, period_s_);
  // Without an angle of the jaws their work is unknown.
  if (pose.jaw_angle_rad) {
    wrench.jaw_torque_n_m =
        jaws_.apply(motion.jaws_opened_rad, held.jaw_torque_n_m, rendered.jaw_torque_n_m, period_s_);
  }
  return wrench;
}

void Loop::report(const Wrench& wrench) {
  report_.max_force_n = std::max(report_.max_force_n, wrench.force_n.norm());
  report_.min_energy_j = std::min(report_.min_energy_j, passivity_.energy_j());
  if (report_.max_torque_n_m) *report_.max_torque_n_m = std::max(*report_.max_torque_n_m, wrench.torque_n_m.norm());
  if (report_.max_jaw_torque_n_m) {
    *report_.max_jaw_torque_n_m = std::max(*report_.max_jaw_torque_n_m, std::abs(wrench.jaw_torque_n_m));
  }
}

Result<void> Loop::tick_without(const DevicePose& invalid) {
  ++report_.poses_invalid;
  take_power_off();
  if (auto written = guard_.write(Wrench{}); !written) return written;
  // Take feedback all the same: it is timed on arrival and renews the local model for the next valid pose.
  receive();
  if (++invalid_in_a_row_ < kMaxInvalidPosesInARow) return {};
  const Eigen::Vector3d& p = invalid.position_m;
  return fail(ErrorCode::kUnavailable,
              fmt::format("device {}: {} poses in a row are invalid, the last one at ({}, {}, {}) m with a quaternion "
                          "of length {}; check the device and its driver",
                          guard_.info().name, invalid_in_a_row_, p.x(), p.y(), p.z(), invalid.orientation.norm()));
}

void Loop::receive() {
  const std::optional<Feedback> feedback = link_.receive();
  if (!feedback) return;
  if (options_.removed != nullptr) options_.removed->store(feedback->removed, std::memory_order_relaxed);
  if (feedback->removed) ours_ = false;
  const std::uint64_t last_echoed = latency_.last_echoed();
  // Only an answer to this client's own pose may push its hand: another client's model has another anchor.
  const bool own = feedback->client_id == options_.client_id && feedback->client_time_ns <= feedback->arrival_ns &&
                   latency_.echoed(feedback->pose_sequence, feedback->arrival_ns);
  if (!own) {
    ++report_.feedback_foreign;
    if (!feedback->claimed || feedback->client_id == options_.client_id) return;
    ++report_.feedback_claimed;
    ours_ = false;
    if (options_.claimed_by != nullptr) options_.claimed_by->store(feedback->client_id, std::memory_order_relaxed);
    return;
  }
  if (report_.feedback_received > 0 && feedback->step > last_step_ + 1) {
    report_.feedback_dropped += feedback->step - last_step_ - 1;
  }
  last_step_ = feedback->step;
  ours_ = !feedback->removed;
  ++report_.feedback_received;
  const std::int64_t age_ns = feedback->arrival_ns - feedback->client_time_ns;
  report_.answered_pose_age.add(age_ns);
  if (latency_.last_echoed() > last_echoed) {
    report_.pose_wait.add(feedback->waited_ns);
    report_.step_time.add(feedback->step_ns);
    report_.publication.add(feedback->published_after_ns);
    const std::int64_t in_server_ns = feedback->waited_ns + feedback->step_ns + feedback->published_after_ns;
    report_.transport.add(std::max<std::int64_t>(age_ns - in_server_ns, 0));
  }
  count_recovery(feedback->recovering);
  renderer_.update(*feedback);
}

void Loop::count_recovery(bool recovering) {
  report_.recovering_feedbacks += recovering;
  if (recovering && !was_recovering_) {
    ++report_.recoveries;
    if (options_.recoveries != nullptr) options_.recoveries->fetch_add(1, std::memory_order_relaxed);
  }
  was_recovering_ = recovering;
}

void Loop::drain(const std::atomic<bool>& stop) {
  const bool stopped_before = stop;
  const std::int64_t until_ns = clock_.now_ns() + static_cast<std::int64_t>(options_.drain_s * kNsPerS);
  while (latency_.last_echoed() < latency_.last_sent() && clock_.now_ns() < until_ns && stop == stopped_before) {
    clock_.sleep_until_ns(clock_.now_ns() + kDrainPollNs);
    receive();
  }
}

}  // namespace tensormass::haptic
