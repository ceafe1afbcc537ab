#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <optional>
#include <thread>
#include <utility>

#include "core/bus_limits.h"
#include "core/http2_limits.h"
#include "core/log.h"
#include "daemon/config.h"
#include "daemon/daemon.h"

namespace {

/// Longest time from the signal to the exit. Forces are zero long before. A longer step is cut off.
constexpr std::chrono::milliseconds kShutdownTime{1500};

/// Status after a CUDA error that ends the device's use for the process: EX_TEMPFAIL of sysexits.h. A service manager
/// starts the daemon again, and another process has a device that works.
constexpr int kDeviceLostStatus = 75;

/// Lets this process have as many descriptors as its limits of connections need together. Peers that hold connections
/// would otherwise leave none for a scene's files or another client: by default a process may have 1024.
void allow_descriptors(std::uint32_t zenoh_sessions) {
  // Client, and both ends of the socket pair to gRPC; of the control endpoint and the one for health.
  constexpr rlim_t kOfGrpc = 2 * 3 * tensormass::limits::kMaxControlConnections;
  constexpr rlim_t kOfZeroMq = 2 * tensormass::limits::kMaxZeroMqConnections;
  constexpr rlim_t kOthers = 1024;
  const rlim_t wanted = kOfGrpc + kOfZeroMq + zenoh_sessions + kOthers;
  rlimit files{};
  if (getrlimit(RLIMIT_NOFILE, &files) != 0 || files.rlim_cur >= wanted) return;
  files.rlim_cur = std::min(wanted, files.rlim_max);
  if (setrlimit(RLIMIT_NOFILE, &files) == 0 && files.rlim_cur == wanted) return;
  tensormass::log::warn(
      "few descriptors",
      {{"limit", files.rlim_cur},
       {"needed", wanted},
       {"reason", "peers that hold connections can use them up"},
       {"remedy", "raise the hard limit: LimitNOFILE of systemd, --ulimit nofile of docker, ulimit -Hn"}});
}

/// The signals that end the daemon.
sigset_t stop_signals() {
  sigset_t signals;
  sigemptyset(&signals);
  sigaddset(&signals, SIGTERM);
  sigaddset(&signals, SIGINT);
  return signals;
}

}  // namespace

int main(int argc, char** argv) {
  using namespace tensormass;
  const daemon::ParsedCommandLine parsed = daemon::parse_command_line(argc, argv);
  if (parsed.exits) {
    std::fputs(parsed.output.c_str(), parsed.exit_status == 0 ? stdout : stderr);
    return parsed.exit_status;
  }
  log::configure(parsed.config.log_level, parsed.config.log_format);

  // Blocks the signals before the first thread starts, so that every thread inherits the mask. Only sigwait below takes
  // them, on this thread.
  const sigset_t signals = stop_signals();
  pthread_sigmask(SIG_BLOCK, &signals, nullptr);
  std::signal(SIGPIPE, SIG_IGN);
  std::signal(SIGXFSZ, SIG_IGN);  // a file of --state beyond a limit of the system is an error of that file

  allow_descriptors(parsed.config.zenoh_sessions);

  const daemon::ServiceManager manager;
  static std::atomic<int> exit_status{EXIT_SUCCESS};
  const auto stop_asked = [] {
    sigset_t waiting;
    sigpending(&waiting);
    return sigismember(&waiting, SIGTERM) == 1 || sigismember(&waiting, SIGINT) == 1;
  };
  const auto on_device_lost = [] {
    exit_status = kDeviceLostStatus;
    kill(getpid(), SIGTERM);
  };
  auto started = daemon::Daemon::start(parsed.config, {manager, stop_asked, on_device_lost});
  if (!started) {
    log::error("cannot start", {{"reason", started.error().message}});
    return EXIT_FAILURE;
  }
  std::optional<daemon::ReadyFile> ready_file;
  if (!parsed.config.ready_file.empty()) {
    auto written = daemon::ReadyFile::write(parsed.config.ready_file, **started);
    if (!written) {
      log::error("cannot start", {{"reason", written.error().message}});
      return EXIT_FAILURE;
    }
    ready_file.emplace(std::move(*written));
  }

  manager.tell("READY=1");

  int signal = 0;
  sigwait(&signals, &signal);
  manager.tell("STOPPING=1");
  log::info("stopping", {{"signal", signal == SIGTERM ? "SIGTERM" : "SIGINT"}});
  ready_file.reset();
  std::thread([] {
    std::this_thread::sleep_for(kShutdownTime);
    log::warn("stopped without waiting for a step, a load or a client that takes longer");
    std::_Exit(exit_status);
  }).detach();
  started->reset();
  log::info("stopped");
  // Skips static destructors, because the thread above may still run.
  std::fflush(nullptr);
  std::_Exit(exit_status);
}
