#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "model/progress.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::world {

struct CompiledScene;

enum class BackendChoice { kAuto, kCpu, kCuda };

struct RunnerOptions {
  BackendChoice backend = BackendChoice::kAuto;
  std::uint32_t cpu_threads = 1;  ///< of a scene that does not say
  std::uint32_t gpu_scenes = 1;   ///< that are to step on the GPU at the same time
};

/// One scene stepping on a thread of its own.
///
/// Control never touches state: the methods below enqueue a command that the loop applies between two steps, and wait
/// for it. Output goes the other way through mailboxes that keep the newest: the loop never waits for a reader.
/// All methods may be called from any thread.
class Runner {
 public:
  /// Checks the scene, compiles it and starts it. Errors name the body, the element and the remedy.
  static Result<std::unique_ptr<Runner>> start(const v1::Scene& scene, const RunnerOptions& options,
                                               const model::Progress& progress = {});
  /// One that is compiled already.
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
  /// Constant while the scene is loaded.
  const v1::Topology& topology() const;

  Result<v1::SceneStatus> pause();
  Result<v1::SceneStatus> resume();
  /// Lockstep only; returns when the steps are done.
  Result<v1::SceneStatus> step(std::uint32_t count);
  Result<v1::SceneStatus> reset();
  v1::SceneStatus status() const;
  /// The scene is about to be unloaded: a `step` in progress ends after the step at hand, with kUnavailable.
  void cancel();
  /// Surface positions after the last step.
  Result<v1::Frame> frame();
  Result<v1::GetPositionsResponse> positions(std::string_view body);
  Result<v1::GetFieldsResponse> fields(const v1::GetFieldsRequest& request);
  Result<v1::ToolFeedback> feedback(std::string_view tool) const;

  /// Never waits for a step. Refuses (and counts) a pose that is not finite, not newer than the client's last, or for
  /// an unknown tool.
  Result<void> submit_pose(std::string_view tool, const v1::ToolPose& pose);
  /// Counts a pose that could not even be parsed.
  void count_malformed_pose();

  /// Called by the loop after it left something in a mailbox; must not block (it wakes the publisher).
  void set_output_signal(std::function<void()> signal);
  /// Takes what is new since the last call; false if nothing is. One reader.
  bool take_frame(v1::Frame& frame);
  /// Takes the feedback of every tool that is new since the last call.
  bool take_feedback(std::vector<v1::ToolFeedback>& feedback);
  /// True when a status message is due by the scene's status rate.
  bool take_status(v1::SceneStatus& status);

 private:
  struct Impl;
  explicit Runner(std::unique_ptr<Impl> impl);
  std::unique_ptr<Impl> impl_;
};

/// The backend that `choice` comes to on this machine, with the device's name ("cpu", "AMD EPYC ..., 2 threads").
struct BackendDescription {
  std::string backend;
  std::string device;
};
/// kCuda without a device is an error; kAuto falls back to the CPU.
Result<BackendDescription> describe_backend(BackendChoice choice);

}  // namespace tensormass::world
