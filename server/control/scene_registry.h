#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <shared_mutex>
#include <string>
#include <string_view>
#include <vector>

#include "control/admission.h"
#include "control/refusals.h"
#include "core/result.h"
#include "tensormass/v1/scene.pb.h"
#include "world/runner.h"

namespace tensormass::control {

/// A loaded scene. Its owners share it: the registry, and each call that uses it at the moment. The last one to let go
/// ends the scene's loop and waits for it, up to one step.
using RunnerPtr = std::shared_ptr<world::Runner>;

/// Is told which scenes a daemon has, before the calls that load and unload them answer.
///
/// While it is told, the name of the scene is reserved: nobody can load another one under it. Calls for several scenes
/// come at the same time, on the threads of those who load and unload.
class SceneFollower {
 public:
  virtual ~SceneFollower() = default;
  /// The scene steps and nobody sees it yet.
  virtual void follow(const RunnerPtr& runner) = 0;
  /// Nobody sees the scene any more. `SceneRegistry::close` does not tell it.
  virtual void forget(const std::string& name) = 0;
};

/// The loaded scenes of a daemon, by name. All methods may be called from any thread.
///
///     gRPC threads       load ─ reserve name ─ compile, seconds, no lock held ─ fill ─> generation + 1, output_signal
///                        unload ──────────────────────────────────────── remove ─────> generation + 1, output_signal
///     gRPC threads  ──┐
///     bus threads   ──┼─ find, list: shared lock, copy a RunnerPtr
///     publisher     ──┘
///
/// The lock is held only to read or change the map, never while a scene compiles, steps or ends. So a load or an unload
/// delays neither another scene nor a pose.
///
/// A name in the map has one of three states:
///
///     absent ── load ──> reserved (null) ── compiled ──> loaded (runner) ── unload, close ──> absent
///                             └── compilation failed or was cancelled, or the registry closed ──> absent
///
/// An unload reserves the name too while the follower is told. `find` and `list` do not show a reserved name. `load`
/// refuses it with kAlreadyExists, `unload` with kFailedPrecondition.
class SceneRegistry {
 public:
  /// `output_signal` is called after every load and unload, and by the scenes' loops when a mailbox has something new.
  /// It runs on their threads and must not block.
  /// admission: bounds of what loads may need; used_bytes: as in Admission.
  SceneRegistry(const world::RunnerOptions& options, std::function<void()> output_signal,
                const AdmissionLimits& admission = {}, double (*used_bytes)() = &Admission::resident_bytes);

  /// follower: outlives every call. Set it before the first load.
  void set_follower(SceneFollower* follower) { follower_ = follower; }

  /// Compiles the scene and starts its loop; returns when it runs, after seconds for a large mesh. Fails with
  /// kAlreadyExists for a name in use, kResourceExhausted beyond limits::kMaxScenes or the admission's limits,
  /// kUnavailable after `close`,
  /// kCancelled if `progress` ends it, and with the errors of world::Runner::start.
  Result<RunnerPtr> load(const v1::Scene& scene, const model::Progress& progress = {});
  /// The same for a scene that comes back. The follower is not told, and `prepare` is called instead.
  /// prepare: called with the running scene before anybody sees it
  Result<RunnerPtr> load(const v1::Scene& scene, const model::Progress& progress,
                         const std::function<void(const RunnerPtr&)>& prepare);
  /// Checks and compiles the scene without running it. It needs no name in the registry.
  Result<v1::SceneReport> inspect(const v1::Scene& scene, const model::Progress& progress = {}) {
    const auto promise = admission_.admit(scene);
    if (!promise) return tl::make_unexpected(promise.error());
    return world::Runner::inspect(scene, options_, progress);
  }
  /// Changes values of a scene that steps. The scene is compiled again beside itself, so it needs as much as a load and
  /// is admitted like one. Fails with kNotFound, kResourceExhausted, and the errors of world::Runner::adjust.
  Result<v1::AdjustSceneResponse> adjust(std::string_view name, const v1::SceneAdjustments& changes);
  /// Edits a scene between two steps. A cut compiles it again, as an adjustment does. Fails with kNotFound,
  /// kResourceExhausted, and the errors of world::Runner::edit.
  Result<v1::EditSceneResponse> edit(std::string_view name, const v1::SceneEdit& edit);
  /// Returns whether an edit compiles the scene again.
  static bool compiles(const v1::SceneEdit& edit);
  /// Makes recorded steps again; a recording with adjustments is admitted as they are. Fails with kNotFound,
  /// kResourceExhausted, and the errors of world::Runner::replay.
  Result<v1::ReplaySceneResponse> replay(const v1::ReplaySceneRequest& request);
  /// The bounds of what clients may take; messages ask it, too.
  Admission& admission() { return admission_; }
  /// Removes the scene and ends its step. Returns when its loop has ended, unless another owner still holds it.
  /// Fails with kNotFound, or with kFailedPrecondition while the scene is being loaded.
  Result<void> unload(std::string_view name);
  /// Fails with kNotFound.
  Result<RunnerPtr> find(std::string_view name) const;
  /// Every loaded scene, sorted by name.
  std::vector<RunnerPtr> list() const;
  /// Refusals of the whole control plane, for metrics.
  Refusals& refusals() { return refusals_; }
  const Refusals& refusals() const { return refusals_; }
  /// What recordings of a scene lost; of one that is not loaded, a count that nobody reads.
  std::shared_ptr<RecordingLosses> recording_losses(std::string_view scene);
  using LossesOfScenes = std::map<std::string, std::shared_ptr<const RecordingLosses>, std::less<>>;
  /// The same of all loaded scenes that were recorded.
  LossesOfScenes recording_losses() const;
  const AdmissionLimits& admission_limits() const { return admission_.limits(); }
  /// A number that grows with every load, unload and close. A reader that remembers it knows whether to call `list`.
  std::uint64_t generation() const { return generation_.load(std::memory_order_acquire); }
  /// Removes and cancels every scene, and refuses loads from then on, with kUnavailable. Scenes end when the caller
  /// drops the result.
  std::vector<RunnerPtr> close();

 private:
  class Reservation;
  /// Counts the generation up and calls `output_signal_`. Call it without the lock.
  void changed();
  template <class Change>
  auto admitted(const RunnerPtr& runner, const Change& change) -> decltype(change());

  const world::RunnerOptions options_;
  const std::function<void()> output_signal_;
  SceneFollower* follower_ = nullptr;  // nullptr: nobody is told
  Refusals refusals_;
  Admission admission_;
  std::atomic<std::uint64_t> generation_{0};
  mutable std::shared_mutex mutex_;
  // Guarded by mutex_, as are losses_ and closed_. Null: the name is reserved for a scene that is being compiled.
  std::map<std::string, RunnerPtr, std::less<>> scenes_;
  std::map<std::string, std::shared_ptr<RecordingLosses>, std::less<>> losses_;
  bool closed_ = false;
};

}  // namespace tensormass::control
