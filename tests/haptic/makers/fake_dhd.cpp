#include "fake_dhd.h"

#include <memory>

// The functions of libdhd.so.3 that the client uses, with the types of the maker's reference.

namespace {

using tensormass::haptic::FakeDhd;

constexpr char kId = 3;

std::unique_ptr<FakeDhd> device = std::make_unique<FakeDhd>();

int result_of(const char* function) {
  const auto found = device->results.find(function);
  return found == device->results.end() ? 0 : found->second;
}

int call(const char* function, char id) {
  device->calls.emplace_back(function);
  if (id != kId) device->misuse.push_back(std::string(function) + " of an unknown device");
  return result_of(function);
}

}  // namespace

extern "C" {

FakeDhd* fake_dhd() {
  device = std::make_unique<FakeDhd>();
  return device.get();
}

int dhdOpen() { return call("dhdOpen", kId) < 0 ? -1 : kId; }

int dhdOpenSerial(int serial) {
  device->serial = serial;
  return call("dhdOpenSerial", kId) < 0 ? -1 : kId;
}

int dhdClose(char id) { return call("dhdClose", id); }
const char* dhdGetSystemName(char) { return "omega.7 fake"; }
bool dhdHasGripper(char) { return device->has_gripper; }
#ifndef WITHOUT_ACTIVE
bool dhdHasActiveWrist(char) { return device->has_active_wrist; }
bool dhdHasActiveGripper(char) { return device->has_active_gripper; }
#endif
int dhdEnableForce(unsigned char on, char id) { return call(on == 1 ? "forces on" : "forces off", id); }

int dhdGetPosition(double* x, double* y, double* z, char id) {
  if (id != kId) return -1;
  *x = device->position_m[0];
  *y = device->position_m[1];
  *z = device->position_m[2];
  return result_of("dhdGetPosition");
}

int dhdGetOrientationFrame(double rotation[3][3], char) {
  for (int i = 0; i < 9; ++i) rotation[i / 3][i % 3] = device->rotation[i / 3][i % 3];
  return result_of("dhdGetOrientationFrame");
}

int dhdGetGripperAngleRad(double* angle_rad, char) {
  *angle_rad = device->gripper_angle_rad;
  return result_of("dhdGetGripperAngleRad");
}

#ifndef WITHOUT_BUTTONS
int dhdGetButton(int index, char id) {
  if (index < 0 || index > 7 || id != kId) device->misuse.emplace_back("a button that the device lacks is read");
  const int result = result_of("dhdGetButton");
  return result < 0 ? result : static_cast<int>(device->buttons >> index & 1u);
}
#endif

int dhdSetForceAndTorqueAndGripperForce(double x, double y, double z, double a, double b, double g, double grip,
                                        char id) {
  const bool turns = a != 0 || b != 0 || g != 0;
  if (turns && !device->has_active_wrist) device->misuse.emplace_back("a torque on a wrist without motors");
  if (grip != 0 && !device->has_active_gripper) device->misuse.emplace_back("a force on a gripper without a motor");
  device->force_n = {x, y, z};
  device->torque_n_m = {a, b, g};
  device->grip_n = grip;
  const bool zero = x == 0 && y == 0 && z == 0 && !turns && grip == 0;
  static_cast<void>(call(zero ? "zero" : "force", id));
  return result_of("dhdSetForceAndTorqueAndGripperForce");
}

#ifndef WITHOUT_ERRORS
const char* dhdErrorGetLastStr() { return "words of the maker"; }
#endif

}  // extern "C"
