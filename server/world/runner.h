#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "model/progress.h"
#include "tensormass/v1/changes.pb.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/event.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "tensormass/v1/stream.pb.h"
#include "world/pose_source.h"
#include "world/recording.h"
#include "world/runner_options.h"

namespace tensormass::world {

struct CompiledScene;
struct SceneCounts;
class StepStatistics;

/// What a scene needs to come back in another process, together with the message it was loaded from.
struct KeptState {
  v1::SceneAdjustments adjustments;
  bool paused = false;
  std::string snapshot;             ///< as in SnapshotSceneResponse
  std::chrono::nanoseconds held{};  ///< time for which the loop could not step
};

/// Identifies a state of a scene. Another one differs from it, also after an adjustment or a reset to the same step.
struct StateMark {
  std::uint64_t adjustment = 0, change = 0;
  v1::SceneStatus::State state = v1::SceneStatus::STATE_UNSPECIFIED;
  bool operator==(const StateMark&) const = default;
};

/// A recording, and the message with which its stream begins.
struct StartedRecording {
  std::shared_ptr<Recording> recording;
  v1::RecordingStart start;
};

/// What metrics say of a scene (docs/metrics.md).
struct SceneMetrics {
  struct Tool {
    std::string name;
    std::uint64_t received = 0, rejected = 0, superseded = 0;  ///< poses, as in SceneStatus
  };
  v1::SceneStatus status;
  std::uint64_t bytes = 0;  ///< buffers of the scene on its backend
  std::vector<Tool> tools;
  std::shared_ptr<const StepStatistics> statistics;
  std::shared_ptr<const SceneCounts> counts;
};

/// One scene that steps on a thread of its own. All methods may be called from any thread.
///
/// Callers never touch the scene's state, so a step needs no lock. They reach it in three ways:
///
///     pause, resume, step, reset, frame, ...  --> queue of commands --> loop   the caller waits for the result
///     submit_pose                             --> PoseInbox         --> loop   nobody waits; the newest pose counts
///     take_frame, take_feedback, take_status  <-- mailboxes         <-- loop   nobody waits; the newest is kept
///
/// loop.h draws the loop, loop_outputs.h the mailboxes, loop_status.h the status. This class turns names into indices
/// and forwards calls.
class Runner {
 public:
  /// Checks the scene, compiles it and starts it. Errors name the body, the element and the remedy.
  static Result<std::unique_ptr<Runner>> start(const v1::Scene& scene, const RunnerOptions& options,
                                               const model::Progress& progress = {});
  /// Starts a scene that is compiled already.
  static Result<std::unique_ptr<Runner>> start(CompiledScene compiled);
  /// Checks and compiles without running.
  static Result<v1::SceneReport> inspect(const v1::Scene& scene, const RunnerOptions& options,
                                         const model::Progress& progress = {});

  /// Ends the loop and joins its thread. No call may be under way: callers on several threads share the ownership.
  ~Runner();
  Runner(const Runner&) = delete;
  Runner& operator=(const Runner&) = delete;

  const std::string& name() const;
  const v1::SceneReport& report() const;
  /// Another one, with another version, each time that tools are added or removed.
  std::shared_ptr<const v1::Topology> topology() const;

  Result<v1::SceneStatus> pause();
  Result<v1::SceneStatus> resume();
  /// Makes `count` steps of a scene in lockstep or paused, and returns when they are done.
  Result<v1::SceneStatus> step(std::uint32_t count);
  Result<v1::SceneStatus> reset();
  /// Changes the scene between two steps, or not at all; see EditScene.
  /// findings: those of tools that it adds
  Result<v1::SceneStatus> edit(const v1::SceneEdit& change, std::vector<v1::Finding>* findings = nullptr);
  v1::SceneStatus status() const;
  /// Waits for no step.
  SceneMetrics metrics() const;
  /// Ends the step at hand and a `step` in progress, with kUnavailable, because the scene will be unloaded.
  void cancel();
  /// Surface positions after the last step.
  Result<v1::Frame> frame();
  /// Fills in the newest changes of the visible surface; false: it is as in the topology. Waits for no step.
  bool changes(v1::SurfaceChanges& changes) const;
  Result<v1::GetPositionsResponse> positions(std::string_view body);
  Result<v1::GetFieldsResponse> fields(const v1::GetFieldsRequest& request);
  Result<v1::ToolFeedback> feedback(std::string_view tool) const;

  /// Starts a recording for one reader. It ends by `stop_recording`, or is closed when the scene ends.
  Result<StartedRecording> record(const RecordingOptions& options);
  void stop_recording(const std::shared_ptr<Recording>& recording);
  /// Makes recorded steps again; for a scene in lockstep.
  Result<v1::ReplaySceneResponse> replay(const v1::ReplaySceneRequest& request);
  /// The whole state between two steps (snapshot.h), and going on from it.
  Result<v1::SnapshotSceneResponse> snapshot();
  Result<v1::SceneStatus> restore(std::string_view snapshot);
  /// Which state the scene is in. Costs next to nothing.
  StateMark mark() const;
  /// The state for another process. Fails with kUnavailable for a scene that is cancelled.
  Result<KeptState> keep();
  /// Returns false if the loop hangs: its turn was due at least `late` ago.
  bool turns(std::chrono::nanoseconds late) const;
  /// Number of the GPU on which the scene steps; 0 on the CPU.
  std::uint32_t device() const;
  /// True after a failure with which this process lost that device (device_loss.h).
  bool device_lost() const;
  /// The message that the scene was loaded from; nullptr if it was compiled already.
  const v1::Scene* source() const;
  /// Changes values of the scene and goes on from its state; see AdjustScene.
  Result<v1::AdjustSceneResponse> adjust(const v1::SceneAdjustments& changes);

  /// Never waits for a step. Refuses (and counts) a pose that is not finite, not newer than the client's last, for an
  /// unknown tool, or for a tool that another client claims.
  Result<void> submit_pose(std::string_view tool, const v1::ToolPose& pose, PoseSource source = PoseSource::kClient);
  /// Counts a pose that could not even be parsed.
  void count_malformed_pose();

  /// signal: void(), called on the loop's thread after it published something. Must not block: it wakes the publisher.
  void set_output_signal(std::function<void()> signal);
  /// Takes the newest frame; false if the last call took it. One reader.
  bool take_frame(v1::Frame& frame);
  /// Takes the newest feedback of all tools; false if the last call took it. One reader.
  bool take_feedback(std::vector<v1::ToolFeedback>& feedback);
  /// Takes the newest changes of the surface; false if they are those of the last call. One reader.
  bool take_changes(v1::SurfaceChanges& changes);
  /// Takes the last events; false if nothing happened since the last call. One reader.
  bool take_events(v1::SceneEvents& events);
  /// Fills `status` and returns true if one is due: by the scene's status rate, or after a change of state. One reader.
  bool take_status(v1::SceneStatus& status);

 private:
  struct Impl;
  explicit Runner(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

}  // namespace tensormass::world
