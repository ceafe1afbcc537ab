#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "core/result.h"

/// The device on which scenes step: what a caller chooses, and what that is on this machine.
namespace tensormass::world {

enum class BackendChoice { kAuto, kCpu, kCuda };

class Placement;

struct RunnerOptions {
  BackendChoice backend = BackendChoice::kAuto;
  std::uint32_t cpu_threads = 1;  ///< threads of a scene that does not set its own
  std::uint32_t gpu_scenes = 1;   ///< number of scenes that step on one GPU at the same time
  std::uint32_t device = 0;       ///< number of the GPU; Runner::start asks `placement` instead
  /// Chooses the GPU of each scene (placement.h); nullptr: scenes step on `device`.
  std::shared_ptr<Placement> placement = nullptr;
};

/// The device of one scene: "cuda", "NVIDIA ...", and the number of the GPU, 0 on the CPU.
struct SceneDevice {
  std::string backend;
  std::string name;
  std::uint32_t number = 0;
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
