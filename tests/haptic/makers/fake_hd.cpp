#include "fake_hd.h"

#include <atomic>
#include <chrono>
#include <deque>
#include <memory>
#include <thread>

// The functions of libHD.so that the client uses, with the types of the maker's reference. A call in a place where the
// reference forbids it is written down as misuse.

namespace {

using tensormass::haptic::FakeHd;

struct Error {
  unsigned int code;
  int internal_code;
  unsigned int device;
};

constexpr unsigned int kHandle = 7;
constexpr unsigned long kSchedule = 42;

std::unique_ptr<FakeHd> device = std::make_unique<FakeHd>();
std::deque<Error> errors;
unsigned int (*callback)(void*) = nullptr;
void* callback_data = nullptr;
bool in_frame = false;
std::atomic<bool> running = false;
std::thread scheduler;

void record(const char* call) {
  const std::scoped_lock lock(device->mutex);
  device->calls.emplace_back(call);
}

void require(bool right, const char* words) {
  if (!right) device->misuse.emplace_back(words);
}

void push(unsigned int code) {
  if (code != 0) errors.push_back({code, 11, kHandle});
}

}  // namespace

extern "C" {

FakeHd* fake_hd() {
  device = std::make_unique<FakeHd>();
  errors.clear();
  callback = nullptr;
  in_frame = false;
  return device.get();
}

unsigned int hdInitDevice(const char* name) {
  record("hdInitDevice");
  device->name = name == nullptr ? "(default)" : name;
  push(device->init_error);
  return device->init_error == 0 ? kHandle : 0xFFFFFFFF;
}

void hdDisableDevice(unsigned int handle) {
  record("hdDisableDevice");
  require(handle == kHandle, "an unknown device is disabled");
  require(!running, "the device is disabled while its scheduler runs");
}

void hdMakeCurrentDevice(unsigned int) { record("hdMakeCurrentDevice"); }

void hdEnable(unsigned int capability) {
  record("hdEnable");
  require(capability == 0x4000, "something else than the force output is enabled");
}

unsigned long hdScheduleAsynchronous(unsigned int (*function)(void*), void* data, unsigned short) {
  record("hdScheduleAsynchronous");
  callback = function;
  callback_data = data;
  push(device->schedule_error);
  return kSchedule;
}

void hdUnschedule(unsigned long schedule) {
  record("hdUnschedule");
  require(schedule == kSchedule, "an unknown operation is unscheduled");
  callback = nullptr;
}

void hdStartScheduler() {
  record("hdStartScheduler");
  push(device->start_error);
  if (device->start_error != 0) return;
  running = true;
  scheduler = std::thread([] {
    while (running) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));  // the device's own pace
      bool frame = false;
      {
        const std::scoped_lock lock(device->mutex);
        frame = device->makes_frames;
      }
      if (frame && callback != nullptr) {
        const bool goes_on = callback(callback_data) == 1;
        const std::scoped_lock lock(device->mutex);
        require(goes_on, "the frames end by themselves");
      }
      device->changed.notify_all();
    }
  });
}

void hdStopScheduler() {
  record("hdStopScheduler");
  running = false;
  scheduler.join();
}

void hdBeginFrame(unsigned int handle) {
  const std::scoped_lock lock(device->mutex);
  require(handle == kHandle && !in_frame, "a frame begins within a frame");
  in_frame = true;
}

void hdEndFrame(unsigned int handle) {
  const std::scoped_lock lock(device->mutex);
  require(handle == kHandle && in_frame, "a frame ends that did not begin");
  in_frame = false;
  for (int i = 0; i < 3; ++i) device->position_mm[i] += device->step_mm[i];
  push(device->frame_error);
}

void hdGetDoublev(unsigned int parameter, double* values) {
  const std::scoped_lock lock(device->mutex);
  switch (parameter) {
    case 0x2050:
      require(in_frame, "the position is read outside of a frame");
      std::copy(device->position_mm.begin(), device->position_mm.end(), values);
      break;
    case 0x2052:
      require(in_frame, "the transform is read outside of a frame");
      std::copy(device->transform.begin(), device->transform.end(), values);
      break;
    case 0x2602:
      *values = device->max_stiffness_n_per_mm;
      break;
    case 0x2603:
      *values = device->max_force_n;
      break;
    case 0x2609:
      *values = device->max_damping_n_s_per_mm;
      break;
    default:
      require(false, "an unknown parameter is read");
  }
}

void hdGetIntegerv(unsigned int parameter, int* values) {
  const std::scoped_lock lock(device->mutex);
  require(parameter == 0x2000 || parameter == 0x2555, "an unknown parameter is read");
  *values = parameter == 0x2000 ? device->buttons : 4;
}

const char* hdGetString(unsigned int parameter) { return parameter == 0x2501 ? "Fake Touch" : nullptr; }

void hdSetDoublev(unsigned int parameter, const double* values) {
  const std::scoped_lock lock(device->mutex);
  require(parameter == 0x2700 && in_frame, "a force is set outside of a frame");
  device->forces_n.push_back({values[0], values[1], values[2]});
}

Error hdGetError() {
  if (errors.empty()) return {0, 0, 0};
  const Error newest = errors.back();  // a stack, as the reference says
  errors.pop_back();
  return newest;
}

const char* hdGetErrorString(unsigned int) { return "words of the maker"; }

unsigned int hdCheckCalibration() { return device->calibration; }

#ifndef WITHOUT_CALIBRATION
void hdUpdateCalibration(unsigned int style) {
  device->updated_style = static_cast<int>(style);
  device->calibration = device->calibration_after_update;
}
#endif

}  // extern "C"
