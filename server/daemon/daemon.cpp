#include "daemon/daemon.h"

#include <sys/stat.h>
#include <unistd.h>

#include <cstdio>
#include <filesystem>
#include <fstream>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "core/state_limits.h"
#include "metrics/daemon_metrics.h"

namespace tensormass::daemon {
namespace {

constexpr double kMib = 1 << 20;

/// The lines of zenoh, which clients can cause at any rate.
class ZenohLog {
 public:
  /// who: the client that was disconnected; empty: a line of zenoh's own
  void note(bool is_error, std::string_view who, std::string_view message) {
    if (!who.empty()) {
      return journal_.note(Journal::Kind::kZenoh, "closed",
                           {.who = who, .what = "a connection over zenoh", .reason = message});
    }
    if (const auto suppressed = lines_.admit()) {
      log::write(is_error ? spdlog::level::err : spdlog::level::warn, "zenoh",
                 {{"message", message}, {"suppressed", *suppressed}});
    }
  }

 private:
  Journal journal_;
  log::Limiter lines_;
};

}  // namespace

Result<std::unique_ptr<Daemon>> Daemon::start(const Config& config, const Process& process) {
  if (std::string refusal = check_keys(config); !refusal.empty()) return invalid(std::move(refusal));
  TM_ASSIGN_OR_RETURN(backend, world::describe_backend(config.backend));
  const auto placement = backend.backend == "cuda" ? world::Placement::of_this_machine() : nullptr;
  std::unique_ptr<Daemon> daemon(new Daemon(config, backend, placement));
  TM_RETURN_IF_ERROR(daemon->open(config, process));
  const v1::GetVersionResponse& identity = daemon->identity();
  if (config.backend == world::BackendChoice::kAuto && backend.backend == "cpu") {
    log::warn("no GPU answers: scenes run on the CPU", {{"device", backend.device}, {"reason", backend.reason}});
  }
  log::info("serving", {{"version", identity.version()},
                        {"server", identity.server()},
                        {"backend", identity.backend()},
                        {"device", identity.device()},
                        {"devices", identity.device_count()},
                        {"control", daemon->control_endpoint()},
                        {"zeromq_publish", identity.zeromq_publish_endpoint()},
                        {"zeromq_pose", identity.zeromq_pose_endpoint()},
                        {"zenoh", identity.zenoh_locator()},
                        {"health", daemon->health_ ? daemon->health_->endpoint() : ""},
                        {"metrics", daemon->metrics_endpoint()},
                        {"keys", config.keys}});
  return daemon;
}

Daemon::Daemon(const Config& config, const world::BackendDescription& backend,
               const std::shared_ptr<world::Placement>& placement)
    : registry_({.backend = config.backend,
                 .cpu_threads = config.cpu_threads,
                 .gpu_scenes = config.gpu_scenes,
                 .placement = placement},
                [this] { wake_up_.signal(); },
                {.scene_bytes = static_cast<double>(config.max_scene_mib) * kMib,
                 .all_bytes = static_cast<double>(config.max_memory_mib) * kMib,
                 .load_s = config.max_load_s,
                 .message_bytes = static_cast<double>(config.max_message_mib) * kMib}) {
  identity_.set_version(TENSORMASS_VERSION);
  identity_.set_server(config.server_name);
  identity_.set_backend(backend.backend);
  identity_.set_device(backend.device);
  if (placement != nullptr) identity_.set_device_count(static_cast<std::uint32_t>(placement->device_count()));
  identity_.set_backend_reason(backend.reason);
}

Result<void> Daemon::open(const Config& config, const Process& process) {
  if (!config.state.empty()) {
    TM_ASSIGN_OR_RETURN(store, StateStore::open(config.state, TENSORMASS_VERSION, config.max_state_mib << 20));
    keeper_ = std::make_unique<StateKeeper>(std::move(store));
    registry_.set_follower(keeper_.get());
  }
  if (!config.keys.empty()) {
    TM_ASSIGN_OR_RETURN(keys, access::KeyRing::open(config.keys));
    keys_ = std::move(keys);
  }
  bus::BusOptions options;
  options.server = config.server_name;
  options.zeromq_publish_endpoint = config.zeromq_publish;
  options.zeromq_pose_endpoint = config.zeromq_pose;
  options.zenoh_listen = config.zenoh_listen;
  options.zenoh_sessions = config.zenoh_sessions;
  options.keys = keys_.get();
  options.on_pose = [this](auto&&... pose) { receive_pose(pose...); };
  options.on_malformed = [this](const Refused& message) { note_malformed(message); };
  // zenoh's log outlives the daemon.
  options.on_log = [lines = std::make_shared<ZenohLog>()](auto&&... line) { lines->note(line...); };
  TM_ASSIGN_OR_RETURN(bus, bus::Bus::open(options));
  bus_ = std::move(bus);
  identity_.set_zeromq_publish_endpoint(bus_->endpoints().zeromq_publish);
  identity_.set_zeromq_pose_endpoint(bus_->endpoints().zeromq_pose);
  identity_.set_zenoh_locator(bus_->endpoints().zenoh_locator);

  publisher_.emplace(registry_, *bus_, config.server_name, wake_up_);
  if (!config.health.empty()) {
    TM_ASSIGN_OR_RETURN(health,
                        control::HealthServer::start(config.health, [this](std::string_view who, std::string_view why) {
                          note_connection("health", who, why);
                        }));
    health_ = std::move(health);
    set_health("live", true);
    set_health("ready", false);
  }
  // The control endpoint opens later: until its scenes are loaded, the daemon would answer that they do not exist.
  if (keeper_) keeper_->bring_back(registry_, process.stop_asked);
  const control::ControlServer::OnRefused on_refused{
      .connection =
          [this](std::string_view who, std::string_view why) {
            registry_.refusals().count(control::Limit::kControlConnection);
            note_connection("control", who, why);
          },
      .call =
          [this](bool by_role, const Refused& call) {
            journal_.note(by_role ? Journal::Kind::kRole : Journal::Kind::kCall, "refused", call);
          }};
  TM_ASSIGN_OR_RETURN(server, control::ControlServer::start(
                                  config.control, registry_, identity_, [this] { return malformed_count(); },
                                  on_refused, keys_.get(), [this] { return metrics_text(); }));
  server_ = std::move(server);
  if (!config.metrics.empty()) {
    TM_ASSIGN_OR_RETURN(metrics, metrics::MetricsServer::start(
                                     config.metrics, [this] { return metrics_text(); }, &is_local_endpoint));
    metrics_ = std::move(metrics);
  }
  if (keys_) keys_->follow([this] { return bus_->keys_changed(); });
  set_health("ready", true);
  vitals_.emplace(Vitals::Watched{.manager = process.manager,
                                  .scenes = [this] { return registry_.list(); },
                                  .publisher_turns = [this] { return publisher_->turns(limits::kTurnTime); },
                                  .on_live = [this](bool live) { set_health("live", live); },
                                  .on_device_lost =
                                      [end = process.on_device_lost](const std::string& scene) {
                                        log::error("the process lost its device",
                                                   {{"scene", scene},
                                                    {"reason", "after this CUDA error no call of CUDA works"},
                                                    {"then", "the daemon ends, for another one to start"}});
                                        end();
                                      }});
  return {};
}

Daemon::~Daemon() {
  vitals_.reset();
  set_health("ready", false);
  if (server_ != nullptr) server_->announce_shutdown();
  if (keeper_) keeper_->take_last(limits::kLastStateTime);
  std::vector<control::RunnerPtr> ending = registry_.close();
  publisher_.reset();
  metrics_.reset();
  if (keys_) keys_->stop();
  server_.reset();
  ending.clear();
  keeper_.reset();
  health_.reset();
  bus_.reset();
}

void Daemon::set_health(const std::string& name, bool serving) {
  if (health_ != nullptr) health_->set(name, serving);
  if (server_ != nullptr) server_->set_health(name, serving);
}

void Daemon::receive_pose(std::string_view scene, std::string_view tool, const v1::ToolPose& pose,
                          const bus::Sender& sender) {
  const auto submitted =
      registry_.find(scene).and_then([&](const control::RunnerPtr& runner) { return runner->submit_pose(tool, pose); });
  if (submitted) return;
  journal_.note(Journal::Kind::kPose, "refused",
                {.who = sender.who(), .what = "a pose", .scene = scene, .reason = submitted.error().message});
}

void Daemon::note_malformed(const Refused& message) {
  if (const auto runner = registry_.find(message.scene)) (*runner)->count_malformed_pose();
  // A kind of its own: the refusals before it would hide the line, and none may follow.
  if (message.is_closed) return journal_.note(Journal::Kind::kFlood, "closed", message);
  journal_.note(Journal::Kind::kMessage, "refused", message);
}

void Daemon::note_connection(std::string_view endpoint, std::string_view who, std::string_view why) {
  ++refused_connections_;
  journal_.note(Journal::Kind::kConnection, "closed",
                {.who = who, .what = fmt::format("a connection to the {} endpoint", endpoint), .reason = why});
}

std::uint64_t Daemon::malformed_count() const { return bus_->malformed_count() + refused_connections_; }

std::string Daemon::metrics_text() const {
  return metrics::to_text(metrics::read_metrics(registry_, identity_, malformed_count(), bus_->counts()));
}

namespace {
/// Returns 0 if there is no such file.
std::uint64_t inode_of(const std::string& path) {
  struct stat found {};
  return stat(path.c_str(), &found) == 0 ? found.st_ino : 0;
}
}  // namespace

Result<ReadyFile> ReadyFile::write(const std::string& asked, const Daemon& daemon) {
  std::error_code none;
  const std::filesystem::path there = std::filesystem::canonical(asked, none);  // follows links; empty: no file
  if (!there.empty() && !std::filesystem::is_regular_file(there, none)) {
    // The rename below would replace a device or a pipe by our file.
    return fail(ErrorCode::kInvalidArgument, fmt::format("--ready-file: '{}' exists and is not a regular file", asked));
  }
  const std::string path = there.empty() ? asked : there.string();
  const v1::GetVersionResponse& identity = daemon.identity();
  std::string json = fmt::format("{{\"pid\": {}", getpid());
  for (const auto& [key, value] : std::vector<std::pair<std::string_view, std::string_view>>{
           {"version", identity.version()},
           {"server", identity.server()},
           {"backend", identity.backend()},
           {"device", identity.device()},
           {"control", daemon.control_endpoint()},
           {"zeromq_publish", identity.zeromq_publish_endpoint()},
           {"zeromq_pose", identity.zeromq_pose_endpoint()},
           {"zenoh", identity.zenoh_locator()},
           {"metrics", daemon.metrics_endpoint()}}) {
    json += fmt::format(", {}: {}", log::json_quoted(key), log::json_quoted(value));
  }
  json += "}\n";
  const std::string unfinished = fmt::format("{}.{}", path, getpid());
  std::ofstream file(unfinished);
  file << json;
  file.close();
  if (!file || std::rename(unfinished.c_str(), path.c_str()) != 0) {
    std::remove(unfinished.c_str());
    return fail(ErrorCode::kUnavailable, fmt::format("--ready-file: cannot write '{}'; does its folder exist?", path));
  }
  return ReadyFile(path, inode_of(path));
}

ReadyFile::~ReadyFile() {
  if (!path_.empty() && inode_of(path_) == inode_) std::remove(path_.c_str());
}

}  // namespace tensormass::daemon
