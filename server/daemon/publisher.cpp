#include "daemon/publisher.h"

#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <memory>
#include <new>
#include <set>
#include <utility>

#include <fmt/format.h>

#include "bus/keys.h"
#include "core/thread_name.h"
#include "step/finding_message.h"

namespace tensormass::daemon {
namespace {

/// Longest wait [ms]. A paused scene writes nothing and signals nothing, but its status must still be published.
constexpr int kIdleWakeUpMs = 50;

/// Shortest time between two messages of changes, and of events. Each has all of them, so fewer lose nothing.
constexpr std::chrono::milliseconds kChangesPeriod{50};

/// suppressed: lines of other findings that a limit has kept back.
void log_finding(const std::string& scene, const v1::Finding& finding, std::uint64_t suppressed) {
  log::write(finding.accepted().empty() ? spdlog::level::warn : spdlog::level::info, "finding",
             {{"scene", scene},
              {"code", step::name_of(finding)},
              {"value", finding.value()},
              {"limit", finding.limit()},
              {"unit", finding.unit()},
              {"place", finding.place()},
              {"message", finding.message()},
              {"remedy", finding.remedy()},
              {"accepted", finding.accepted()},
              {"suppressed", suppressed}});
}

}  // namespace

WakeUp::WakeUp() : event_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {}

WakeUp::~WakeUp() { close(event_); }

void WakeUp::signal() {
  if (!signalled_.exchange(true, std::memory_order_acq_rel)) eventfd_write(event_, 1);
}

void WakeUp::wait(int timeout_ms) {
  pollfd item{event_, POLLIN, 0};
  poll(&item, 1, timeout_ms);
  eventfd_t count;
  eventfd_read(event_, &count);
  // Only after the read; publisher.h says why.
  signalled_.exchange(false, std::memory_order_acq_rel);
}

Publisher::Publisher(const control::SceneRegistry& registry, bus::Bus& bus, std::string server, WakeUp& wake_up)
    : registry_(registry), bus_(bus), server_(std::move(server)), wake_up_(wake_up) {
  thread_ = std::thread([this] { run(); });
}

Publisher::~Publisher() {
  stop_ = true;
  wake_up_.signal();
  thread_.join();
}

void Publisher::run() {
  name_thread("publisher");
  while (true) {
    const bool last = stop_;
    turned_.store(now(), std::memory_order_relaxed);
    try {
      follow_registry();
      if (!last) publish_news();
    } catch (const std::bad_alloc&) {
      // What could not be sent is dropped, as for a slow reader. Scenes that were not started yet are started next
      // time.
      generation_ = 0;
    }
    if (last) return;
    wake_up_.wait(kIdleWakeUpMs);
  }
}

void Publisher::publish_news() {
  for (auto& [name, scene] : scenes_) publish_feedback(name, scene);
  for (auto& [name, scene] : scenes_) {
    const control::RunnerPtr runner = scene.runner.lock();
    if (runner == nullptr) continue;
    const bool has_frame = runner->take_frame(frame_);
    follow_tools(name, scene, *runner);
    publish_changes(scene, *runner);
    if (has_frame) bus_.publish(scene.frame_key, frame_);
    if (runner->take_status(status_)) {
      bus_.publish(scene.status_key, status_, {.retain = true});
      log_recovery(name, scene);
      log_findings(name, scene);
    }
    if (!has_frame) continue;
    // Sending a large frame takes long; forces that arrived meanwhile go before the next frame.
    for (auto& [other_name, other] : scenes_) publish_feedback(other_name, other);
  }
}

/// Logs what the newest status says of recoveries and of a fault, once each.
void Publisher::log_recovery(const std::string& name, Scene& scene) {
  const std::uint64_t before = std::exchange(scene.recoveries, status_.recoveries());
  if (status_.recoveries() > before) {
    if (const auto suppressed = recovery_lines_.admit()) {
      log::warn("scene recovers", {{"scene", name},
                                   {"recoveries", status_.recoveries()},
                                   {"reason", status_.guard_text()},
                                   {"suppressed", *suppressed}});
    }
  }
  const bool stopped = !status_.fault().empty();
  if (stopped && !scene.stopped) log::error("scene stopped", {{"scene", name}, {"reason", status_.fault()}});
  scene.stopped = stopped;
}

/// Logs each finding about results once while it lasts.
void Publisher::log_findings(const std::string& name, Scene& scene) {
  std::set<std::string> found;
  for (const v1::Finding& finding : status_.findings()) {
    if (!step::is_of_results(finding) || !finding.accepted().empty()) continue;
    const std::string key = fmt::format("{} {} {}", finding.code(), finding.body(), finding.tool());
    found.insert(key);
    if (scene.found.contains(key)) continue;
    if (const auto suppressed = finding_lines_.admit()) log_finding(name, finding, *suppressed);
  }
  scene.found = std::move(found);
}

void Publisher::follow_registry() {
  const std::uint64_t generation = registry_.generation();
  if (std::exchange(generation_, generation) == generation) return;
  const std::vector<control::RunnerPtr> runners = registry_.list();
  std::set<const world::Runner*> loaded;
  for (const control::RunnerPtr& runner : runners) loaded.insert(runner.get());
  for (auto scene = scenes_.begin(); scene != scenes_.end();) {
    // An expired pointer whose address is in the list: the address was reused by another scene.
    if (loaded.contains(scene->second.id) && !scene->second.runner.expired()) {
      ++scene;
      continue;
    }
    end_scene(scene->second);
    log::info("scene unloaded", {{"scene", scene->first}});
    scene = scenes_.erase(scene);
  }
  for (const control::RunnerPtr& runner : runners) {
    if (!scenes_.contains(runner->name())) start_scene(runner);
  }
}

void Publisher::start_scene(const control::RunnerPtr& runner) {
  const std::string& name = runner->name();
  Scene scene(runner);
  scene.frame_key = bus::frame_key(server_, name);
  scene.status_key = bus::status_key(server_, name);
  scene.topology_key = bus::topology_key(server_, name);
  scene.changes_key = bus::changes_key(server_, name);
  scene.events_key = bus::events_key(server_, name);
  follow_tools(name, scene, *runner);
  // Everybody who subscribes gets a message, so nobody waits for what has not happened yet.
  events_.Clear();
  events_.set_topology_version(scene.topology_version);
  bus_.publish(scene.events_key, events_, {.retain = true});
  scenes_.emplace(name, std::move(scene));
  log::info("scene loaded", {{"scene", name}, {"bytes", runner->report().bytes_total()}});
  for (const v1::Finding& finding : runner->report().findings()) log_finding(name, finding, 0);
}

void Publisher::follow_tools(const std::string& name, Scene& scene, const world::Runner& runner) {
  const std::shared_ptr<const v1::Topology> topology = runner.topology();
  if (std::exchange(scene.topology_version, topology->version()) == topology->version()) return;
  std::map<std::string, std::string> keys;
  for (const v1::ToolShape& tool : topology->tools()) {
    keys.emplace(tool.name(), bus::feedback_key(server_, name, tool.name()));
  }
  for (v1::ToolFeedback& feedback : scene.feedback) {
    if (!keys.contains(feedback.tool())) release(scene.feedback_keys.at(feedback.tool()), feedback, true);
  }
  scene.feedback.clear();
  scene.feedback_keys = std::move(keys);
  bus_.publish(scene.topology_key, *topology, {.retain = true});
  // A reader of the topology must not wait for changes of it that have not come yet.
  changes_.Clear();
  if (!runner.changes(changes_)) changes_.set_topology_version(topology->version());
  bus_.publish(scene.changes_key, changes_, {.retain = true});
}

void Publisher::release(const std::string& key, v1::ToolFeedback& feedback, bool removed) {
  *feedback.mutable_force_n() = v1::Vector3();
  *feedback.mutable_torque_n_m() = v1::Vector3();
  // Zero stiffness as well as zero force: a client that evaluates the local model gets zero force at any pose.
  for (double& stiffness : *feedback.mutable_local_model()->mutable_stiffness_n_per_m()) stiffness = 0;
  feedback.mutable_local_model()->clear_yielding();
  feedback.set_removed(removed);
  bus_.publish(key, feedback, {.urgent = true});
}

void Publisher::end_scene(Scene& scene) {
  for (v1::ToolFeedback& feedback : scene.feedback) release(scene.feedback_keys.at(feedback.tool()), feedback, false);
  bus_.forget(scene.topology_key);
  bus_.forget(scene.status_key);
  bus_.forget(scene.changes_key);
  bus_.forget(scene.events_key);
}

void Publisher::publish_changes(Scene& scene, world::Runner& runner) {
  const auto time = std::chrono::steady_clock::now();
  if (time >= scene.next_changes && runner.take_changes(changes_)) {
    bus_.publish(scene.changes_key, changes_, {.retain = true});
    scene.next_changes = time + kChangesPeriod;
  }
  if (time >= scene.next_events && runner.take_events(events_)) {
    bus_.publish(scene.events_key, events_, {.retain = true});
    scene.next_events = time + kChangesPeriod;
  }
}

void Publisher::publish_feedback(const std::string& name, Scene& scene) {
  const control::RunnerPtr runner = scene.runner.lock();
  if (runner == nullptr) return;
  const bool has_news = runner->take_feedback(feedback_);
  follow_tools(name, scene, *runner);
  if (!has_news) return;
  // Tools may have changed once more meanwhile. Feedback of those that are gone must not follow its end.
  const auto is_gone = [&](const v1::ToolFeedback& one) { return !scene.feedback_keys.contains(one.tool()); };
  if (std::any_of(feedback_.begin(), feedback_.end(), is_gone)) return;
  std::swap(scene.feedback, feedback_);
  for (const v1::ToolFeedback& feedback : scene.feedback) {
    bus_.publish(scene.feedback_keys.at(feedback.tool()), feedback, {.urgent = true});
  }
}

}  // namespace tensormass::daemon
