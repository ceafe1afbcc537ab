#pragma once

// The file of a report. Used by one thread. Errors name the path and the system's reason.

#include <fstream>
#include <string>

#include "core/result.h"

namespace tensormass::haptic {

/// Destination of a report. Opened before the run, so that a path that cannot be written fails before the measurement
/// and not after it. An older report stays until write() replaces it.
class ReportFile {
 public:
  ReportFile() = default;
  /// Removes the file if open() created it and nothing was written.
  ~ReportFile();
  ReportFile(const ReportFile&) = delete;
  ReportFile& operator=(const ReportFile&) = delete;

  /// `path`: a file, `-` for standard output, or empty for no report. Fails with kInvalidArgument.
  Result<void> open(const std::string& path);
  /// Writes the whole report. Call once. Fails with kUnavailable, for example on a full disk.
  Result<void> write(const std::string& report);

 private:
  std::string path_;
  std::ofstream file_;
  bool made_ = false;
};

}  // namespace tensormass::haptic
