#pragma once

#include <string_view>

namespace tensormass::world {

/// Returns whether a device failed in a way that ends its use for this process: CUDA answers every later call with the
/// same error, and only a new process gets a device that works. Other failures, as a lack of memory, stop one scene.
/// failure: the text of the exception, which ends with that of cudaGetErrorString
bool loses_device(std::string_view failure);

}  // namespace tensormass::world
