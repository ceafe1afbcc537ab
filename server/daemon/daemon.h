#pragma once

#include <atomic>
#include <cstdint>
#include <memory>
#include <optional>

#include "bus/bus.h"
#include "control/control_server.h"
#include "control/control_service.h"
#include "control/scene_registry.h"
#include "daemon/config.h"
#include "daemon/publisher.h"

namespace tensormass::daemon {

/// Everything that serves, from the first endpoint to the last scene. What the program adds are arguments and signals.
class Daemon {
 public:
  /// Serving when it returns. Errors name the endpoint, or the device that does not answer.
  static Result<std::unique_ptr<Daemon>> start(const Config& config);
  /// In this order: no new scenes, forces to zero, calls drained, loops joined, transports closed.
  ~Daemon();

  /// What GetVersion answers.
  const v1::GetVersionResponse& identity() const { return identity_; }
  /// Of gRPC, with the port that was chosen.
  const std::string& control_endpoint() const { return server_->endpoint(); }

 private:
  Daemon(const Config& config, std::string backend, std::string device);
  Result<void> open(const Config& config);
  void receive_pose(std::string_view scene, std::string_view tool, const v1::ToolPose& pose);
  void note_malformed(std::string_view scene, std::string_view reason);
  std::uint64_t malformed_count() const;

  v1::GetVersionResponse identity_;
  WakeUp wake_up_;
  log::Limiter refused_poses_;
  log::Limiter malformed_messages_;
  std::atomic<std::uint64_t> refused_connections_{0};
  control::SceneRegistry registry_;
  std::unique_ptr<bus::Bus> bus_;
  std::optional<Publisher> publisher_;
  std::optional<control::ControlService> service_;
  std::unique_ptr<control::ControlServer> server_;
};

/// Written whole or not at all, for launchers that wait for it; gone again when the daemon has ended, unless another
/// one has put its own there since. A link to a file stays one.
class ReadyFile {
 public:
  /// {"version", "server", "pid", "backend", "device", "control", "zeromq_publish", "zeromq_pose", "zenoh"}; endpoints
  /// that are off are "".
  static Result<ReadyFile> write(const std::string& path, const Daemon& daemon);
  ReadyFile(ReadyFile&& other) noexcept : path_(std::exchange(other.path_, {})), inode_(other.inode_) {}
  ~ReadyFile();

 private:
  ReadyFile(std::string path, std::uint64_t inode) : path_(std::move(path)), inode_(inode) {}
  std::string path_;
  std::uint64_t inode_;
};

}  // namespace tensormass::daemon
