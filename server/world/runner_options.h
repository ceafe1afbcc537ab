#pragma once

#include <cstdint>
#include <string>

#include "core/result.h"

/// The device on which scenes step: what a caller chooses, and what that is on this machine.
namespace tensormass::world {

enum class BackendChoice { kAuto, kCpu, kCuda };

struct RunnerOptions {
  BackendChoice backend = BackendChoice::kAuto;
  std::uint32_t cpu_threads = 1;  ///< threads of a scene that does not set its own
  std::uint32_t gpu_scenes = 1;   ///< number of scenes that step on the GPU at the same time
};

/// Names of a backend and its device on this machine: "cpu", "AMD EPYC ..., 2 threads".
struct BackendDescription {
  std::string backend;
  std::string device;
  std::string reason;  ///< why it was selected, for people
};
/// Describes the backend that `choice` selects. kCuda without a device is an error; kAuto falls back to the CPU.
Result<BackendDescription> describe_backend(BackendChoice choice);

}  // namespace tensormass::world
