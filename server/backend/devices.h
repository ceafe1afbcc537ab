#pragma once

#include <cstdint>
#include <vector>

#include "core/result.h"

/// The GPUs of this machine over which scenes are placed (world/placement.h).
namespace tensormass::backend {

/// Memory of a GPU [bytes]. free: what no process has taken.
struct DeviceMemory {
  std::uint64_t free = 0, total = 0;
};

/// Returns CUDA's numbers of the GPUs on which scenes may step: the first one and all of its kind, in ascending order.
/// A scene is compiled alike for all of them, and its results have the same bits on each. Other kinds would cut it
/// into other patches. Empty: there is no GPU, or no CUDA in this build.
std::vector<std::uint32_t> list_cuda_devices();

/// Reads the memory of a GPU. The first call for a GPU starts its use by this process, which takes a part of a second.
/// Fails with kUnavailable if the GPU does not answer.
Result<DeviceMemory> read_cuda_memory(std::uint32_t device);

}  // namespace tensormass::backend
