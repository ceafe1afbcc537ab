#pragma once

#include <cstdint>
#include <functional>
#include <string_view>

#include "core/result.h"

namespace tensormass::model {

/// The parts of a load that take time, in order.
enum class LoadPart : std::uint8_t {
  kReadMesh,
  kCheckMesh,
  kOrderNodes,
  kBoundaryConditions,
  kElements,
  kSurfaces,
  kBuffers
};

/// Reports how far a load is, at the start of each part, on the thread that loads.
class Progress {
 public:
  /// part:     name of the part, for people.
  /// fraction: time so far over the time of the whole load, as measured for a large scene of one body.
  /// returns:  false if nobody waits for the scene any more.
  using Listener = std::function<bool(std::string_view part, double fraction)>;

  Progress() = default;
  explicit Progress(Listener listener) : listener_(std::move(listener)) {}

  /// Reports the start of a part. Fails with kCancelled if nobody waits.
  /// done, count: for parts that come once a body, the bodies that are done and their number.
  Result<void> begin(LoadPart part, std::size_t done = 0, std::size_t count = 1) const;

 private:
  Listener listener_;
};

}  // namespace tensormass::model
