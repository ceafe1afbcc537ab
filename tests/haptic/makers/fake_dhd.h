#pragma once

// A library that stands for Force Dimension's libdhd.so.3: a device that a test scripts, and a record of the calls.

#include <array>
#include <map>
#include <string>
#include <vector>

namespace tensormass::haptic {

struct FakeDhd {
  // The script.
  std::array<double, 3> position_m{};
  double rotation[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  bool has_gripper = true, has_active_wrist = true, has_active_gripper = true;
  double gripper_angle_rad = 0;
  unsigned int buttons = 0;            // a bit each
  std::map<std::string, int> results;  // by the function's name; absent: success

  // The record.
  std::vector<std::string> calls;  // all but reads, in their order; "force" and "zero" for the two kinds of forces
  std::array<double, 3> force_n{}, torque_n_m{};
  double grip_n = 0;
  int serial = 0;  // given to dhdOpenSerial
  std::vector<std::string> misuse;
};

}  // namespace tensormass::haptic

/// Returns a new device, which replaces the one before.
extern "C" tensormass::haptic::FakeDhd* fake_dhd();
