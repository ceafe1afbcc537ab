#include "daemon/state_keeper.h"

#include <algorithm>
#include <new>
#include <system_error>
#include <utility>

#include <fmt/format.h>

#include "core/thread_name.h"

namespace tensormass::daemon {
namespace {

/// Time after which a scene is asked again that could not be kept, because memory is short or a disk is full.
constexpr std::chrono::milliseconds kStateRetry{500};

}  // namespace

StateKeeper::StateKeeper(std::unique_ptr<StateStore> store, std::chrono::milliseconds period)
    : store_(std::move(store)), period_(period) {}

StateKeeper::~StateKeeper() {
  std::map<std::string, std::unique_ptr<Scene>> scenes;
  {
    const std::lock_guard lock(mutex_);
    scenes.swap(scenes_);
    for (auto& [name, scene] : scenes) scene->ended = true;
  }
  wake_.notify_all();
  for (auto& [name, scene] : scenes) scene->thread.join();
  for (const auto& scene : ended_) scene->thread.join();
}

void StateKeeper::bring_back(control::SceneRegistry& registry, const std::function<bool()>& stop_asked) {
  const model::Progress progress([&](std::string_view, double) { return !stop_asked(); });
  for (const std::string& name : store_->scenes()) {
    if (stop_asked()) return;
    const auto loaded = store_->read_scene(name).and_then([&](const v1::Scene& scene) {
      return registry.load(scene, progress, [this](const control::RunnerPtr& runner) {
        restore(runner);
        start(runner, store_->ticket(runner->name()));
      });
    });
    if (loaded) continue;
    if (loaded.error().code == ErrorCode::kCancelled) return;
    log::error("scene does not come back",
               {{"scene", name}, {"reason", loaded.error().message}, {"files", store_->path_of("aside")}});
    store_->move_to_aside(name);
  }
}

/// Brings the newest state that fits to a scene that was just loaded.
void StateKeeper::restore(const control::RunnerPtr& runner) {
  const std::string& name = runner->name();
  bool begins = true, adjusted = false, pauses = false;
  for (const std::uint64_t generation : store_->generations(name)) {
    const auto unusable = [&](std::string_view why) {
      log::warn("snapshot is not used",
                {{"scene", name}, {"generation", generation}, {"reason", why}, {"files", store_->path_of("aside")}});
      store_->move_to_aside(name, generation);
    };
    const auto kept = store_->read_snapshot(name, generation);
    if (!kept) {
      unusable(kept.error().message);
      continue;
    }
    // An operator's values and pause hold for every version, and also for a scene that starts from its beginning.
    if (!adjusted) {
      pauses = kept->paused;
      adjusted = true;
      if (const auto done = runner->adjust(kept->adjustments); !done) {
        log::warn("adjusted values do not come back", {{"scene", name}, {"reason", done.error().message}});
      }
    }
    if (kept->version != store_->version()) {
      unusable(fmt::format("it is of version {}, and this is version {}", kept->version, store_->version()));
      continue;
    }
    const auto status = runner->restore(kept->snapshot);
    if (!status) {
      unusable(status.error().message);
      continue;
    }
    begins = false;
    log::info("scene is back", {{"scene", name}, {"generation", generation}, {"step", status->step()}});
    break;
  }
  if (begins)
    log::warn("scene starts from its beginning", {{"scene", name}, {"reason", "no snapshot of it is usable"}});
  if (pauses) (void)runner->pause();
}

void StateKeeper::take_last(std::chrono::milliseconds at_most) {
  std::unique_lock lock(mutex_);
  for (auto& [name, scene] : scenes_) scene->last = true;
  wake_.notify_all();
  wake_.wait_for(lock, at_most, [&] {
    return std::all_of(scenes_.begin(), scenes_.end(), [](const auto& entry) { return entry.second->taken; });
  });
}

void StateKeeper::follow(const control::RunnerPtr& runner) { start(runner, add(*runner)); }

/// Writes the scene. Returns 0 if it keeps no message to write, or the store refused it.
StateStore::Ticket StateKeeper::add(const world::Runner& runner) {
  if (runner.source() == nullptr) return 0;
  const auto added = store_->add(*runner.source());
  if (!added) log_failure(runner.name(), added.error());
  return added.value_or(0);
}

void StateKeeper::start(const control::RunnerPtr& runner, StateStore::Ticket ticket) {
  join_ended();
  const std::lock_guard lock(mutex_);
  auto& scene = scenes_[runner->name()];
  TM_ASSERT(scene == nullptr, "the registry forgets a scene before it takes another one of its name");
  scene = std::make_unique<Scene>();
  scene->runner = runner;
  scene->name = runner->name();
  scene->ticket = ticket;
  scene->next = ticket == 0 ? kStateRetry : period_;
  try {
    scene->thread = std::thread([this, kept = scene.get()] { run(*kept); });
  } catch (const std::system_error& failure) {
    log_failure(runner->name(), {ErrorCode::kResourceExhausted, failure.what()});
    scenes_.erase(runner->name());
  }
}

void StateKeeper::forget(const std::string& name) {
  {
    const std::lock_guard lock(mutex_);
    const auto scene = scenes_.find(name);
    if (scene != scenes_.end()) {
      scene->second->ended = true;
      ended_.push_back(std::move(scene->second));
      scenes_.erase(scene);
    }
  }
  wake_.notify_all();
  store_->remove(name);  // a snapshot that is being written is dropped, because its ticket has ended
}

/// Joins threads of forgotten scenes. A thread that still waits for its scene or a disk is joined later.
void StateKeeper::join_ended() {
  const std::lock_guard lock(mutex_);
  std::erase_if(ended_, [](const std::unique_ptr<Scene>& scene) {
    if (!scene->done) return false;
    scene->thread.join();
    return true;
  });
}

void StateKeeper::run(Scene& scene) {
  name_thread("keep " + scene.name);
  std::unique_lock lock(mutex_);
  while (!scene.ended) {
    wake_.wait_for(lock, scene.next, [&] { return scene.ended || (scene.last && !scene.taken); });
    if (scene.ended || scene.taken) break;
    lock.unlock();
    keep(scene);
    lock.lock();
  }
  scene.taken = scene.done = true;
  wake_.notify_all();
}

/// Says that a state was taken, before it is written: who ends the scenes need not wait for a disk.
void StateKeeper::took(Scene& scene, std::chrono::milliseconds next) {
  const std::lock_guard lock(mutex_);
  scene.next = next;
  if (scene.last) scene.taken = true;
  wake_.notify_all();
}

void StateKeeper::keep(Scene& scene) {
  const control::RunnerPtr runner = scene.runner.lock();
  if (runner == nullptr) return took(scene, period_);
  try {
    if (scene.ticket == 0 && runner->source() != nullptr) {
      scene.ticket = add(*runner);
      if (scene.ticket == 0) return took(scene, kStateRetry);
    }
    const world::StateMark mark = runner->mark();
    if (scene.written == mark) return took(scene, period_);
    auto kept = runner->keep();
    if (!kept) {
      // A scene whose device failed has no state, until a reset changes its mark.
      if (kept.error().code == ErrorCode::kFailedPrecondition) scene.written = mark;
      return took(scene, kStateRetry);
    }
    log::debug(
        "state was taken",
        {{"scene", scene.name}, {"bytes", kept->snapshot.size()}, {"loop_waited_us", kept->held.count() / 1000}});
    took(scene, std::max(period_, std::chrono::ceil<std::chrono::milliseconds>(limits::kStateRest * kept->held)));
    const auto written = store_->write(scene.name, scene.ticket,
                                       {{}, kept->paused, std::move(kept->adjustments), std::move(kept->snapshot)});
    if (written) {
      scene.written = mark;
    } else {
      log_failure(scene.name, written.error());
    }
  } catch (const std::bad_alloc&) {
    log_failure(scene.name, {ErrorCode::kResourceExhausted, "there is no memory for it"});
    took(scene, kStateRetry);
  }
}

void StateKeeper::log_failure(const std::string& scene, const Error& error) {
  if (const auto suppressed = failure_lines_.admit()) {
    log::error("state is not kept", {{"scene", scene},
                                     {"reason", error.message},
                                     {"then", "the last good snapshot stays, and it is tried again"},
                                     {"suppressed", *suppressed}});
  }
}

}  // namespace tensormass::daemon
