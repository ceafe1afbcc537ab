#include "world/device_loss.h"

#include <algorithm>
#include <array>

namespace tensormass::world {

namespace {

/// CUDA's documentation says of these errors that the process must be ended and started again. Their texts stand here
/// and not their numbers, because an exception of the backend has the text, and this file is built without CUDA.
constexpr std::array<std::string_view, 10> kLosses{
    "an illegal memory access was encountered",                  // cudaErrorIllegalAddress
    "the launch timed out and was terminated",                   // cudaErrorLaunchTimeout
    "device-side assert triggered",                              // cudaErrorAssert
    "hardware stack error",                                      // cudaErrorHardwareStackError
    "an illegal instruction was encountered",                    // cudaErrorIllegalInstruction
    "misaligned address",                                        // cudaErrorMisalignedAddress
    "operation not supported on global/shared address space",    // cudaErrorInvalidAddressSpace
    "invalid program counter",                                   // cudaErrorInvalidPc
    "unspecified launch failure",                                // cudaErrorLaunchFailure
    "uncorrectable NVLink error detected during the execution",  // cudaErrorNvlinkUncorrectable
};

}  // namespace

bool loses_device(std::string_view failure) {
  return std::any_of(kLosses.begin(), kLosses.end(), [&](std::string_view loss) { return failure.ends_with(loss); });
}

}  // namespace tensormass::world
