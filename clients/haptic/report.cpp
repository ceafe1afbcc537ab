#include "haptic/report.h"

#include <string_view>

#include <spdlog/fmt/fmt.h>

#include "core/log.h"

namespace tensormass::haptic {
namespace {

/// Builds a JSON object member by member.
class JsonObject {
 public:
  JsonObject& add(std::string_view name, std::string_view text) { return add_raw(name, log::json_quoted(text)); }
  JsonObject& add(std::string_view name, std::uint64_t value) { return add_raw(name, fmt::format("{}", value)); }
  /// `value` must be finite: JSON has no NaN.
  JsonObject& add(std::string_view name, double value) { return add_raw(name, fmt::format("{}", value)); }
  JsonObject& add(std::string_view name, const Histogram& histogram);
  std::string finish() const { return "{" + members_ + "}"; }

 private:
  JsonObject& add_raw(std::string_view name, std::string_view value) {
    members_ += fmt::format("{}{}: {}", members_.empty() ? "" : ", ", log::json_quoted(name), value);
    return *this;
  }

  std::string members_;
};

double seconds(std::int64_t ns) { return static_cast<double>(ns) / kNsPerS; }

JsonObject& JsonObject::add(std::string_view name, const Histogram& histogram) {
  std::string buckets;
  for (std::size_t i = 0; i < Histogram::kBucketCount; ++i) {
    if (histogram.buckets()[i] == 0) continue;
    buckets +=
        fmt::format("{}[{}, {}]", buckets.empty() ? "" : ", ", seconds(Histogram::upper_ns(i)), histogram.buckets()[i]);
  }
  JsonObject object;
  object.add("count", histogram.count())
      .add("p50_s", seconds(histogram.percentile_ns(0.5)))
      .add("p99_s", seconds(histogram.percentile_ns(0.99)))
      .add("p999_s", seconds(histogram.percentile_ns(0.999)))
      .add("max_s", seconds(histogram.max_ns()))
      .add_raw("buckets", "[" + buckets + "]");
  return add_raw(name, object.finish());
}

std::string percentiles(const Histogram& histogram) {
  const auto ms = [](std::int64_t ns) { return static_cast<double>(ns) * 1e-6; };
  return fmt::format("p50 {:.3f}  p99 {:.3f}  p99.9 {:.3f}  max {:.3f} ms  ({} samples)",
                     ms(histogram.percentile_ns(0.5)), ms(histogram.percentile_ns(0.99)),
                     ms(histogram.percentile_ns(0.999)), ms(histogram.max_ns()), histogram.count());
}

/// Returns the line of the torques, or nothing for a device without.
std::string torques(const LoopReport& report) {
  std::string parts;
  if (report.max_torque_n_m) parts += fmt::format("at most {:.4f} N m", *report.max_torque_n_m);
  if (report.max_jaw_torque_n_m) {
    parts += fmt::format("{}jaws at most {:.4f} N m", parts.empty() ? "" : "; ", *report.max_jaw_torque_n_m);
  }
  return parts.empty() ? parts : fmt::format("  torque    {}\n", parts);
}

/// Returns the line of the recoveries, or nothing without any.
std::string recoveries(const LoopReport& report) {
  if (report.recoveries == 0) return {};
  return fmt::format("  recovery  {} recoveries, {} feedbacks\n", report.recoveries, report.recovering_feedbacks);
}

}  // namespace

std::string to_text(const LoopReport& report, const RunLabel& label) {
  return fmt::format(
      "{} at {}/{} on {} over {}: {:.1f} s, {} ticks ({} missed)\n"
      "  pose to force      {}\n"
      "  answered pose age  {}\n"
      "    waits for a step {}\n"
      "    step             {}\n"
      "    publication      {}\n"
      "    transport        {}\n"
      "  wake-up lateness   {}\n"
      "  tick duration      {}\n"
      "  poses     {} sent, last {} echoed {}{}{}\n"
      "  feedback  {} received, {} dropped, {} foreign, {} malformed\n"
      "  force     at most {:.3f} N; stale {} ticks in {} episodes; watchdog {}; least energy {:.2e} J\n"
      "{}{}",
      label.device, label.scene, label.tool, label.server, label.transport, report.seconds, report.ticks,
      report.missed_ticks, percentiles(report.round_trip), percentiles(report.answered_pose_age),
      percentiles(report.pose_wait), percentiles(report.step_time), percentiles(report.publication),
      percentiles(report.transport), percentiles(report.wake_up_lateness), percentiles(report.tick_duration),
      report.poses_sent, report.last_sequence_sent, report.last_sequence_echoed,
      report.poses_not_taken > 0 ? fmt::format(", {} not taken by the transport", report.poses_not_taken) : "",
      report.poses_invalid > 0 ? fmt::format(", {} of the device invalid", report.poses_invalid) : "",
      report.feedback_received, report.feedback_dropped, report.feedback_foreign, report.feedback_malformed,
      report.max_force_n, report.stale_ticks, report.stale_episodes, report.watchdog_trips, report.min_energy_j,
      torques(report), recoveries(report));
}

std::string to_json(const LoopReport& report, const RunLabel& label) {
  JsonObject object;
  object.add("server", label.server)
      .add("scene", label.scene)
      .add("tool", label.tool)
      .add("transport", label.transport)
      .add("device", label.device)
      .add("seconds", report.seconds)
      .add("ticks", report.ticks)
      .add("missed_ticks", report.missed_ticks)
      .add("poses_sent", report.poses_sent)
      .add("poses_not_taken", report.poses_not_taken)
      .add("poses_invalid", report.poses_invalid)
      .add("poses_with_power", report.poses_with_power)
      .add("poses_forgotten", report.poses_forgotten)
      .add("last_sequence_sent", report.last_sequence_sent)
      .add("last_sequence_echoed", report.last_sequence_echoed)
      .add("feedback_received", report.feedback_received)
      .add("feedback_dropped", report.feedback_dropped)
      .add("feedback_foreign", report.feedback_foreign)
      .add("feedback_claimed", report.feedback_claimed)
      .add("feedback_malformed", report.feedback_malformed)
      .add("stale_ticks", report.stale_ticks)
      .add("stale_episodes", report.stale_episodes)
      .add("recovering_feedbacks", report.recovering_feedbacks)
      .add("recoveries", report.recoveries)
      .add("watchdog_trips", report.watchdog_trips)
      .add("max_force_n", report.max_force_n)
      .add("min_energy_j", report.min_energy_j);
  if (report.max_torque_n_m) object.add("max_torque_n_m", *report.max_torque_n_m);
  if (report.max_jaw_torque_n_m) object.add("max_jaw_torque_n_m", *report.max_jaw_torque_n_m);
  return object.add("pose_to_force", report.round_trip)
             .add("answered_pose_age", report.answered_pose_age)
             .add("pose_wait", report.pose_wait)
             .add("step_time", report.step_time)
             .add("publication_time", report.publication)
             .add("transport_time", report.transport)
             .add("wake_up_lateness", report.wake_up_lateness)
             .add("tick_duration", report.tick_duration)
             .finish() +
         '\n';
}

std::string recovery_line(std::uint64_t count) {
  return fmt::format(
      "the scene recovers from a step that could not be made as planned{}; the force fades to the new one",
      count == 1 ? "" : fmt::format(" ({} times since the last such line)", count));
}

std::string claimed_line(std::uint64_t client_id) {
  return fmt::format(
      "another client ({:#x}) claims the tool, and the server refuses the poses of this one; end that client, or take "
      "the tool over with MoveTool",
      client_id);
}

std::string removed_line(bool removed) {
  return removed ? "the tool was removed from the scene; there is no force until a tool of its name is added"
                 : "the scene has a tool of this name again";
}

std::string why_unanswered(const v1::SceneStatus& status, std::uint64_t poses_rejected_before) {
  for (const v1::ToolFeedback& tool : status.tools()) {
    if (tool.claimed() && status.poses_rejected() > poses_rejected_before) {
      return fmt::format("tool '{}': {}", tool.tool(), claimed_line(tool.client_id()));
    }
  }
  if (status.poses_rejected() > poses_rejected_before) {
    return fmt::format("the server refused poses of the scene meanwhile ({}); its log says why",
                       status.poses_rejected() - poses_rejected_before);
  }
  switch (status.state()) {
    case v1::SceneStatus::STATE_PAUSED:
      return "the scene is paused; resume it";
    case v1::SceneStatus::STATE_LOCKSTEP:
      return "the scene is in lockstep, and nobody asked it to step";
    case v1::SceneStatus::STATE_FAULTED:
      return "a guard stopped the scene: " + status.fault();
    default:
      return "the scene runs and refused no pose; are the server's data ports open to this machine?";
  }
}

}  // namespace tensormass::haptic
