#pragma once

#include <fstream>
#include <string>

#include "core/result.h"

namespace tensormass::haptic {

/// Where a report goes. Opened before the run: a path that cannot be written is told at once, not when the measurement
/// is over and lost. An older report stays until the new one is there to replace it.
class ReportFile {
 public:
  ReportFile() = default;
  /// Takes away a file that it made and did not write.
  ~ReportFile();
  ReportFile(const ReportFile&) = delete;
  ReportFile& operator=(const ReportFile&) = delete;

  /// `path`: a file, - for standard output, or empty for nowhere.
  Result<void> open(const std::string& path);
  /// All of it, once.
  Result<void> write(const std::string& report);

 private:
  std::string path_;
  std::ofstream file_;
  bool made_ = false;
};

}  // namespace tensormass::haptic
