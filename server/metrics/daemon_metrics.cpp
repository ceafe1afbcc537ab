#include "metrics/daemon_metrics.h"

#include <array>
#include <atomic>
#include <string_view>
#include <utility>

#include "control/admission.h"
#include "metrics/exposition.h"
#include "world/scene_counts.h"
#include "world/step_clock.h"

namespace tensormass::metrics {
namespace {

using world::SceneMetrics;

/// A family in which each scene has samples.
struct SceneFamily {
  Family family;
  void (*write)(Exposition& out, const SceneMetrics& scene);
};

std::uint64_t read(const std::atomic<std::uint64_t>& count) { return count.load(std::memory_order_relaxed); }

/// Writes a count for each breach of the guard.
template <std::size_t kCount>
void write_by_breach(Exposition& out, const SceneMetrics& scene, const world::SceneCounts::Counts<kCount>& counts) {
  static_assert(kCount >= world::kBreachNames.size());
  for (std::size_t breach = 1; breach < world::kBreachNames.size(); ++breach) {
    out.sample({{"scene", scene.status.scene()}, {"reason", world::kBreachNames[breach]}}, read(counts[breach]));
  }
}

constexpr std::array<std::pair<v1::SceneStatus::State, std::string_view>, 4> kStates{
    {{v1::SceneStatus::STATE_RUNNING, "running"},
     {v1::SceneStatus::STATE_PAUSED, "paused"},
     {v1::SceneStatus::STATE_LOCKSTEP, "lockstep"},
     {v1::SceneStatus::STATE_FAULTED, "faulted"}}};

// A line for each family: docs/metrics.md repeats the names, types and labels, and says more.
constexpr SceneFamily kSceneFamilies[] = {
    {{"tensormass_scene_state", Type::kGauge, "1 for the state in which the scene is, 0 for the others."},
     [](Exposition& out, const SceneMetrics& s) {
       for (const auto& [state, name] : kStates) {
         out.sample({{"scene", s.status.scene()}, {"state", name}}, std::uint64_t{s.status.state() == state});
       }
     }},
    {{"tensormass_scene_memory_bytes", Type::kGauge, "Buffers of the scene on its backend."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}, {"backend", s.status.backend()}}, s.bytes);
     }},
    {{"tensormass_scene_device", Type::kGauge, "Number of the GPU on which the scene steps; 0 on the CPU."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, std::uint64_t{s.status.device()});
     }},
    {{"tensormass_scene_target_rate_hertz", Type::kGauge, "Steps a second that the scene asks for; 0 in lockstep."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.status.target_rate_hz());
     }},
    {{"tensormass_scene_rate_hertz", Type::kGauge, "Steps a second, measured over about the last second."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.status.reached_rate_hz());
     }},
    {{"tensormass_step_duration_seconds", Type::kHistogram,
      "Time of a step, from reading the poses until its results are ready."},
     [](Exposition& out, const SceneMetrics& s) {
       out.histogram({{"scene", s.status.scene()}}, s.statistics->times());
     }},
    {{"tensormass_missed_deadlines_total", Type::kCounter, "Steps that ended after the next one was due."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.statistics->missed_deadlines());
     }},
    {{"tensormass_pose_to_force_seconds", Type::kHistogram,
      "Time from the arrival of a pose until the message with its force was written."},
     [](Exposition& out, const SceneMetrics& s) {
       out.histogram({{"scene", s.status.scene()}}, s.counts->poses_to_force);
     }},
    {{"tensormass_pose_age_seconds", Type::kHistogram,
      "Age of the newest pose of a tool at the start of a step, while its client streams poses."},
     [](Exposition& out, const SceneMetrics& s) {
       out.histogram({{"scene", s.status.scene()}}, s.counts->pose_ages);
     }},
    {{"tensormass_poses_total", Type::kCounter,
      "Poses of a tool that arrived: received, rejected, or superseded by a newer one before a step used them."},
     [](Exposition& out, const SceneMetrics& s) {
       for (const SceneMetrics::Tool& tool : s.tools) {
         for (const auto& [outcome, count] :
              {std::pair{"received", tool.received}, std::pair{"rejected", tool.rejected},
               std::pair{"superseded", tool.superseded}}) {
           out.sample({{"scene", s.status.scene()}, {"tool", tool.name}, {"outcome", outcome}}, count);
         }
       }
     }},
    {{"tensormass_frames_total", Type::kCounter,
      "Frames: published, or replaced by a newer one before they were published."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}, {"outcome", "published"}}, s.status.frames_published());
       out.sample({{"scene", s.status.scene()}, {"outcome", "replaced"}}, s.status.frames_replaced());
     }},
    {{"tensormass_cg_iterations_total", Type::kCounter, "Iterations of conjugate gradients."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, read(s.counts->cg_iterations));
     }},
    {{"tensormass_cg_residual_ratio", Type::kGauge, "Relative residual of the last step's linear solve."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.status.cg_relative_residual());
     }},
    {{"tensormass_momentum_error_ratio", Type::kGauge,
      "Error of a free body's momentum before its last correction, as a share of the impulses on it."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.status.momentum_error());
     }},
    {{"tensormass_cut_area_square_meters", Type::kGauge, "Area of the scene's cuts; a reset heals them."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, s.status.cut_area_m2());
     }},
    {{"tensormass_removed_mass_grams", Type::kGauge, "Mass of the tissue that was taken away; a reset heals it."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, 1e3 * s.status.removed_mass_kg());
     }},
    {{"tensormass_guard_events_total", Type::kCounter, "Steps that left their bounds, by the first bound."},
     [](Exposition& out, const SceneMetrics& s) { write_by_breach(out, s, s.counts->guard_events); }},
    {{"tensormass_recoveries_total", Type::kCounter,
      "Recoveries: tools backed off or let go, or the tissue was held. By the first bound."},
     [](Exposition& out, const SceneMetrics& s) { write_by_breach(out, s, s.counts->recoveries); }},
    {{"tensormass_held_steps_total", Type::kCounter, "Steps in which the tissue was held."},
     [](Exposition& out, const SceneMetrics& s) {
       out.sample({{"scene", s.status.scene()}}, read(s.counts->held_steps));
     }},
    {{"tensormass_faults_total", Type::kCounter, "Times that the scene stopped, by the bound, or the device failed."},
     [](Exposition& out, const SceneMetrics& s) {
       write_by_breach(out, s, s.counts->faults);
       out.sample({{"scene", s.status.scene()}, {"reason", "device"}},
                  read(s.counts->faults[world::SceneCounts::kDeviceFault]));
     }},
};

/// Writes the counts of each transport. names: of the second label's values.
template <std::size_t kCount>
void write_by_carrier(Exposition& out, const bus::BusCounts::OfEachCarrier<kCount>& counts, std::string_view label,
                      const std::array<std::string_view, kCount>& names) {
  for (std::size_t carrier = 0; carrier < counts.size(); ++carrier) {
    for (std::size_t i = 0; i < kCount; ++i) {
      out.sample({{"transport", bus::kCarrierNames[carrier]}, {label, names[i]}}, counts[carrier][i]);
    }
  }
}

/// Buffers of the scenes on the GPU.
std::uint64_t device_bytes(const DaemonMetrics& metrics) {
  std::uint64_t bytes = 0;
  for (const SceneMetrics& scene : metrics.scenes) {
    if (scene.status.backend() == "cuda") bytes += scene.bytes;
  }
  return bytes;
}

}  // namespace

DaemonMetrics read_metrics(const control::SceneRegistry& registry, const v1::GetVersionResponse& identity,
                           std::uint64_t malformed_messages, const bus::BusCounts& bus) {
  DaemonMetrics out{.identity = identity,
                    .malformed_messages = malformed_messages,
                    .memory_bytes = control::Admission::resident_bytes(),
                    .memory_limit_bytes = registry.admission_limits().all_bytes,
                    .refusals = &registry.refusals(),
                    .losses = registry.recording_losses(),
                    .bus = bus};
  for (const control::RunnerPtr& runner : registry.list()) out.scenes.push_back(runner->metrics());
  return out;
}

std::string to_text(const DaemonMetrics& metrics) {
  Exposition out;
  const v1::GetVersionResponse& identity = metrics.identity;
  out.begin({"tensormass_build_info", Type::kGauge, "Always 1; the labels say what runs."});
  out.sample({{"version", identity.version()},
              {"server", identity.server()},
              {"backend", identity.backend()},
              {"device", identity.device()}},
             std::uint64_t{1});
  out.begin({"tensormass_scenes", Type::kGauge, "Scenes that are loaded."});
  out.sample({}, std::uint64_t{metrics.scenes.size()});
  out.begin({"tensormass_memory_bytes", Type::kGauge, "Memory that the daemon holds."});
  out.sample({}, metrics.memory_bytes);
  out.begin({"tensormass_memory_limit_bytes", Type::kGauge, "Memory above which loads are refused."});
  out.sample({}, metrics.memory_limit_bytes);
  out.begin({"tensormass_device_memory_bytes", Type::kGauge, "Buffers of all scenes on the GPUs."});
  out.sample({{"device", identity.device()}}, device_bytes(metrics));
  out.begin({"tensormass_malformed_messages_total", Type::kCounter, "Messages that could not be read."});
  out.sample({}, metrics.malformed_messages);
  out.begin({"tensormass_refusals_total", Type::kCounter, "Calls and connections that were refused, by the limit."});
  for (std::size_t limit = 0; limit < control::kLimitNames.size(); ++limit) {
    out.sample({{"limit", control::kLimitNames[limit]}}, metrics.refusals->of(static_cast<control::Limit>(limit)));
  }
  out.begin({"tensormass_bus_full_queues_total", Type::kCounter,
             "Messages that found the queue to a client full, which loses messages until it reads again."});
  write_by_carrier(out, metrics.bus.full_queues, "stream", bus::kStreamNames);
  out.begin({"tensormass_bus_refusals_total", Type::kCounter, "What clients sent and a transport refused."});
  write_by_carrier(out, metrics.bus.refusals, "reason", bus::kRefusalNames);
  out.begin({"tensormass_recording_losses_total", Type::kCounter,
             "Steps and checks that did not reach the client of a recording, and recordings that ended for it."});
  for (const SceneMetrics& scene : metrics.scenes) {
    const auto found = metrics.losses.find(scene.status.scene());
    const control::RecordingLosses none;
    const control::RecordingLosses& losses = found != metrics.losses.end() ? *found->second : none;
    for (const auto& [what, count] : {std::pair{"steps", &losses.steps}, std::pair{"checks", &losses.checks},
                                      std::pair{"recordings", &losses.recordings}}) {
      out.sample({{"scene", scene.status.scene()}, {"what", what}}, read(*count));
    }
  }
  for (const SceneFamily& each : kSceneFamilies) {
    out.begin(each.family);
    for (const SceneMetrics& scene : metrics.scenes) each.write(out, scene);
  }
  return out.text();
}

}  // namespace tensormass::metrics
