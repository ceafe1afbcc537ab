#pragma once

// Turns the button of a device into the power of a tool with Tool.cautery.
//
//            tool is not ours, no fresh answer, invalid pose
//      +----------------------------------------------------------+
//      v                                                          |
//   locked ---- the button is up while the tool is ours ----> ready: level while the button is down
//
// Reasons:
// 1. Power that nobody asks for burns tissue. A button that is down when the program starts, or when the tool comes
//    back, is a hand that grips, or a pedal that something lies on.
// 2. Another client may hold the tool while this button is down. When that client lets go, this one's poses move the
//    tool again, and must not burn at the place to which it jumps.
// 3. Without a fresh answer of the scene the hand feels nothing, so nobody burns blindly.
//
// Pure; called by the loop's thread.

#include <string>

#include <spdlog/fmt/fmt.h>

#include "core/result.h"

namespace tensormass::haptic {

/// Fails unless a device with `count` buttons has button `number`, or `number` is 0: none. device: for the message.
inline Result<void> check_power_button(int number, int count, const std::string& device) {
  if (number >= 0 && number <= count) return {};
  return invalid(
      fmt::format("{}: --cautery-button {}: choose a button from 1 to {}, or 0 for none", device, number, count));
}

class PowerSwitch {
 public:
  /// level: share of the tool's power while the button is down, 0 to 1.
  explicit PowerSwitch(double level) : level_(level) {}

  /// Returns ToolPose.level of this tick's pose. ours: the newest answer is fresh and is one to this client's pose.
  double level(bool pressed, bool ours) {
    if (!ours) lock();
    if (ours && !pressed) ready_ = true;
    return ready_ && pressed ? level_ : 0.0;
  }
  /// No power until the button was up.
  void lock() { ready_ = false; }

 private:
  double level_;
  bool ready_ = false;
};

}  // namespace tensormass::haptic
