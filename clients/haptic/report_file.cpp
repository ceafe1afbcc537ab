#include "haptic/report_file.h"

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <iostream>
#include <system_error>

namespace tensormass::haptic {
namespace {

constexpr const char* kStandardOutput = "-";

}  // namespace

ReportFile::~ReportFile() {
  std::error_code ignored;
  if (made_) std::filesystem::remove(path_, ignored);
}

Result<void> ReportFile::open(const std::string& path) {
  path_ = path;
  if (path.empty() || path == kStandardOutput) return {};
  std::error_code ignored;
  const bool existed = std::filesystem::exists(path, ignored);
  file_.open(path, std::ios::app);  // keeps an older report
  if (!file_) return invalid("cannot write the report to " + path + ": " + std::strerror(errno));
  made_ = !existed;
  return {};
}

Result<void> ReportFile::write(const std::string& report) {
  if (path_.empty()) return {};
  std::error_code ignored;
  // Only regular files: devices and pipes have no size to set.
  if (file_.is_open() && std::filesystem::is_regular_file(path_, ignored))
    std::filesystem::resize_file(path_, 0, ignored);
  std::ostream& out = path_ == kStandardOutput ? std::cout : file_;
  if (!(out << report).flush()) {
    return fail(ErrorCode::kUnavailable, "cannot write the report to " + path_ + ": " + std::strerror(errno));
  }
  made_ = false;
  return {};
}

}  // namespace tensormass::haptic
