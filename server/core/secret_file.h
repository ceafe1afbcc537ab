#pragma once

#include <sys/types.h>

#include <string>
#include <string_view>

#include "core/result.h"

namespace tensormass {

/// Reads a file that only its owner and its group may use, such as one with a secret. The owner must be this process's
/// effective user or root.
///
///   forbidden   bits of the mode that it must not have: S_IRWXO for a secret, S_IWOTH for what everybody may read
///   place       goes before the path in errors: the option that names the file
///   remedy      ends the error for a file that cannot be read: how to get another
///
/// Fails with kInvalidArgument, and names file and remedy, if it cannot be read, is not a file, has a forbidden bit or
/// belongs to somebody else.
Result<std::string> read_file_of_owner(const std::string& path, mode_t forbidden, std::string_view place,
                                       std::string_view remedy);

}  // namespace tensormass
