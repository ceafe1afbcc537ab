#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "access/key_ring.h"
#include "bus/bus.h"
#include "control/control_server.h"
#include "control/health_server.h"
#include "control/scene_registry.h"
#include "core/journal.h"
#include "daemon/config.h"
#include "daemon/publisher.h"
#include "daemon/service_manager.h"
#include "daemon/state_keeper.h"
#include "daemon/vitals.h"
#include "metrics/metrics_server.h"
#include "tensormass/v1/control.pb.h"
#include "world/placement.h"

namespace tensormass::daemon {

/// Everything that serves clients: the scenes, the data plane, the control plane. main.cpp adds arguments and signals.
///
///     thread                  runs                                         waits for
///     gRPC, one per call      ControlService -> SceneRegistry -> Runner    the scene's loop, between two steps
///     doorkeeper              accept on the control port                   connections
///     relay                   bytes between control clients and gRPC       its sockets
///     loop, one per scene     steps, writes mailboxes (world/loop.h)       its clock
///     key ring                who has a key (access/key_ring.h)            its clock, and a zenoh session that opens
///     publisher               mailboxes -> bus (publisher.h)               the loops' signal
///     keeper, one per scene   snapshots -> files (state_keeper.h)          its clock, the scene's loop, the disk
///     vitals                  whether all of them turn (vitals.h)          its clock
///     metrics                 GET /metrics (metrics/metrics_server.h)      its sockets
///     ZeroMQ's receiver       poses -> receive_pose                        its sockets
///     zenoh's threads         poses -> receive_pose                        their sockets
///
///     client ──pose──> Bus ──> receive_pose ──> SceneRegistry::find ──> Runner::submit_pose, keeps the newest
///     client <──force── Bus <── Publisher <── mailboxes of the Runner <── loop
///
/// No thread of a transport waits for a step, and no loop waits for a transport. Refused calls, poses, messages and
/// clients are counted, and logged at a limited rate.
class Daemon {
 public:
  /// What the daemon needs of the process around it.
  struct Process {
    const ServiceManager& manager;
    /// Returns true if a signal to end waits. Scenes that come back take long.
    std::function<bool()> stop_asked;
    /// Called once, on a thread of the daemon, if the process lost its device: it must end, and another one start.
    std::function<void()> on_device_lost;
  };

  /// Opens every endpoint of `config` and brings back the scenes of `--state`. The daemon serves when it returns. Fails
  /// if an endpoint cannot be listened on, the device does not answer or the folder cannot be used, and names it.
  static Result<std::unique_ptr<Daemon>> start(const Config& config, const Process& process);
  /// Ends the daemon in this order:
  /// 1. The health service answers NOT_SERVING. Last states of the scenes are taken, in limits::kLastStateTime at most.
  ///    The registry refuses loads and cancels running steps.
  /// 2. The publisher sends zero forces and stops: hands are released before anything that may take long.
  /// 3. /metrics closes.
  /// 4. The key ring stops, after a session of zenoh that it may be opening.
  /// 5. The gRPC server lets running calls end, then cancels them.
  /// 6. The loops of the scenes are joined, which takes up to a step each.
  /// 7. The last states are written.
  /// 8. The transports send what is queued and close.
  ~Daemon();

  /// The answer of GetVersion, except for its count of malformed messages.
  const v1::GetVersionResponse& identity() const { return identity_; }
  /// HOST:PORT of gRPC, with the port that was chosen.
  const std::string& control_endpoint() const { return server_->endpoint(); }
  /// HOST:PORT of /metrics; empty if it is off.
  std::string_view metrics_endpoint() const { return metrics_ ? metrics_->endpoint() : std::string_view(); }

 private:
  /// placement: nullptr on the CPU
  Daemon(const Config& config, const world::BackendDescription& backend,
         const std::shared_ptr<world::Placement>& placement);
  Result<void> open(const Config& config, const Process& process);
  /// Says "live" or "ready" on both health services.
  void set_health(const std::string& name, bool serving);
  /// Gives a pose to its scene. Runs on transports' threads and does not block.
  void receive_pose(std::string_view scene, std::string_view tool, const v1::ToolPose& pose, const bus::Sender& sender);
  /// Logs a malformed message and counts it in the status of its scene. Runs on the threads of the transports.
  void note_malformed(const Refused& message);
  /// Counts and logs a connection to an endpoint that was refused. Runs on the threads of doorkeepers and relays.
  void note_connection(std::string_view endpoint, std::string_view who, std::string_view why);
  /// Malformed messages on the data plane, plus connections refused on the control port.
  std::uint64_t malformed_count() const;
  /// The answer of GetMetrics and of /metrics.
  std::string metrics_text() const;

  v1::GetVersionResponse identity_;
  WakeUp wake_up_;
  Journal journal_;
  std::atomic<std::uint64_t> refused_connections_{0};
  control::SceneRegistry registry_;
  std::unique_ptr<StateKeeper> keeper_;    // nullptr: nothing is kept
  std::unique_ptr<access::KeyRing> keys_;  // nullptr: nobody is asked who it is
  std::unique_ptr<bus::Bus> bus_;
  std::optional<Publisher> publisher_;
  std::unique_ptr<control::HealthServer> health_;  // nullptr: only the control endpoint answers for health
  std::unique_ptr<control::ControlServer> server_;
  std::optional<Vitals> vitals_;
  std::unique_ptr<metrics::MetricsServer> metrics_;  // nullptr: it is off
};

/// A JSON file with the daemon's endpoints, for launchers that wait until it appears.
///
/// A reader never sees half of it: it is written under another name and then renamed. The destructor removes it, unless
/// another daemon has replaced it since. If the path is a symbolic link, the file it points to is replaced and the link
/// stays.
class ReadyFile {
 public:
  /// Writes {"pid", "version", "server", "backend", "device", "control", "zeromq_publish", "zeromq_pose", "zenoh",
  /// "metrics"}. An endpoint that is turned off is "". Fails with kInvalidArgument if `path` exists and is not a
  /// regular file, and with kUnavailable if the file cannot be written.
  static Result<ReadyFile> write(const std::string& path, const Daemon& daemon);
  ReadyFile(ReadyFile&& other) noexcept : path_(std::exchange(other.path_, {})), inode_(other.inode_) {}
  ~ReadyFile();

 private:
  ReadyFile(std::string path, std::uint64_t inode) : path_(std::move(path)), inode_(inode) {}
  std::string path_;     // empty: moved from
  std::uint64_t inode_;  // identifies the file that we wrote
};

}  // namespace tensormass::daemon
