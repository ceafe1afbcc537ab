// tensormass-haptic: one haptic device on one tool of a running scene.
//
// SIGINT and SIGTERM take the force off the hand within one period. The program then waits for the echo of the last
// pose and prints the report. Before the loop runs, they end the program. Exit codes: 0 done; 1 no server, scene, tool,
// device or report; 2 wrong options; 3 no feedback answered a pose (the report is still written).

#include <pthread.h>
#include <signal.h>

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdio>
#include <iostream>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <spdlog/fmt/fmt.h>
#include <CLI/CLI.hpp>

#include "core/limits.h"
#include "haptic/checks.h"
#include "haptic/discovery.h"
#include "haptic/force_dimension_device.h"
#include "haptic/haply_device.h"
#include "haptic/openhaptics_device.h"
#include "haptic/realtime.h"
#include "haptic/report.h"
#include "haptic/report_file.h"
#include "haptic/run_device.h"
#include "haptic/simulated_device.h"
#include "haptic/zenoh_link.h"
#include "haptic/zeromq_link.h"

namespace tensormass::haptic {
namespace {

constexpr int kExitFailed = 1;
constexpr int kExitOptions = 2;
constexpr int kExitNoFeedback = 3;

/// Default depth of the press and radius of the circles, as fractions of the surface's extent.
constexpr double kDefaultDepth = 0.05;
constexpr double kDefaultCircleRadius = 0.04;
/// Time to ask the server why no feedback came [s].
constexpr double kStatusTimeoutS = 2.0;
/// Highest --cautery-button of any device.
constexpr int kMaxPowerButton = kForceDimensionButtons;

struct Options {
  std::string server = "127.0.0.1:50051";
  std::string keys_path;
  std::string scene = "demo";
  std::string tool = "probe";
  std::string transport = "zeromq";
  std::string device = "simulated";
  double connect_timeout_s = 10.0;
  std::string json_path;
  double watchdog_s = 0.05;
  HaplyOptions haply;
  /// Path of the maker's library; empty: the one that the system's loader finds.
  std::string library;
  std::string device_id;
  double workspace_scale = 1.0;
  // Empty or negative: taken from the scene.
  std::vector<double> workspace_center_m;
  std::vector<double> workspace_rotation_deg = {0.0, 0.0, 0.0};
  std::vector<double> press_at_m;
  std::vector<double> direction;
  double depth_m = -1.0;
  std::optional<double> jaw_angle_rad;
  /// Absent: the first button that has nothing else to do.
  std::optional<int> power_button;
  HandScriptOptions hand;
  SimulatedDeviceOptions simulated;
  LoopOptions loop;
};

/// Receives SIGINT and SIGTERM on its own thread and sets a flag. No other thread is interrupted, so no call in this
/// program has to handle EINTR. Must be created before any other thread: threads inherit the signal mask.
class SignalFlag {
 public:
  SignalFlag() {
    sigemptyset(&signals_);
    sigaddset(&signals_, SIGINT);
    sigaddset(&signals_, SIGTERM);
    pthread_sigmask(SIG_BLOCK, &signals_, nullptr);
    thread_ = std::jthread([this](const std::stop_token& stop) {
      const timespec interval{0, 100'000'000};
      while (!stop.stop_requested()) {
        if (sigtimedwait(&signals_, nullptr, &interval) > 0) raised_ = true;
      }
    });
  }
  const std::atomic<bool>& raised() const { return raised_; }

 private:
  sigset_t signals_;
  std::atomic<bool> raised_ = false;
  std::jthread thread_;
};

/// Prints a line after a recovery began, at most one a second, and one for each client that claims the tool before this
/// one, on its own thread. The loop must not wait for a terminal.
class Notices {
 public:
  Notices()
      : thread_([this](const std::stop_token& stop) {
          std::mutex mutex;
          std::condition_variable_any wake;
          std::unique_lock lock(mutex);
          while (!stop.stop_requested()) {
            // A line follows the first recovery at once, and a later one at the end of its second.
            wake.wait_for(lock, stop, kPoll, [] { return false; });
            const std::uint64_t client = claimed_by_.load(std::memory_order_relaxed);
            if (std::exchange(told_, client) != client) {
              std::cerr << "tensormass-haptic: " << claimed_line(client) << std::endl;
            }
            const bool removed = removed_.load(std::memory_order_relaxed);
            if (std::exchange(told_removed_, removed) != removed) {
              std::cerr << "tensormass-haptic: " << removed_line(removed) << std::endl;
            }
            const std::uint64_t count = count_.exchange(0);
            if (count == 0) continue;
            std::cerr << "tensormass-haptic: " << recovery_line(count) << std::endl;
            wake.wait_for(lock, stop, std::chrono::seconds(1), [] { return false; });
          }
        }) {}
  /// For LoopOptions::recoveries.
  std::atomic<std::uint64_t>& count() { return count_; }
  /// For LoopOptions::claimed_by.
  std::atomic<std::uint64_t>& claimed_by() { return claimed_by_; }
  /// For LoopOptions::removed.
  std::atomic<bool>& removed() { return removed_; }

 private:
  static constexpr std::chrono::milliseconds kPoll{50};

  std::atomic<std::uint64_t> count_ = 0;
  std::atomic<std::uint64_t> claimed_by_ = 0;
  std::atomic<bool> removed_ = false;
  std::uint64_t told_ = 0;  // its thread's own, and so is the next
  bool told_removed_ = false;
  std::jthread thread_;
};

/// Accepts a number from `least` to `most`. CLI::Range accepts NaN.
struct Within : CLI::Validator {
  Within(double least, double most) {
    name_ = "WITHIN";
    desc_function_ = [=] { return fmt::format("FLOAT in [{:g} - {:g}]", least, most); };
    func_ = [=](const std::string& text) {
      double value = 0;
      const bool good = CLI::detail::lexical_cast(text, value) && value >= least && value <= most;
      return good ? std::string() : fmt::format("{} is not in [{:g} - {:g}]", text, least, most);
    };
  }
};

constexpr const char* kHandGroup = "Scripted hand (--device simulated)";
constexpr const char* kHaplyGroup = "Haply Inverse (--device haply)";
constexpr const char* kLibraryGroup = "OpenHaptics and Force Dimension (--device openhaptics, force-dimension)";
constexpr const char* kHardwareGroup = "Devices other than the simulated one";
constexpr const char* kPowerGroup = "Power (tools with cautery)";
constexpr const char* kTorqueGroup = "Torque (--device simulated, force-dimension)";

void add_hardware_options(CLI::App& app, Options& o) {
  const auto url_problem = [](const std::string& url) {
    const Result<HaplyAddress> address = parse_haply_url(url);
    return address ? std::string() : address.error().message;
  };
  app.add_option(
         "--device-id", o.device_id,
         "Which device, if several are connected: id of the Inverse3, name in OpenHaptics' setup, serial number "
         "at Force Dimension")
      ->group(kHardwareGroup);
  app.add_option("--device-url", o.haply.url, "Where Haply's Inverse service listens")
      ->check(url_problem, "ws://HOST:PORT")
      ->capture_default_str()
      ->group(kHaplyGroup);
  app.add_option("--grip-id", o.haply.choice.grip_id,
                 "Id of the VerseGrip that gives the orientation; default: the only one, or none")
      ->group(kHaplyGroup);
  app.add_option("--device-library", o.library,
                 "The maker's library; default: libHD.so or libdhd.so.3 where the system finds it")
      ->group(kLibraryGroup);
  app.add_option("--workspace-center", o.workspace_center_m,
                 "Where in the scene the grip is at the start, x,y,z [m]; default: where the tool is")
      ->delimiter(',')
      ->expected(3)
      ->check(Within(-limits::kMaxLength, limits::kMaxLength))
      ->group(kHardwareGroup);
  app.add_option("--workspace-scale", o.workspace_scale,
                 "Metres in the scene for a metre of the hand. Forces are not scaled, so the hand feels the scene's "
                 "stiffness times this")
      ->check(Within(0.01, 100.0))
      ->capture_default_str()
      ->group(kHardwareGroup);
  app.add_option("--workspace-rotation", o.workspace_rotation_deg,
                 "Rotation from the device (x to the right, y forward, z up) to the scene about the scene's axes x, "
                 "then y, then z [degrees]; -90,0,0 for a scene with y up; default: none")
      ->delimiter(',')
      ->expected(3)
      ->check(Within(-360.0, 360.0))
      ->group(kHardwareGroup);
}

void add_options(CLI::App& app, Options& o) {
  const Within anywhere(-limits::kMaxLength, limits::kMaxLength), positive(1e-6, 1e6);
  app.add_option("--server", o.server, "The server's control endpoint, host:port")->capture_default_str();
  app.add_option("--keys", o.keys_path, "This client's keys (`tensormass keys add`), if the server has keys");
  app.add_option("--scene", o.scene, "Name of the loaded scene")->capture_default_str();
  app.add_option("--tool", o.tool, "Name of the tool in it")->capture_default_str();
  app.add_option("--transport", o.transport, "Transport of poses and feedback")
      ->check(CLI::IsMember({"zeromq", "zenoh"}))
      ->capture_default_str();
  app.add_option("--device", o.device,
                 "The device: a simulated one, a Haply Inverse through its service, or one of 3D Systems or Force "
                 "Dimension through its maker's library")
      ->check(CLI::IsMember({"simulated", "haply", "openhaptics", "force-dimension"}))
      ->capture_default_str();
  app.add_option("--connect-timeout", o.connect_timeout_s, "How long to wait for the server [s]")
      ->check(Within(0.1, 600.0))
      ->capture_default_str();
  app.add_option("--seconds", o.loop.duration_s, "How long to run [s]; default: until SIGINT or SIGTERM")
      ->check(Within(0.001, 1e9));
  app.add_option("--rate", o.loop.rate_hz, "Rate of the loop [Hz]")
      ->check(Within(10.0, 10'000.0))
      ->capture_default_str();
  app.add_option("--json", o.json_path, "Write the report to this file as JSON; - for standard output");

  add_hardware_options(app, o);
  const std::string hand = kHandGroup;
  app.add_option("--press-at", o.press_at_m,
                 "Where the tool's origin first touches, x,y,z [m]; default: at the surface nearest to the tool")
      ->delimiter(',')
      ->expected(3)
      ->check(anywhere)
      ->group(hand);
  app.add_option("--direction", o.direction, "Into the tissue, x,y,z; default: from the tool to the nearest surface")
      ->delimiter(',')
      ->expected(3)
      ->check(anywhere)
      ->group(hand);
  app.add_option("--depth", o.depth_m, "Depth of the press [m]; default: 5 % of the surface's extent")
      ->check(Within(0.0, 1e3))
      ->group(hand);
  app.add_option("--circle-radius", o.hand.circle_radius_m,
                 "Radius of the circles [m]; default: 4 % of the surface's extent")
      ->check(Within(0.0, 1e3))
      ->group(hand);
  app.add_option("--circles", o.hand.circle_count, "Number of circles in a cycle")
      ->check(Within(0.0, 1e3))
      ->capture_default_str()
      ->group(hand);
  app.add_option("--period", o.hand.period_s, "Duration of a cycle of approach, press, circles, lift and rest [s]")
      ->check(Within(0.1, 3600.0))
      ->capture_default_str()
      ->group(hand);
  app.add_option("--hand-stiffness", o.simulated.hand_stiffness_n_per_m, "Stiffness of the hand's grip [N/m]")
      ->check(positive)
      ->capture_default_str()
      ->group(hand);
  app.add_option("--hand-damping", o.simulated.hand_damping_n_s_per_m, "Damping of the hand's grip [N s/m]")
      ->check(Within(0.0, 1e6))
      ->capture_default_str()
      ->group(hand);
  app.add_option("--mass", o.simulated.mass_kg, "Mass of device and hand together [kg]")
      ->check(positive)
      ->capture_default_str()
      ->group(hand);

  app.add_option(
         "--jaw-angle", o.jaw_angle_rad,
         "Angle at which the fingers hold the jaws of a tool that has them [rad]; default: the jaws stay as they "
         "are")
      ->check(Within(0.0, kMaxJawAngleRad))
      ->group(hand);

  const std::string force = "Force";
  app.add_option("--max-force", o.loop.limits.max_force_n, "Largest force on the hand [N]")
      ->check(Within(0.001, 1e3))
      ->capture_default_str()
      ->group(force);
  app.add_option("--max-slew", o.loop.limits.max_slew_n_per_s, "Largest rate of change of the force [N/s]")
      ->check(Within(0.1, 1e6))
      ->capture_default_str()
      ->group(force);
  app.add_option("--fade", o.loop.renderer.fade_s, "Time in which a stale force falls to zero [s]")
      ->check(Within(0.001, 1.0))
      ->capture_default_str()
      ->group(force);
  app.add_option("--watchdog", o.watchdog_s, "Set the force to zero if the loop stalls for longer than this [s]")
      ->check(Within(0.002, 1.0))
      ->capture_default_str()
      ->group(force);
  app.add_option("--cautery-button", o.power_button,
                 "Button of the device that works the tool's power, from 1; 0: none; default: 1, or 2 if the first one "
                 "closes jaws. The simulated hand holds it down while it circles, if this option asks for it")
      ->check(CLI::Range(0, kMaxPowerButton))
      ->group(kPowerGroup);
  app.add_option("--cautery-level", o.loop.power_level, "Share of the tool's power while the button is down")
      ->check(Within(0.0, 1.0))
      ->default_val(1.0)
      ->group(kPowerGroup);
  app.add_option("--max-torque", o.loop.torque.max_torque_n_m, "Largest torque on the hand [N m]; 0: none")
      ->check(Within(0.0, 10.0))
      ->capture_default_str()
      ->group(kTorqueGroup);
  app.add_option("--max-jaw-torque", o.loop.jaws.max_torque_n_m,
                 "Largest torque on the gripper, about the hinge of the jaws [N m]; 0: none")
      ->check(Within(0.0, 10.0))
      ->capture_default_str()
      ->group(kTorqueGroup);
}

/// Returns the name of an option that was given and that the chosen device does not use, or nothing.
std::string option_of_another_device(const CLI::App& app, const Options& options) {
  const std::string& device = options.device;
  const auto is_unused = [&](const std::string& group) {
    return (group == kHandGroup && device != "simulated") || (group == kHardwareGroup && device == "simulated") ||
           (group == kHaplyGroup && device != "haply") ||
           (group == kLibraryGroup && device != "openhaptics" && device != "force-dimension") ||
           (group == kTorqueGroup && device != "simulated" && device != "force-dimension");
  };
  for (const CLI::Option* option : app.get_options()) {
    if (is_unused(option->get_group()) && option->count() > 0) return option->get_name();
  }
  return {};
}

Eigen::Vector3d to_eigen(const std::vector<double>& v) { return {v[0], v[1], v[2]}; }

/// Completes the hand's script from the scene. Fetches the surface, which may be large or absent, only if needed.
Result<HandScript> plan_hand(const Options& options, const DiscoveredTool& tool, Patience patience) {
  HandScriptOptions hand = options.hand;
  hand.home_m = tool.tool_position_m;
  const bool aim_given = !options.press_at_m.empty() && !options.direction.empty();
  const bool size_given = options.depth_m >= 0.0 && options.hand.circle_radius_m >= 0.0;
  Result<Surface> surface;
  if (!aim_given || !size_given) surface = fetch_surface(options.server, options.scene, patience);
  if (!surface) return tl::make_unexpected(surface.error());
  Result<Aim> aim;
  if (!aim_given) aim = aim_at_nearest_surface(tool, *surface);
  if (!aim) return tl::make_unexpected(aim.error());
  const Result<double> extent_m = extent_of(*surface, tool);
  if (!extent_m) return tl::make_unexpected(extent_m.error());
  hand.contact_m = options.press_at_m.empty() ? aim->contact_m : to_eigen(options.press_at_m);
  hand.direction = options.direction.empty() ? aim->direction : to_eigen(options.direction);
  hand.depth_m = options.depth_m >= 0.0 ? options.depth_m : kDefaultDepth * *extent_m;
  if (hand.circle_radius_m < 0.0) hand.circle_radius_m = kDefaultCircleRadius * *extent_m;
  return HandScript::create(hand);
}

/// Returns the button that works the tool's power, or 0 for none.
Result<int> power_button_of(const Options& options, const DiscoveredTool& tool) {
  if (!tool.has_power) {
    if (options.power_button.value_or(0) == 0) return 0;
    return invalid(
        fmt::format("--cautery-button: tool {} has no power; give it Tool.cautery, or leave this out", options.tool));
  }
  if (options.power_button) return *options.power_button;
  if (options.device == "simulated") return 0;
  return options.device == "openhaptics" && tool.has_jaws ? 2 : 1;
}

Result<std::unique_ptr<Device>> make_device(const Options& options, const DiscoveredTool& tool, Patience patience,
                                            Clock& clock) {
  const Workspace workspace{
      options.workspace_center_m.empty() ? tool.tool_position_m : to_eigen(options.workspace_center_m),
      rotation_about_axes(to_eigen(options.workspace_rotation_deg)), options.workspace_scale};
  TM_ASSIGN_OR_RETURN(power_button, power_button_of(options, tool));
  if (options.device == "haply") {
    HaplyOptions haply = options.haply;
    haply.choice.device_id = options.device_id;
    haply.choice.power_button = power_button;
    haply.workspace = workspace;
    return std::make_unique<HaplyDevice>(haply);
  }
  if (options.device == "openhaptics") {
    OpenHapticsOptions openhaptics;
    if (!options.library.empty()) openhaptics.library = options.library;
    openhaptics.name = options.device_id;
    openhaptics.workspace = workspace;
    openhaptics.moves_jaws = tool.has_jaws;
    openhaptics.power_button = power_button;
    return std::make_unique<OpenHapticsDevice>(openhaptics);
  }
  if (options.device == "force-dimension") {
    ForceDimensionOptions force_dimension;
    if (!options.library.empty()) force_dimension.library = options.library;
    force_dimension.serial = options.device_id;
    force_dimension.workspace = workspace;
    force_dimension.moves_jaws = tool.has_jaws;
    force_dimension.power_button = power_button;
    return std::make_unique<ForceDimensionDevice>(force_dimension);
  }
  if (options.jaw_angle_rad && !tool.has_jaws) return invalid("--jaw-angle: the tool has no jaws");
  SimulatedDeviceOptions simulated = options.simulated;
  simulated.jaw_angle_rad = options.jaw_angle_rad;
  simulated.presses_button = power_button > 0;
  TM_ASSIGN_OR_RETURN(script, plan_hand(options, tool, patience));
  return std::make_unique<SimulatedDevice>(simulated, script, clock);
}

std::string ask_why_unanswered(const Options& options, const DiscoveredTool& tool) {
  // Not the run's own flag: the question must be asked after a signal too.
  const std::atomic<bool> never = false;
  const Result<v1::SceneStatus> status =
      fetch_status(options.server, options.scene, {kStatusTimeoutS, never, tool.address.keys});
  return status ? why_unanswered(*status, tool.poses_rejected) : status.error().message;
}

Result<int> run(Options options, const std::atomic<bool>& stop) {
  ReportFile report_file;
  if (const auto opened = report_file.open(options.json_path); !opened) {
    return invalid("--json: " + opened.error().message);
  }
  ClientKeys keys;
  if (!options.keys_path.empty()) {
    TM_ASSIGN_OR_RETURN(read, read_client_keys(options.keys_path));
    keys = std::move(read);
  }
  const Patience patience{options.connect_timeout_s, stop, keys};
  const Result<DiscoveredTool> tool = discover_tool(options.server, options.scene, options.tool, patience);
  if (!tool) return tl::make_unexpected(tool.error());
  MonotonicClock clock;
  const Result<std::unique_ptr<Device>> device = make_device(options, *tool, patience, clock);
  if (!device) return tl::make_unexpected(device.error());
  // Before the priority rises, which its thread would inherit.
  Notices notices;
  options.loop.recoveries = &notices.count();
  options.loop.claimed_by = &notices.claimed_by();
  options.loop.removed = &notices.removed();
  // Before the link starts its threads, which inherit the priority. Feedback that waits for a core is as good as lost.
  if (const auto realtime = request_realtime(kLinkPriority); !realtime) {
    std::cerr << "tensormass-haptic: " << realtime.error().message << '\n';
  }
  const Result<std::unique_ptr<Link>> link =
      options.transport == "zenoh" ? connect_zenoh(tool->address) : connect_zeromq(tool->address);
  if (!link) return tl::make_unexpected(link.error());
  if (stop) return fail(ErrorCode::kCancelled, "ended before the loop ran");

  const Result<LoopReport> report = run_device(**device, **link, options.loop, stop, options.watchdog_s);
  if (!report) return tl::make_unexpected(report.error());

  const RunLabel label{options.server, options.scene, options.tool, options.transport, (*device)->info().name};
  std::cerr << to_text(*report, label);
  if (const auto written = report_file.write(to_json(*report, label)); !written) {
    return tl::make_unexpected(written.error());
  }
  if (report->feedback_received > 0) return 0;
  std::cerr << "tensormass-haptic: no feedback answered any pose: " << ask_why_unanswered(options, *tool) << '\n';
  return kExitNoFeedback;
}

}  // namespace
}  // namespace tensormass::haptic

int main(int argc, char** argv) {
  using namespace tensormass::haptic;
  CLI::App app{"A haptic device on one tool of a running scene: pose in, force and torque out, at 1 kHz.",
               "tensormass-haptic"};
  Options options;
  options.hand.circle_radius_m = -1.0;
  add_options(app, options);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : kExitOptions;
  }
  if (options.watchdog_s * options.loop.rate_hz < 2) {
    std::cerr << fmt::format("tensormass-haptic: --watchdog: {:g} s are less than two periods of --rate {:g}\n",
                             options.watchdog_s, options.loop.rate_hz);
    return kExitOptions;
  }
  if (const std::string wrong = option_of_another_device(app, options); !wrong.empty()) {
    std::cerr << fmt::format("tensormass-haptic: {} has no effect with --device {}; leave it out\n", wrong,
                             options.device);
    return kExitOptions;
  }
  const SignalFlag signals;
  const auto result = run(std::move(options), signals.raised());
  if (result) return *result;
  std::cerr << "tensormass-haptic: " << result.error().message << '\n';
  return result.error().code == tensormass::ErrorCode::kInvalidArgument ? kExitOptions : kExitFailed;
}
