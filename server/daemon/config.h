#pragma once

#include <cstdint>
#include <string>

#include "core/bus_limits.h"
#include "core/http2_limits.h"
#include "core/log.h"
#include "core/result.h"
#include "core/state_limits.h"
#include "world/runner_options.h"

namespace tensormass::daemon {

/// The daemon's settings. A flag overrides the environment (TENSORMASS_*), which overrides the config file, which
/// overrides these defaults. `tensormassd --help` documents each.
struct Config {
  world::BackendChoice backend = world::BackendChoice::kAuto;
  /// Threads of a CPU scene that does not set its own. The command line's default is half the cores.
  std::uint32_t cpu_threads = 1;
  /// Concurrent scenes that must keep their rates on one GPU.
  std::uint32_t gpu_scenes = 1;
  std::string server_name = "local";
  std::string control = "127.0.0.1:50051";
  /// Endpoints of the data plane. Empty turns the transport off; users write "off".
  std::string zeromq_publish = "tcp://127.0.0.1:50052";
  std::string zeromq_pose = "tcp://127.0.0.1:50053";
  std::string zenoh_listen = "tcp/127.0.0.1:7447";
  /// Clients connected over zenoh at once.
  std::uint32_t zenoh_sessions = limits::kDefaultZenohSessions;
  /// HOST:PORT at which Prometheus scrapes /metrics; only this machine reaches it. Empty if the option is "off".
  std::string metrics;
  /// What scenes may take (control/admission.h). 0: the default.
  std::uint64_t max_scene_mib = 0;
  std::uint64_t max_memory_mib = 0;
  std::uint64_t max_message_mib = limits::kDefaultHalfSentBytes >> 20;
  double max_load_s = 600;
  /// Folder of the keys (access/key_ring.h). Empty: no client is asked who it is, so every endpoint must be local.
  std::string keys;
  spdlog::level::level_enum log_level = spdlog::level::info;
  log::Format log_format = log::Format::kText;
  /// HOST:PORT of the health service, which asks for no key (control/health_server.h). Empty if the option is "off".
  std::string health;
  /// Folder in which scenes and their snapshots are kept (state_store.h). Empty: nothing is kept.
  std::string state;
  std::uint64_t max_state_mib = limits::kDefaultStateMib;
  /// Path of the ready file (daemon.h). Empty: no file is written.
  std::string ready_file;
  /// True: print the effective settings and exit.
  bool check_only = false;
};

/// The outcome of parsing a command line: settings to run with, or text to print before exiting.
struct ParsedCommandLine {
  Config config;
  /// True: print `output` and exit with `exit_status`, 0 after help, version or the checked settings, 2 after an error.
  bool exits = false;
  int exit_status = 0;
  std::string output;
};

/// Returns "" if the settings have keys, or nobody else can reach the endpoints. Otherwise the refusal, which is the
/// command that makes keys.
std::string check_keys(const Config& config);

/// Reads the flags, the environment and the config file. Every error names the setting.
ParsedCommandLine parse_command_line(int argc, const char* const* argv);

/// Returns true if only this machine can reach the endpoint: host:port, tcp://host:port, tcp/host:port or ipc://path.
/// As a host, `localhost` and the literal addresses of the loopback interface count.
bool is_local_endpoint(std::string_view endpoint);

}  // namespace tensormass::daemon
