#pragma once

#include <cstdint>
#include <string>

#include "core/log.h"
#include "core/result.h"
#include "world/runner.h"

namespace tensormass::daemon {

/// What the daemon was told: flags over environment (TENSORMASS_*) over config file over these defaults.
struct Config {
  world::BackendChoice backend = world::BackendChoice::kAuto;
  std::uint32_t cpu_threads = 1;
  std::uint32_t gpu_scenes = 1;
  std::string server_name = "local";
  std::string control = "127.0.0.1:50051";
  /// Empty (given as "off"): ZeroMQ is off; so for zenoh.
  std::string zeromq_publish = "tcp://127.0.0.1:50052";
  std::string zeromq_pose = "tcp://127.0.0.1:50053";
  std::string zenoh_listen = "tcp/127.0.0.1:7447";
  spdlog::level::level_enum log_level = spdlog::level::info;
  log::Format log_format = log::Format::kText;
  /// Empty: none is written.
  std::string ready_file;
  /// Print the effective configuration and end.
  bool check_only = false;
};

/// What a command line comes to: a configuration, or text to print and an exit status.
struct ParsedCommandLine {
  Config config;
  /// Set if there is nothing to run: help, version, the checked configuration (status 0), or an error (status 2).
  bool exits = false;
  int exit_status = 0;
  std::string output;
};

ParsedCommandLine parse_command_line(int argc, const char* const* argv);

/// True if the endpoint (host:port, tcp://host:port, tcp/host:port, ipc://path) can be reached from this machine only.
bool is_local_endpoint(std::string_view endpoint);

}  // namespace tensormass::daemon
