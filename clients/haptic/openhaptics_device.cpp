#include "haptic/openhaptics_device.h"

#include <array>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <mutex>
#include <optional>
#include <utility>

#include <spdlog/fmt/fmt.h>

#include "haptic/power_switch.h"
#include "haptic/vendor_library.h"

namespace tensormass::haptic {
namespace {

using std::chrono::steady_clock;

constexpr const char* kKit = "OpenHaptics";
constexpr const char* kRemedy =
    "install 3D Systems' OpenHaptics for Linux, 3.4 or later, and the Touch device driver, or name its libHD.so with "
    "--device-library";

// Types of the reference.
using HdDevice = unsigned int;
using HdEnum = unsigned int;
using HdSchedule = unsigned long;
struct HdError {
  unsigned int code;
  int internal_code;
  HdDevice device;
};

// Values of the reference.
constexpr unsigned int kSuccess = 0;
constexpr HdDevice kInvalidDevice = 0xFFFFFFFF;
constexpr HdEnum kCurrentButtons = 0x2000, kCurrentPosition = 0x2050, kCurrentTransform = 0x2052;
constexpr HdEnum kDeviceModelType = 0x2501, kCalibrationStyle = 0x2555;
constexpr HdEnum kNominalMaxStiffness = 0x2602, kNominalMaxForce = 0x2603, kNominalMaxDamping = 0x2609;
constexpr HdEnum kCurrentForce = 0x2700, kForceOutput = 0x4000;
constexpr HdEnum kCalibrationOk = 0x5000, kCalibrationNeedsUpdate = 0x5001;
constexpr unsigned int kCallbackContinue = 1;
constexpr unsigned short kDefaultPriority = 0xFFFF / 2;
constexpr int kFirstButton = 1;  // a bit, and the bits of the others follow

constexpr double kMPerMm = 1e-3;
/// Errors taken from the stack at once: more is a library that never says success.
constexpr int kMaxErrors = 32;

/// The maker's x axis points to the right, y up and z to the operator.
const DeviceAxes kAxes{(Eigen::Matrix3d() << 1, 0, 0, 0, 0, -1, 0, 1, 0).finished()};

steady_clock::duration seconds(double s) {
  return std::chrono::duration_cast<steady_clock::duration>(std::chrono::duration<double>(s));
}

struct Functions {
  HdDevice (*init_device)(const char* name);
  void (*disable_device)(HdDevice device);
  void (*make_current)(HdDevice device);
  void (*enable)(HdEnum capability);
  void (*begin_frame)(HdDevice device);
  void (*end_frame)(HdDevice device);
  void (*get_doubles)(HdEnum parameter, double* values);
  void (*get_integers)(HdEnum parameter, int* values);
  const char* (*get_string)(HdEnum parameter);
  void (*set_doubles)(HdEnum parameter, const double* values);
  HdError (*get_error)();
  const char* (*error_string)(unsigned int code);
  HdEnum (*check_calibration)();
  void (*update_calibration)(HdEnum style);
  HdSchedule (*schedule)(unsigned int (*callback)(void*), void* data, unsigned short priority);
  void (*unschedule)(HdSchedule operation);
  void (*start_scheduler)();
  void (*stop_scheduler)();

  static Result<Functions> load(const std::string& path) {
    TM_ASSIGN_OR_RETURN(library, VendorLibrary::open(path, kKit, kRemedy));
    Functions f{};
    TM_RETURN_IF_ERROR(library.find("hdInitDevice", f.init_device));
    TM_RETURN_IF_ERROR(library.find("hdDisableDevice", f.disable_device));
    TM_RETURN_IF_ERROR(library.find("hdMakeCurrentDevice", f.make_current));
    TM_RETURN_IF_ERROR(library.find("hdEnable", f.enable));
    TM_RETURN_IF_ERROR(library.find("hdBeginFrame", f.begin_frame));
    TM_RETURN_IF_ERROR(library.find("hdEndFrame", f.end_frame));
    TM_RETURN_IF_ERROR(library.find("hdGetDoublev", f.get_doubles));
    TM_RETURN_IF_ERROR(library.find("hdGetIntegerv", f.get_integers));
    TM_RETURN_IF_ERROR(library.find("hdGetString", f.get_string));
    TM_RETURN_IF_ERROR(library.find("hdSetDoublev", f.set_doubles));
    TM_RETURN_IF_ERROR(library.find("hdGetError", f.get_error));
    TM_RETURN_IF_ERROR(library.find("hdGetErrorString", f.error_string));
    TM_RETURN_IF_ERROR(library.find("hdCheckCalibration", f.check_calibration));
    TM_RETURN_IF_ERROR(library.find("hdUpdateCalibration", f.update_calibration));
    TM_RETURN_IF_ERROR(library.find("hdScheduleAsynchronous", f.schedule));
    TM_RETURN_IF_ERROR(library.find("hdUnschedule", f.unschedule));
    TM_RETURN_IF_ERROR(library.find("hdStartScheduler", f.start_scheduler));
    TM_RETURN_IF_ERROR(library.find("hdStopScheduler", f.stop_scheduler));
    return f;
  }

  /// Empties the error stack. Returns the oldest error, because the others follow from it.
  std::optional<HdError> take_error() const {
    std::optional<HdError> oldest;
    for (int i = 0; i < kMaxErrors; ++i) {
      const HdError error = get_error();
      if (error.code == kSuccess) break;
      oldest = error;
    }
    return oldest;
  }

  /// Returns the limit that the device states, times `unit`, if it is a limit and below `bound`.
  double limit(HdEnum parameter, double unit, double bound) const {
    double stated = 0;
    get_doubles(parameter, &stated);
    stated *= unit;
    return std::isfinite(stated) && stated > 0 ? std::min(stated, bound) : bound;
  }
};

}  // namespace

/// An open device and its frames. The mutex guards what the loop shares with the scheduler's thread.
class OpenHapticsDevice::Session {
 public:
  Session(const Functions& hd, const OpenHapticsOptions& options) : hd_(hd), options_(options) {}

  /// Takes the force off, then stops the frames and gives the device back.
  ~Session() {
    if (started_) {
      std::unique_lock lock(mutex_);
      leaving_ = true;
      changed_.wait_for(lock, seconds(kOpenHapticsCloseTimeoutS), [this] { return left_ || error_; });
    }
    // In the documented order. No frame runs once the scheduler has stopped, so this object may go.
    if (started_) hd_.stop_scheduler();
    if (scheduled_) hd_.unschedule(schedule_);
    if (device_ != kInvalidDevice) hd_.disable_device(device_);
  }
  Session(const Session&) = delete;
  Session& operator=(const Session&) = delete;

  /// Opens the device and waits for its first frame.
  Result<void> start() {
    device_ = hd_.init_device(options_.name.empty() ? nullptr : options_.name.c_str());
    if (const auto error = hd_.take_error(); error || device_ == kInvalidDevice) {
      device_ = kInvalidDevice;
      return error ? failed("open the device", *error)
                   : fail(ErrorCode::kUnavailable, fmt::format("{}: cannot open the device; {}", who(), kCheck));
    }
    hd_.make_current(device_);
    if (const char* model = hd_.get_string(kDeviceModelType); model != nullptr) model_ = model;
    limits_ = kOpenHapticsBounds;
    limits_.name = who();
    // The reference states stiffness in N/mm and damping in N s/mm.
    limits_.max_force_n = hd_.limit(kNominalMaxForce, 1.0, limits_.max_force_n);
    limits_.max_stiffness_n_per_m = hd_.limit(kNominalMaxStiffness, 1.0 / kMPerMm, limits_.max_stiffness_n_per_m);
    limits_.max_damping_n_s_per_m = hd_.limit(kNominalMaxDamping, 1.0 / kMPerMm, limits_.max_damping_n_s_per_m);
    // A device that does not state a limit answers with an error, which we ignore.
    static_cast<void>(hd_.take_error());
    hd_.enable(kForceOutput);
    schedule_ = hd_.schedule(&Session::on_frame, this, kDefaultPriority);
    if (const auto error = hd_.take_error()) return failed("schedule its frames", *error);
    scheduled_ = true;
    hd_.start_scheduler();
    if (const auto error = hd_.take_error()) return failed("start its scheduler", *error);
    started_ = true;
    {
      std::unique_lock lock(mutex_);
      changed_.wait_for(lock, seconds(kOpenHapticsOpenTimeoutS), [this] { return error_ || pose_; });
      if (error_) return tl::make_unexpected(*error_);
      if (!pose_) {
        return fail(ErrorCode::kUnavailable, fmt::format("{}: its scheduler made no frame within {:g} s; {}", who(),
                                                         kOpenHapticsOpenTimeoutS, kCheck));
      }
    }
    return calibrate();
  }

  /// The newest pose, in this client's axes.
  Result<DevicePose> newest() const {
    const std::scoped_lock lock(mutex_);
    if (error_) return tl::make_unexpected(*error_);
    if (steady_clock::now() - arrival_ <= seconds(kMaxOpenHapticsSilenceS)) return *pose_;
    return fail(ErrorCode::kUnavailable,
                fmt::format("{}: its scheduler has made no frame for {:g} s; check its cable and that the machine is "
                            "not overloaded",
                            who(), kMaxOpenHapticsSilenceS));
  }

  /// Sets the force of the next frames, in this client's axes.
  Result<void> set_force(const Eigen::Vector3d& force_n) {
    const std::scoped_lock lock(mutex_);
    force_n_ = kAxes.to_maker(force_n);
    if (error_) return tl::make_unexpected(*error_);
    return {};
  }

  const DeviceInfo& limits() const { return limits_; }

 private:
  static constexpr const char* kCheck =
      "check its power and its cable, that the maker's setup program sees it, and --device-id";

  static unsigned int on_frame(void* session) noexcept { return static_cast<Session*>(session)->frame(); }

  /// One frame, on the scheduler's thread. After an error the force stays zero.
  unsigned int frame() noexcept {
    Eigen::Vector3d position_mm = Eigen::Vector3d::Zero(), force_n = Eigen::Vector3d::Zero();
    Eigen::Matrix4d transform = Eigen::Matrix4d::Identity();
    int buttons = 0;
    bool leaves = false;
    {
      const std::scoped_lock lock(mutex_);
      leaves = leaving_;
      if (!leaves && !error_) force_n = force_n_;
    }
    hd_.begin_frame(device_);
    hd_.get_doubles(kCurrentPosition, position_mm.data());
    hd_.get_doubles(kCurrentTransform, transform.data());  // in columns, as Eigen has it
    hd_.get_integers(kCurrentButtons, &buttons);
    hd_.set_doubles(kCurrentForce, force_n.data());
    hd_.end_frame(device_);
    const std::optional<HdError> error = hd_.take_error();

    DevicePose pose{kAxes.from_maker(Eigen::Vector3d(kMPerMm * position_mm)),
                    kAxes.from_maker(Eigen::Matrix3d(transform.topLeftCorner<3, 3>()))};
    if (options_.moves_jaws) pose.jaw_angle_rad = (buttons & kFirstButton) != 0 ? 0.0 : kButtonJawAngleRad;
    // Buttons of a frame that failed are not known, and the loop then ends.
    if (options_.power_button > 0 && !error)
      pose.pressed = (buttons & (kFirstButton << (options_.power_button - 1))) != 0;
    {
      const std::scoped_lock lock(mutex_);
      if (error && !error_) error_ = failed("make a frame", *error).value();
      pose_ = pose;
      arrival_ = steady_clock::now();
      left_ = leaves;
    }
    changed_.notify_all();
    return kCallbackContinue;
  }

  /// Brings the encoders to the device's own zero, as far as that needs no hand.
  Result<void> calibrate() const {
    HdEnum state = hd_.check_calibration();
    if (state == kCalibrationNeedsUpdate) {
      int style = 0;
      hd_.get_integers(kCalibrationStyle, &style);
      hd_.update_calibration(static_cast<HdEnum>(style));
      state = hd_.check_calibration();
    }
    if (const auto error = hd_.take_error()) return failed("calibrate it", *error);
    if (state == kCalibrationOk) return {};
    return fail(ErrorCode::kUnavailable,
                fmt::format("{}: it is not calibrated; put its stylus into the inkwell, or calibrate it with the "
                            "maker's diagnostic program, and start again",
                            who()));
  }

  std::string who() const { return model_.empty() ? std::string(kKit) : fmt::format("{} {}", kKit, model_); }

  tl::unexpected<Error> failed(const char* what, const HdError& error) const {
    const char* words = hd_.error_string(error.code);
    const bool by_force = error.code >> 8 == 2;  // 0x02xx: warm motors, too much force
    return fail(ErrorCode::kUnavailable,
                fmt::format("{}: cannot {} (error {:#06x}: {}, internal {}); {}", who(), what, error.code,
                            words == nullptr ? "no reason given" : words, error.internal_code,
                            by_force ? "let its motors cool down and lower --max-force" : kCheck));
  }

  const Functions hd_;
  const OpenHapticsOptions options_;
  HdDevice device_ = kInvalidDevice;
  HdSchedule schedule_ = 0;
  bool scheduled_ = false;
  bool started_ = false;
  std::string model_;
  DeviceInfo limits_;

  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::optional<DevicePose> pose_;
  steady_clock::time_point arrival_;
  std::optional<Error> error_;
  Eigen::Vector3d force_n_ = Eigen::Vector3d::Zero();
  bool leaving_ = false;
  bool left_ = false;
};

OpenHapticsDevice::OpenHapticsDevice(OpenHapticsOptions options)
    : options_(std::move(options)), info_(kOpenHapticsBounds) {}

OpenHapticsDevice::~OpenHapticsDevice() { close(); }

Result<void> OpenHapticsDevice::open() {
  close();
  TM_RETURN_IF_ERROR(check(options_.workspace, kKit));
  TM_RETURN_IF_ERROR(check_power_button(options_.power_button, kOpenHapticsButtons, kKit));
  if (options_.moves_jaws && options_.power_button == 1) {
    return invalid("OpenHaptics: the first button closes the tool's jaws; give its power another --cautery-button");
  }
  TM_ASSIGN_OR_RETURN(functions, Functions::load(options_.library));
  session_ = std::make_unique<Session>(functions, options_);
  const Result<void> started = session_->start();
  const Result<DevicePose> first = started ? session_->newest() : tl::make_unexpected(started.error());
  if (!first) {
    close();
    return tl::make_unexpected(first.error());
  }
  map_ = map_from(first->position_m, options_.workspace);
  info_ = map_.to_scene(session_->limits());
  return {};
}

Result<DevicePose> OpenHapticsDevice::read() {
  if (session_ == nullptr) return fail(ErrorCode::kFailedPrecondition, "OpenHaptics: read before open");
  TM_ASSIGN_OR_RETURN(pose, session_->newest());
  return map_.to_scene(pose);
}

Result<void> OpenHapticsDevice::write_force(const Eigen::Vector3d& force_n) {
  if (session_ == nullptr) return fail(ErrorCode::kFailedPrecondition, "OpenHaptics: write before open");
  if (!force_n.allFinite()) return invalid("OpenHaptics: the force is not finite");
  return session_->set_force(map_.force_to_device(force_n));
}

void OpenHapticsDevice::close() noexcept { session_.reset(); }

}  // namespace tensormass::haptic
