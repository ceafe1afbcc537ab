// A haptic device of your own on one tool of a running scene, at 1 kHz:
//
//     haptic_client 127.0.0.1:50051 demo probe 5      server, scene, tool, seconds; a file of `tensormass keys add`
//
// MyDevice stands in for a driver: it presses one tool radius into the nearest tissue and lifts, once in two seconds.
// Replace its functions by your driver's. The loop between read() and write_force(): haptic/loop.h.
#include <cmath>
#include <iostream>
#include <numbers>

#include "haptic/client_keys.h"
#include "haptic/discovery.h"
#include "haptic/run_device.h"
#include "haptic/zeromq_link.h"

using namespace tensormass::haptic;
using tensormass::Result;

class MyDevice final : public Device {
 public:
  MyDevice(const Eigen::Vector3d& rest_m, const Eigen::Vector3d& pressed_m)
      : rest_m_(rest_m), travel_m_(pressed_m - rest_m) {}
  Result<void> open() override { return {}; }
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override {  // in the scene's frame [m]
    const double seconds = static_cast<double>(clock_.now_ns() - start_ns_) / kNsPerS;
    return DevicePose{rest_m_ + 0.5 * (1.0 - std::cos(std::numbers::pi * seconds)) * travel_m_};
  }
  // The force on the hand [N], to the motors. A device with a torque overrides write() too.
  Result<void> write_force(const Eigen::Vector3d&) override { return {}; }
  void close() noexcept override {}

 private:
  Eigen::Vector3d rest_m_, travel_m_;
  MonotonicClock clock_;
  std::int64_t start_ns_ = clock_.now_ns();
  // Limits of your device: 3 N, 1000 N/m, 5 N s/m.
  DeviceInfo info_{"mine", 3.0, 1000.0, 5.0};
};

Result<LoopReport> run(const std::string& server, const std::string& scene, const std::string& name, double seconds,
                       const std::string& keys_file) {
  const std::atomic<bool> stop = false;  // a signal handler may set it
  ClientKeys keys;
  if (!keys_file.empty()) {
    TM_ASSIGN_OR_RETURN(read, read_client_keys(keys_file));
    keys = read;
  }
  const Patience patience{10.0, stop, keys};
  TM_ASSIGN_OR_RETURN(tool, discover_tool(server, scene, name, patience));
  TM_ASSIGN_OR_RETURN(surface, fetch_surface(server, scene, patience));
  TM_ASSIGN_OR_RETURN(aim, aim_at_nearest_surface(tool, surface));
  TM_ASSIGN_OR_RETURN(link, connect_zeromq(tool.address));
  MyDevice device(tool.tool_position_m, aim.contact_m + tool.radius_m * aim.direction);
  LoopOptions options;
  options.duration_s = seconds;
  return run_device(device, *link, options, stop);
}

int main(int argc, char** argv) {
  if (argc != 5 && argc != 6) return std::cerr << "usage: haptic_client SERVER SCENE TOOL SECONDS [KEYS]\n", 2;
  const Result<LoopReport> report = run(argv[1], argv[2], argv[3], std::atof(argv[4]), argc == 6 ? argv[5] : "");
  if (!report) return std::cerr << "haptic_client: " << report.error().message << '\n', 1;
  if (report->feedback_received == 0) return std::cerr << "haptic_client: no feedback; is the scene paused?\n", 3;
  std::cout << "largest force: " << report->max_force_n << " N in " << report->ticks << " ticks\n";
}
