#include "haptic/report.h"

#include <google/protobuf/struct.pb.h>
#include <google/protobuf/util/json_util.h>
#include <spdlog/fmt/fmt.h>

namespace tensormass::haptic {
namespace {

using google::protobuf::Struct;

void set(Struct& object, const std::string& name, double value) {
  (*object.mutable_fields())[name].set_number_value(value);
}

void set(Struct& object, const std::string& name, std::uint64_t value) {
  set(object, name, static_cast<double>(value));
}

void set(Struct& object, const std::string& name, const std::string& value) {
  (*object.mutable_fields())[name].set_string_value(value);
}

double seconds(std::int64_t ns) { return static_cast<double>(ns) / kNsPerS; }

void set(Struct& object, const std::string& name, const Histogram& histogram) {
  Struct& out = *(*object.mutable_fields())[name].mutable_struct_value();
  set(out, "count", histogram.count());
  set(out, "p50_s", seconds(histogram.percentile_ns(0.5)));
  set(out, "p99_s", seconds(histogram.percentile_ns(0.99)));
  set(out, "p999_s", seconds(histogram.percentile_ns(0.999)));
  set(out, "max_s", seconds(histogram.max_ns()));
  auto& buckets = *(*out.mutable_fields())["buckets"].mutable_list_value();
  for (std::size_t i = 0; i < Histogram::kBucketCount; ++i) {
    if (histogram.buckets()[i] == 0) continue;
    auto& pair = *buckets.add_values()->mutable_list_value();
    pair.add_values()->set_number_value(seconds(Histogram::upper_ns(i)));
    pair.add_values()->set_number_value(static_cast<double>(histogram.buckets()[i]));
  }
}

std::string percentiles(const Histogram& histogram) {
  const auto ms = [](std::int64_t ns) { return static_cast<double>(ns) * 1e-6; };
  return fmt::format("p50 {:.3f}  p99 {:.3f}  p99.9 {:.3f}  max {:.3f} ms  ({} samples)",
                     ms(histogram.percentile_ns(0.5)), ms(histogram.percentile_ns(0.99)),
                     ms(histogram.percentile_ns(0.999)), ms(histogram.max_ns()), histogram.count());
}

}  // namespace

std::string to_text(const LoopReport& report, const RunLabel& label) {
  return fmt::format(
      "{} at {}/{} on {} over {}: {:.1f} s, {} ticks ({} missed)\n"
      "  pose to force      {}\n"
      "  answered pose age  {}\n"
      "  wake-up lateness   {}\n"
      "  tick duration      {}\n"
      "  poses     {} sent, last {} echoed {}{}\n"
      "  feedback  {} received, {} dropped, {} foreign, {} malformed\n"
      "  force     at most {:.3f} N; stale {} ticks in {} episodes; watchdog {}; least energy {:.2e} J\n",
      label.device, label.scene, label.tool, label.server, label.transport, report.seconds, report.ticks,
      report.missed_ticks, percentiles(report.round_trip), percentiles(report.answered_pose_age),
      percentiles(report.wake_up_lateness), percentiles(report.tick_duration), report.poses_sent,
      report.last_sequence_sent, report.last_sequence_echoed,
      report.poses_not_taken > 0 ? fmt::format(", {} not taken by the transport", report.poses_not_taken) : "",
      report.feedback_received, report.feedback_dropped, report.feedback_foreign, report.feedback_malformed,
      report.max_force_n, report.stale_ticks, report.stale_episodes, report.watchdog_trips, report.min_energy_j);
}

std::string to_json(const LoopReport& report, const RunLabel& label) {
  Struct out;
  set(out, "server", label.server);
  set(out, "scene", label.scene);
  set(out, "tool", label.tool);
  set(out, "transport", label.transport);
  set(out, "device", label.device);
  set(out, "seconds", report.seconds);
  set(out, "ticks", report.ticks);
  set(out, "missed_ticks", report.missed_ticks);
  set(out, "poses_sent", report.poses_sent);
  set(out, "poses_not_taken", report.poses_not_taken);
  set(out, "poses_forgotten", report.poses_forgotten);
  set(out, "last_sequence_sent", report.last_sequence_sent);
  set(out, "last_sequence_echoed", report.last_sequence_echoed);
  set(out, "feedback_received", report.feedback_received);
  set(out, "feedback_dropped", report.feedback_dropped);
  set(out, "feedback_foreign", report.feedback_foreign);
  set(out, "feedback_malformed", report.feedback_malformed);
  set(out, "stale_ticks", report.stale_ticks);
  set(out, "stale_episodes", report.stale_episodes);
  set(out, "watchdog_trips", report.watchdog_trips);
  set(out, "max_force_n", report.max_force_n);
  set(out, "min_energy_j", report.min_energy_j);
  set(out, "pose_to_force", report.round_trip);
  set(out, "answered_pose_age", report.answered_pose_age);
  set(out, "wake_up_lateness", report.wake_up_lateness);
  set(out, "tick_duration", report.tick_duration);
  std::string json;
  // Every value above is finite, so this conversion has no way to fail.
  static_cast<void>(google::protobuf::util::MessageToJsonString(out, &json));
  return json + '\n';
}

}  // namespace tensormass::haptic
