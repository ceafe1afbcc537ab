#include "daemon/config.h"

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cstdlib>
#include <map>
#include <thread>
#include <utility>
#include <vector>

#include <arpa/inet.h>
#include <fmt/format.h>
#include <CLI/CLI.hpp>

#include "core/limits.h"
#include "core/names.h"

namespace tensormass::daemon {
namespace {

constexpr const char* kOff = "off";
/// Bounds of settings that are beyond every machine: 2^60 bytes, and 30 years.
constexpr std::uint64_t kMaxMib = std::uint64_t{1} << 40;
constexpr double kMaxSeconds = 1e9;

std::string host_of(std::string_view endpoint) {
  for (const std::string_view scheme : {"tcp://", "tcp/"}) {
    if (endpoint.starts_with(scheme)) endpoint.remove_prefix(scheme.size());
  }
  return std::string(endpoint.substr(0, endpoint.rfind(':')));
}

/// Returns "" if `text` is `scheme`, a host, a colon and a port; otherwise the error. The port is a number up to 65535
/// (0: a free one), or * if `star` is true.
std::string check_host_and_port(const std::string& text, std::string_view scheme, bool star) {
  std::string_view rest = text;
  const auto wrong = [&] {
    return fmt::format("'{0}' is not {1}HOST:PORT, as {1}127.0.0.1:{2} for a free port", text, scheme,
                       star ? '*' : '0');
  };
  if (!rest.starts_with(scheme)) return wrong();
  rest.remove_prefix(scheme.size());
  const std::size_t colon = rest.rfind(':');
  if (colon == 0 || colon == std::string_view::npos) return wrong();
  const std::string_view port_text = rest.substr(colon + 1);
  if (star && port_text == "*") return {};
  std::uint32_t port = 0;
  const auto [end, failure] = std::from_chars(port_text.data(), port_text.data() + port_text.size(), port);
  const bool number = failure == std::errc{} && end == port_text.data() + port_text.size();
  return number && port <= 65535 ? std::string() : wrong();
}

std::string check_control(const std::string& text) { return check_host_and_port(text, "", false); }

std::string check_zeromq(const std::string& text) {
  constexpr std::string_view kIpc = "ipc://";
  if (text == kOff || (text.starts_with(kIpc) && text.size() > kIpc.size())) return {};
  return check_host_and_port(text, "tcp://", true);
}

std::string check_zenoh(const std::string& text) {
  return text == kOff ? std::string() : check_host_and_port(text, "tcp/", false);
}

/// Nobody is asked for a key there, so other machines must not reach it.
std::string check_metrics(const std::string& text) {
  if (text == kOff) return {};
  if (std::string wrong = check_host_and_port(text, "", false); !wrong.empty()) return wrong;
  if (is_local_endpoint(text)) return {};
  return fmt::format(
      "other machines can reach '{}', and nobody is asked for a key there; give an address of this machine alone, as "
      "127.0.0.1:9464, and let other machines scrape the gateway (docs/metrics.md)",
      text);
}

/// CLI::Range takes NaN.
std::string check_seconds(const std::string& text) {
  double seconds = 0;
  if (CLI::detail::lexical_cast(text, seconds) && seconds > 0 && seconds <= kMaxSeconds) return {};
  return fmt::format("'{}' is not a number of seconds above 0, at most {:g}", text, kMaxSeconds);
}

std::string check_server_name(const std::string& name) {
  if (is_valid_name(name)) return {};
  return fmt::format("'{}' is not 1 to {} characters out of [A-Za-z0-9_-]", name, limits::kMaxNameLength);
}

/// Returns the environment variable of an option: zenoh-listen is TENSORMASS_ZENOH_LISTEN.
std::string environment_name(const std::string& option) {
  std::string name = "TENSORMASS_" + option;
  for (char& c : name) c = c == '-' ? '_' : static_cast<char>(std::toupper(static_cast<unsigned char>(c)));
  return name;
}

/// Returns the command line with the environment's settings in front of it, as flags. CLI11 by itself lets a config
/// file override the environment; as a flag the environment overrides the file. Of equal flags the last counts, so the
/// user's flags override the environment.
std::vector<std::string> with_environment(const CLI::App& app, int argc, const char* const* argv) {
  std::vector<std::string> arguments;
  for (const CLI::Option* option : app.get_options()) {
    const char* value = option->get_envname().empty() ? nullptr : std::getenv(option->get_envname().c_str());
    if (value != nullptr && *value != '\0') arguments.push_back("--" + option->get_lnames().front() + "=" + value);
  }
  arguments.insert(arguments.end(), argv + 1, argv + argc);
  std::reverse(arguments.begin(), arguments.end());  // CLI11 expects the last argument first
  return arguments;
}

}  // namespace

bool is_local_endpoint(std::string_view endpoint) {
  if (endpoint.empty() || endpoint.starts_with("ipc://")) return true;
  const std::string host = host_of(endpoint);
  if (host == "localhost" || host == "[::1]") return true;
  // A literal address only: DNS decides where 127.0.0.1.example leads.
  in_addr address{};
  return inet_pton(AF_INET, host.c_str(), &address) == 1 && ntohl(address.s_addr) >> 24 == 127;
}

std::string check_keys(const Config& config) {
  if (!config.keys.empty()) return {};
  for (const auto& [option, endpoint] :
       {std::pair{"--control", &config.control}, std::pair{"--zeromq-publish", &config.zeromq_publish},
        std::pair{"--zeromq-pose", &config.zeromq_pose}, std::pair{"--zenoh-listen", &config.zenoh_listen}}) {
    if (*endpoint == kOff || is_local_endpoint(*endpoint)) continue;
    return fmt::format(
        "{} {}: other machines can reach this address, so clients need keys. Make keys, and start again with them:\n"
        "  tensormass keys init keys\n"
        "  tensormass keys add NAME --role operator --keys keys\n"
        "  tensormassd --keys keys ...",
        option, *endpoint);
  }
  return {};
}

ParsedCommandLine parse_command_line(int argc, const char* const* argv) {
  ParsedCommandLine parsed;
  Config& config = parsed.config;
  // Leaves the other half of the cores to the transports, the clients and the gateway.
  config.cpu_threads = std::max(1u, std::thread::hardware_concurrency() / 2);

  CLI::App app("Steps scenes of deformable tissue and exchanges tool poses, forces and surfaces with clients.",
               "tensormassd");
  app.option_defaults()->multi_option_policy(CLI::MultiOptionPolicy::TakeLast)->always_capture_default();
  app.set_version_flag("--version", "tensormassd " TENSORMASS_VERSION);
  app.set_config("--config", "", "A TOML file of these settings, by their long names");
  app.allow_config_extras(CLI::config_extras_mode::error);

  const std::map<std::string, world::BackendChoice> backends{{"auto", world::BackendChoice::kAuto},
                                                             {"cpu", world::BackendChoice::kCpu},
                                                             {"cuda", world::BackendChoice::kCuda}};
  std::string backend = "auto";
  std::string log_level = "info";
  std::string log_format = "text";
  app.add_option("--backend", backend, "auto takes a GPU if one answers, else the CPU")->check(CLI::IsMember(backends));
  app.add_option("--cpu-threads", config.cpu_threads, "Threads of each CPU scene that does not set its own")
      ->check(CLI::Range(1u, limits::kMaxCpuThreads));
  app.add_option(
         "--gpu-scenes", config.gpu_scenes,
         "Concurrent scenes that must keep their rates on one GPU. Each gets its share of the GPU and waits without "
         "occupying a CPU core. 1: a scene runs as fast as it can alone")
      ->check(CLI::Range(1u, limits::kMaxGpuScenes));
  app.add_option("--max-scene-mib", config.max_scene_mib,
                 "Memory that one load may need, estimated from its counts; 0: as --max-memory-mib")
      ->check(CLI::Range(std::uint64_t{0}, kMaxMib));
  app.add_option("--max-memory-mib", config.max_memory_mib,
                 "Memory of the daemon above which loads are refused; 0: 80 % of what the container or machine has")
      ->check(CLI::Range(std::uint64_t{0}, kMaxMib));
  app.add_option("--max-message-mib", config.max_message_mib,
                 "Memory of messages that have not arrived as a whole, and so of the largest one, as a scene with its "
                 "mesh")
      ->check(CLI::Range(std::uint64_t{1}, std::uint64_t{limits::kMaxControlMessageBytes >> 20}));
  app.add_option("--max-load-s", config.max_load_s, "Time that one load may take, estimated from its counts")
      ->check(check_seconds);
  app.add_option("--server-name", config.server_name, "<server> in the keys of the data plane")
      ->check(check_server_name);
  app.add_option("--control", config.control, "gRPC: HOST:PORT; port 0 for a free one")->check(check_control);
  app.add_option("--zeromq-publish", config.zeromq_publish,
                 "Streams to clients: tcp://HOST:PORT (* for a free port), ipc://PATH, or off")
      ->check(check_zeromq);
  app.add_option("--zeromq-pose", config.zeromq_pose, "Tool poses from clients: as --zeromq-publish")
      ->check(check_zeromq);
  app.add_option("--zenoh-listen", config.zenoh_listen,
                 "Streams and poses over zenoh: tcp/HOST:PORT (0 for a free port), or off")
      ->check(check_zenoh);
  app.add_option("--zenoh-sessions", config.zenoh_sessions,
                 "Clients connected over zenoh at once; a further one is refused")
      ->check(CLI::Range(1u, limits::kMaxZenohSessions));
  config.metrics = kOff;
  app.add_option("--metrics", config.metrics,
                 "/metrics for Prometheus, on this machine alone: HOST:PORT (0 for a free port), or off")
      ->check(check_metrics);
  app.add_option(
      "--keys", config.keys,
      "Folder of `tensormass keys init`: who may connect, and do what. Needed where other machines can connect");
  config.health = kOff;
  app.add_option("--health", config.health,
                 "gRPC's health service alone, without keys, for who starts and stops the daemon: HOST:PORT, or off")
      ->check([](const std::string& text) { return text == kOff ? std::string() : check_control(text); });
  app.add_option("--state", config.state,
                 "Folder in which scenes and their newest snapshots are kept. A daemon that starts with it brings them "
                 "back");
  app.add_option("--max-state-mib", config.max_state_mib, "Disk that --state may take; more is not written")
      ->check(CLI::Range(std::uint64_t{1}, kMaxMib));
  app.add_option("--log-level", log_level, "Lowest level that is logged")
      ->check(CLI::IsMember({"debug", "info", "warning", "error"}));
  app.add_option("--log-format", log_format, "json: one object a line")->check(CLI::IsMember({"text", "json"}));
  app.add_option("--ready-file", config.ready_file, "Write all endpoints to this file as JSON, once the daemon serves");
  for (CLI::Option* option : app.get_options()) {
    const auto& names = option->get_lnames();
    if (!names.empty() && names.front() != "help" && names.front() != "version") {
      option->envname(environment_name(names.front()));
    }
  }
  app.add_flag("--check-config", config.check_only,
               "Print the effective settings and exit: status 0 if they are valid, 2 if not")
      ->configurable(false);

  const auto finish = [&parsed](int status, std::string output) {
    parsed.exits = true;
    parsed.exit_status = status;
    parsed.output = std::move(output);
    return parsed;
  };
  try {
    app.parse(with_environment(app, argc, argv));
    if ((config.zeromq_publish == kOff) != (config.zeromq_pose == kOff)) {
      throw CLI::ValidationError("--zeromq-publish and --zeromq-pose", "turn both off, or neither");
    }
    if (const std::string refusal = check_keys(config); !refusal.empty())
      return finish(2, "tensormassd: " + refusal + "\n");
  } catch (const CLI::Success& success) {
    std::ostringstream text;
    app.exit(success, text, text);
    return finish(0, text.str());
  } catch (const CLI::Error& error) {
    return finish(2, "tensormassd: " + std::string(error.what()) + "\nRun tensormassd --help for what there is.\n");
  }
  if (config.check_only) return finish(0, app.config_to_str(true, false));

  for (std::string* endpoint :
       {&config.zeromq_publish, &config.zeromq_pose, &config.zenoh_listen, &config.health, &config.metrics}) {
    if (*endpoint == kOff) endpoint->clear();
  }
  config.backend = backends.at(backend);
  config.log_level = spdlog::level::from_str(log_level);
  config.log_format = log_format == "json" ? log::Format::kJson : log::Format::kText;
  return parsed;
}

}  // namespace tensormass::daemon
