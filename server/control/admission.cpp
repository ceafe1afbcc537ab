#include "control/admission.h"

#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <string>

#include <fmt/format.h>

#include "control/scene_cost.h"
#include "core/http2_limits.h"
#include "core/limits.h"

namespace tensormass::control {
namespace {

constexpr double kMib = 1 << 20;

/// Returns the number at the start of a file. Returns `otherwise` for a file that is missing or starts with a word,
/// such as "max", which cgroups write without a bound.
double read_number(const std::string& path, double otherwise) {
  std::ifstream file(path);
  double number = 0;
  return file >> number ? number : otherwise;
}

/// Returns the folder of this process's cgroup (version 2), relative to /sys/fs/cgroup.
std::string own_cgroup() {
  std::ifstream file("/proc/self/cgroup");
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("0::")) return line.substr(3);
  }
  return {};
}

}  // namespace

double Admission::machine_bytes() {
  double bytes = static_cast<double>(sysconf(_SC_PHYS_PAGES)) * static_cast<double>(sysconf(_SC_PAGESIZE));
  const std::string root = "/sys/fs/cgroup";
  // A container sees its own cgroup as the root; version 1 has a folder for memory.
  for (const std::string& path :
       {root + "/memory.max", root + own_cgroup() + "/memory.max", root + "/memory/memory.limit_in_bytes"}) {
    bytes = std::min(bytes, read_number(path, bytes));
  }
  return bytes;
}

double Admission::resident_bytes() {
  std::ifstream file("/proc/self/statm");
  double size = 0, resident = 0;
  file >> size >> resident;
  return resident * static_cast<double>(sysconf(_SC_PAGESIZE));
}

Admission::Admission(const AdmissionLimits& limits, double (*used_bytes)(), Refusals* refusals)
    : limits_(limits), used_bytes_(used_bytes), refusals_(refusals) {
  if (!(limits_.all_bytes > 0)) limits_.all_bytes = kDefaultMemoryShare * machine_bytes();
  if (!(limits_.scene_bytes > 0)) limits_.scene_bytes = limits_.all_bytes;
  if (!(limits_.load_s > 0)) limits_.load_s = kDefaultLoadS;
  if (!(limits_.message_bytes > 0)) limits_.message_bytes = limits::kDefaultHalfSentBytes;
}

bool Admission::has_room(double bytes) {
  const std::lock_guard lock(mutex_);
  return used_bytes_() + promised_ + bytes <= limits_.all_bytes;
}

Admission::Promise::~Promise() {
  if (admission_ == nullptr) return;
  const std::lock_guard lock(admission_->mutex_);
  admission_->promised_ -= bytes_;
}

Result<Admission::Promise> Admission::admit(const v1::Scene& scene) {
  const SceneCost cost = estimate_cost(scene);
  const auto refuse = [&](Limit limit, const std::string& why) {
    if (refusals_ != nullptr) refusals_->count(limit);
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene '{}' has about {:.0f} elements and {:.0f} nodes, and {}",
                            scene.name().substr(0, limits::kMaxNameLength), cost.elements, cost.nodes, why));
  };
  // Beyond the hard limits the reader refuses it before it allocates, and names the body.
  if (cost.elements > limits::kMaxElements || cost.nodes > limits::kMaxNodes) return Promise(*this, 0);
  if (cost.compile_s > limits_.load_s) {
    return refuse(Limit::kLoadTime,
                  fmt::format("loading it takes about {:.0f} s, more than --max-load-s {:.0f}; use a coarser mesh, or "
                              "start the daemon with a larger --max-load-s",
                              cost.compile_s, limits_.load_s));
  }
  if (cost.bytes > limits_.scene_bytes) {
    return refuse(Limit::kSceneMemory,
                  fmt::format("needs about {:.0f} MiB, more than --max-scene-mib {:.0f}; use a coarser mesh, or start "
                              "the daemon with a larger --max-scene-mib",
                              cost.bytes / kMib, limits_.scene_bytes / kMib));
  }
  const std::lock_guard lock(mutex_);
  const double used = used_bytes_() + promised_;
  if (used + cost.bytes > limits_.all_bytes) {
    return refuse(Limit::kMemory,
                  fmt::format("needs about {:.0f} MiB, but {:.0f} MiB of --max-memory-mib {:.0f} are taken; unload a "
                              "scene, or start the daemon with a larger --max-memory-mib",
                              cost.bytes / kMib, used / kMib, limits_.all_bytes / kMib));
  }
  promised_ += cost.bytes;
  return Promise(*this, cost.bytes);
}

}  // namespace tensormass::control
