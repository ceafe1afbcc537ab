#pragma once

// A library that stands for 3D Systems' libHD.so: a device that a test scripts, and a record of what was asked of it.

#include <array>
#include <chrono>
#include <condition_variable>
#include <functional>
#include <mutex>
#include <string>
#include <vector>

namespace tensormass::haptic {

/// One device. The mutex guards all members: the frames come from a thread of the library.
struct FakeHd {
  // The script.
  std::array<double, 3> position_mm{};
  std::array<double, 3> step_mm{};  // moved by this with each frame
  std::array<double, 16> transform{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  int buttons = 0;
  double max_force_n = 3.3, max_stiffness_n_per_mm = 0.5, max_damping_n_s_per_mm = 0.003;
  unsigned int init_error = 0, schedule_error = 0, start_error = 0;
  unsigned int frame_error = 0;       // pushed at the end of each frame
  unsigned int calibration = 0x5000;  // until it is updated
  unsigned int calibration_after_update = 0x5000;
  bool makes_frames = true;

  // The record.
  std::vector<std::string> calls;  // all but those of a frame
  std::vector<std::array<double, 3>> forces_n;
  std::string name;       // given to hdInitDevice; "(default)" for none
  int updated_style = 0;  // given to the last calibration
  std::vector<std::string> misuse;

  std::mutex mutex;
  std::condition_variable changed;  // after each frame

  /// Waits until `done`, which sees a locked record. Returns false after 20 s.
  bool wait_for(const std::function<bool()>& done) {
    std::unique_lock lock(mutex);
    return changed.wait_for(lock, std::chrono::seconds(20), done);
  }
};

}  // namespace tensormass::haptic

/// Returns a new device, which replaces the one before.
extern "C" tensormass::haptic::FakeHd* fake_hd();
