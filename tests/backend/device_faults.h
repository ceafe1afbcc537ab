#pragma once

#include <cstddef>
#include <string>
#include <vector>

/// Faults of kernels that end a process's use of its GPU, for tests.
namespace tensormass::tests {

enum class DeviceFault { kIllegalAddress, kMisalignedAddress, kAssert, kTrap };

/// Runs a kernel with that fault. Returns what CUDA answers to it, and to two calls after it.
std::vector<std::string> answers_to(DeviceFault fault);

/// Makes a GPU current for this thread's next calls of CUDA. Returns CUDA's answer.
std::string make_current(int device);

/// Asks for device memory, gives it back, and returns CUDA's answer.
std::string answer_to_allocation(std::size_t bytes);

}  // namespace tensormass::tests
