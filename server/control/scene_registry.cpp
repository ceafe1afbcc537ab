#include "control/scene_registry.h"

#include <algorithm>
#include <mutex>
#include <utility>

#include <fmt/format.h>

#include "core/limits.h"

namespace tensormass::control {

/// Reserves a name while its scene is compiled. The destructor frees the name, unless `fill` put the scene there.
class SceneRegistry::Reservation {
 public:
  static Result<Reservation> take(SceneRegistry& registry, const std::string& name) {
    const std::lock_guard lock(registry.mutex_);
    if (registry.closed_) return fail(ErrorCode::kUnavailable, "the server is shutting down");
    if (registry.scenes_.contains(name)) {
      return fail(ErrorCode::kAlreadyExists,
                  fmt::format("a scene named '{}' is loaded; unload it first or give this one another name", name));
    }
    if (registry.scenes_.size() >= limits::kMaxScenes) {
      registry.refusals_.count(Limit::kScenes);
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("limits::kMaxScenes = {} scenes are loaded; unload one", limits::kMaxScenes));
    }
    registry.scenes_.emplace(name, nullptr);
    return Reservation(registry, name);
  }
  Reservation(Reservation&& other) noexcept
      : registry_(std::exchange(other.registry_, nullptr)), name_(std::move(other.name_)) {}
  ~Reservation() {
    if (registry_ == nullptr) return;
    const std::lock_guard lock(registry_->mutex_);
    registry_->scenes_.erase(name_);
  }

  /// Puts the compiled scene in the place of its reservation. Fails with kUnavailable after `close`.
  Result<void> fill(RunnerPtr runner) {
    const std::lock_guard lock(registry_->mutex_);
    if (registry_->closed_) return fail(ErrorCode::kUnavailable, "the server is shutting down");
    registry_->scenes_[name_] = std::move(runner);
    registry_ = nullptr;
    return {};
  }

 private:
  Reservation(SceneRegistry& registry, std::string name) : registry_(&registry), name_(std::move(name)) {}
  SceneRegistry* registry_;
  std::string name_;
};

SceneRegistry::SceneRegistry(const world::RunnerOptions& options, std::function<void()> output_signal,
                             const AdmissionLimits& admission, double (*used_bytes)())
    : options_(options), output_signal_(std::move(output_signal)), admission_(admission, used_bytes, &refusals_) {}

Result<RunnerPtr> SceneRegistry::load(const v1::Scene& scene, const model::Progress& progress) {
  if (follower_ == nullptr) return load(scene, progress, [](const RunnerPtr&) {});
  RunnerPtr followed;
  auto loaded = load(scene, progress, [&](const RunnerPtr& runner) {
    follower_->follow(runner);
    followed = runner;
  });
  // The registry closed meanwhile, and the client is told that its scene is not loaded.
  if (!loaded && followed) follower_->forget(followed->name());
  return loaded;
}

Result<RunnerPtr> SceneRegistry::load(const v1::Scene& scene, const model::Progress& progress,
                                      const std::function<void(const RunnerPtr&)>& prepare) {
  TM_ASSIGN_OR_RETURN(reservation, Reservation::take(*this, scene.name()));
  const auto promise = admission_.admit(scene);
  if (!promise) return tl::make_unexpected(promise.error());
  TM_ASSIGN_OR_RETURN(started, world::Runner::start(scene, options_, progress));
  const RunnerPtr runner = std::move(started);
  prepare(runner);
  runner->set_output_signal(output_signal_);
  TM_RETURN_IF_ERROR(reservation.fill(runner));
  changed();
  return runner;
}

/// Runs a change that compiles the scene again, and admits it like a load.
template <class Change>
auto SceneRegistry::admitted(const RunnerPtr& runner, const Change& change) -> decltype(change()) {
  if (runner->source() == nullptr) return change();  // refused there
  const auto promise = admission_.admit(*runner->source());
  if (!promise) return tl::make_unexpected(promise.error());
  return change();
}

Result<v1::AdjustSceneResponse> SceneRegistry::adjust(std::string_view name, const v1::SceneAdjustments& changes) {
  TM_ASSIGN_OR_RETURN(runner, find(name));
  return admitted(runner, [&] { return runner->adjust(changes); });
}

bool SceneRegistry::compiles(const v1::SceneEdit& edit) {
  return !edit.cuts().empty() || !edit.add_tools().empty() || !edit.remove_tools().empty() ||
         !edit.add_attachments().empty() || !edit.remove_attachments().empty();
}

Result<v1::EditSceneResponse> SceneRegistry::edit(std::string_view name, const v1::SceneEdit& edit) {
  TM_ASSIGN_OR_RETURN(runner, find(name));
  std::vector<v1::Finding> findings;
  const auto change = [&] { return runner->edit(edit, &findings); };
  TM_ASSIGN_OR_RETURN(status, compiles(edit) ? admitted(runner, change) : change());
  v1::EditSceneResponse out;
  *out.mutable_status() = std::move(status);
  out.mutable_findings()->Assign(findings.begin(), findings.end());
  return out;
}

Result<v1::ReplaySceneResponse> SceneRegistry::replay(const v1::ReplaySceneRequest& request) {
  TM_ASSIGN_OR_RETURN(runner, find(request.scene()));
  const auto adjusts = [](const v1::RecordedEdit& edit) { return edit.has_adjust(); };
  const auto replay = [&] { return runner->replay(request); };
  return std::any_of(request.edits().begin(), request.edits().end(), adjusts) ? admitted(runner, replay) : replay();
}

Result<void> SceneRegistry::unload(std::string_view name) {
  RunnerPtr ended;  // outlives the lock below, because its destructor waits for the scene's loop
  {
    const std::lock_guard lock(mutex_);
    const auto found = scenes_.find(name);
    if (found == scenes_.end()) return fail(ErrorCode::kNotFound, fmt::format("no scene '{}' is loaded", name));
    if (found->second == nullptr) {
      return fail(ErrorCode::kFailedPrecondition, fmt::format("scene '{}' is being loaded or unloaded", name));
    }
    ended = std::exchange(found->second, nullptr);  // reserves the name
  }
  ended->cancel();
  changed();  // before files are removed: hands must not wait for a disk
  if (follower_ != nullptr) follower_->forget(ended->name());
  const std::lock_guard lock(mutex_);
  losses_.erase(ended->name());
  scenes_.erase(ended->name());
  return {};
}

Result<RunnerPtr> SceneRegistry::find(std::string_view name) const {
  const std::shared_lock lock(mutex_);
  const auto found = scenes_.find(name);
  if (found == scenes_.end() || found->second == nullptr) {
    return fail(ErrorCode::kNotFound, fmt::format("no scene '{}' is loaded", name));
  }
  return found->second;
}

std::shared_ptr<RecordingLosses> SceneRegistry::recording_losses(std::string_view scene) {
  const std::lock_guard lock(mutex_);
  const auto found = scenes_.find(scene);
  if (found == scenes_.end() || found->second == nullptr) return std::make_shared<RecordingLosses>();
  std::shared_ptr<RecordingLosses>& losses = losses_[found->first];
  if (losses == nullptr) losses = std::make_shared<RecordingLosses>();
  return losses;
}

SceneRegistry::LossesOfScenes SceneRegistry::recording_losses() const {
  const std::shared_lock lock(mutex_);
  return {losses_.begin(), losses_.end()};
}

std::vector<RunnerPtr> SceneRegistry::list() const {
  const std::shared_lock lock(mutex_);
  std::vector<RunnerPtr> runners;
  for (const auto& [name, runner] : scenes_) {
    if (runner != nullptr) runners.push_back(runner);
  }
  return runners;
}

std::vector<RunnerPtr> SceneRegistry::close() {
  std::vector<RunnerPtr> runners;
  {
    const std::lock_guard lock(mutex_);
    closed_ = true;
    for (auto scene = scenes_.begin(); scene != scenes_.end();) {
      if (scene->second == nullptr) {
        ++scene;
        continue;
      }
      runners.push_back(std::move(scene->second));
      runners.back()->cancel();
      scene = scenes_.erase(scene);
    }
  }
  changed();
  return runners;
}

void SceneRegistry::changed() {
  generation_.fetch_add(1, std::memory_order_release);
  output_signal_();
}

}  // namespace tensormass::control
