#include "haptic/force_dimension_device.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <utility>

#include <spdlog/fmt/fmt.h>

#include "haptic/power_switch.h"
#include "haptic/vendor_library.h"

namespace tensormass::haptic {
namespace {

constexpr const char* kKit = "Force Dimension";
constexpr const char* kRemedy =
    "install Force Dimension's SDK (forcedimension.com, sdk-3.x-linux-x86_64-gcc) and run ldconfig, or name its "
    "libdhd.so.3 with --device-library";

// Values of the reference. Errors are negative; positive results of a call are remarks, such as a saturated motor.
constexpr unsigned char kOff = 0, kOn = 1;

/// The maker's x axis points to the operator, y to the right and z up.
const DeviceAxes kAxes{(Eigen::Matrix3d() << 0, 1, 0, -1, 0, 0, 0, 0, 1).finished()};

}  // namespace

struct ForceDimensionDevice::Functions {
  int (*open)();
  int (*open_serial)(int serial);
  int (*close)(char id);
  const char* (*system_name)(char id);
  bool (*has_gripper)(char id);
  // Null in a library that lacks them.
  bool (*has_active_wrist)(char id);
  bool (*has_active_gripper)(char id);
  int (*enable_force)(unsigned char on, char id);
  int (*get_position)(double* x_m, double* y_m, double* z_m, char id);
  int (*get_orientation)(double rotation[3][3], char id);
  int (*get_gripper_angle)(double* angle_rad, char id);
  int (*set_force)(double x_n, double y_n, double z_n, double a_n_m, double b_n_m, double g_n_m, double grip_n,
                   char id);
  const char* (*last_error)();
  // Null unless a button works the tool's power.
  int (*get_button)(int index, char id);

  static Result<std::unique_ptr<Functions>> load(const std::string& path, bool reads_button) {
    TM_ASSIGN_OR_RETURN(library, VendorLibrary::open(path, kKit, kRemedy));
    auto f = std::make_unique<Functions>();
    TM_RETURN_IF_ERROR(library.find("dhdOpen", f->open));
    TM_RETURN_IF_ERROR(library.find("dhdOpenSerial", f->open_serial));
    TM_RETURN_IF_ERROR(library.find("dhdClose", f->close));
    TM_RETURN_IF_ERROR(library.find("dhdGetSystemName", f->system_name));
    TM_RETURN_IF_ERROR(library.find("dhdHasGripper", f->has_gripper));
    TM_RETURN_IF_ERROR(library.find("dhdEnableForce", f->enable_force));
    TM_RETURN_IF_ERROR(library.find("dhdGetPosition", f->get_position));
    TM_RETURN_IF_ERROR(library.find("dhdGetOrientationFrame", f->get_orientation));
    TM_RETURN_IF_ERROR(library.find("dhdGetGripperAngleRad", f->get_gripper_angle));
    TM_RETURN_IF_ERROR(library.find("dhdSetForceAndTorqueAndGripperForce", f->set_force));
    TM_RETURN_IF_ERROR(library.find("dhdErrorGetLastStr", f->last_error));
    if (reads_button) TM_RETURN_IF_ERROR(library.find("dhdGetButton", f->get_button));
    library.find_optional("dhdHasActiveWrist", f->has_active_wrist);
    library.find_optional("dhdHasActiveGripper", f->has_active_gripper);
    return f;
  }
};

ForceDimensionDevice::ForceDimensionDevice(ForceDimensionOptions options)
    : options_(std::move(options)), info_(kForceDimensionLimits) {}

ForceDimensionDevice::~ForceDimensionDevice() { close(); }

tl::unexpected<Error> ForceDimensionDevice::failed(const char* what) const {
  const char* words = functions_->last_error();
  return fail(ErrorCode::kUnavailable,
              fmt::format("{}: cannot {} ({}); check its power and its cable, that no other program uses it, and that "
                          "you may write to its USB device",
                          info_.name, what, words == nullptr ? "no reason given" : words));
}

Result<void> ForceDimensionDevice::open() {
  close();
  info_ = kForceDimensionLimits;
  TM_RETURN_IF_ERROR(check(options_.workspace, kKit));
  TM_RETURN_IF_ERROR(check_power_button(options_.power_button, kForceDimensionButtons, kKit));
  int serial = 0;
  const std::string& wanted = options_.serial;
  if (!wanted.empty()) {
    const auto [end, error] = std::from_chars(wanted.data(), wanted.data() + wanted.size(), serial);
    if (error != std::errc{} || end != wanted.data() + wanted.size() || serial < 0) {
      return invalid(fmt::format("{}: the serial number '{}' is not a whole number", kKit, wanted));
    }
  }
  TM_ASSIGN_OR_RETURN(functions, Functions::load(options_.library, options_.power_button > 0));
  functions_ = std::move(functions);
  const int id = wanted.empty() ? functions_->open() : functions_->open_serial(serial);
  if (id < 0) return failed("open a device");
  id_ = static_cast<char>(id);
  open_ = true;
  const char* name = functions_->system_name(id_);
  if (name != nullptr) info_.name += fmt::format(" {}", name);
  has_gripper_ = options_.moves_jaws && functions_->has_gripper(id_);
  const auto says = [this](bool (*question)(char id)) { return question != nullptr && question(id_); };
  if (!says(functions_->has_active_wrist)) info_.max_torque_n_m = 0.0;
  if (!has_gripper_ || !says(functions_->has_active_gripper)) info_.max_jaw_torque_n_m = 0.0;

  // Zero first: the library may hold the last force of another program.
  Result<void> ready;
  if (functions_->set_force(0, 0, 0, 0, 0, 0, 0, id_) < 0 || functions_->enable_force(kOn, id_) < 0) {
    ready = failed("switch its forces on");
  }
  const Result<DevicePose> first = ready ? read_device() : tl::make_unexpected(ready.error());
  if (!first) {
    close();
    return tl::make_unexpected(first.error());
  }
  map_ = map_from(first->position_m, options_.workspace);
  info_ = map_.to_scene(info_);
  return {};
}

Result<DevicePose> ForceDimensionDevice::read_device() const {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  double rows[3][3] = {};
  if (functions_->get_position(&position_m.x(), &position_m.y(), &position_m.z(), id_) < 0) {
    return failed("read its position");
  }
  // A device without a wrist answers with the identity.
  if (functions_->get_orientation(rows, id_) < 0) return failed("read its orientation");
  Eigen::Matrix3d rotation;
  for (int i = 0; i < 9; ++i) rotation(i / 3, i % 3) = rows[i / 3][i % 3];
  DevicePose pose{kAxes.from_maker(position_m), kAxes.from_maker(rotation)};
  if (has_gripper_) {
    double angle_rad = 0;
    if (functions_->get_gripper_angle(&angle_rad, id_) < 0) return failed("read its gripper");
    // The server refuses angles out of its range; an angle that is not a number stays one, and the loop sees it.
    pose.jaw_angle_rad = std::clamp(angle_rad, 0.0, kMaxJawAngleRad);
  }
  if (options_.power_button > 0) {
    const int state = functions_->get_button(options_.power_button - 1, id_);
    if (state < 0) return failed("read its button");
    pose.pressed = state == kOn;
  }
  return pose;
}

Result<DevicePose> ForceDimensionDevice::read() {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "Force Dimension: read before open");
  TM_ASSIGN_OR_RETURN(pose, read_device());
  return map_.to_scene(pose);
}

Result<void> ForceDimensionDevice::write(const Wrench& wrench) {
  if (!open_) return fail(ErrorCode::kFailedPrecondition, "Force Dimension: write before open");
  if (!wrench.is_finite()) return invalid("Force Dimension: the force or a torque is not finite");
  const Wrench device = map_.to_device(wrench);
  const Eigen::Vector3d f = kAxes.to_maker(device.force_n);
  const Eigen::Vector3d t = info_.max_torque_n_m > 0 ? kAxes.to_maker(device.torque_n_m) : Eigen::Vector3d::Zero();
  const double grip_n = info_.max_jaw_torque_n_m > 0 ? device.jaw_torque_n_m / kForceDimensionGripperLeverM : 0.0;
  if (functions_->set_force(f.x(), f.y(), f.z(), t.x(), t.y(), t.z(), grip_n, id_) < 0) return failed("set its force");
  return {};
}

void ForceDimensionDevice::close() noexcept {
  if (!open_) return;
  open_ = false;
  // Each call is tried, whatever the one before has answered.
  static_cast<void>(functions_->set_force(0, 0, 0, 0, 0, 0, 0, id_));
  static_cast<void>(functions_->enable_force(kOff, id_));
  static_cast<void>(functions_->close(id_));
}

}  // namespace tensormass::haptic
