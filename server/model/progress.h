#pragma once

#include <cstdint>
#include <functional>
#include <string_view>

#include "core/result.h"

namespace tensormass::model {

/// The parts of a load that take time, in their order.
enum class LoadPart : std::uint8_t {
  kReadMesh,
  kCheckMesh,
  kOrderNodes,
  kBoundaryConditions,
  kElements,
  kSurfaces,
  kBuffers
};

/// How far a load is. Told on the thread that loads, at the begin of each part.
class Progress {
 public:
  /// part: for people; fraction: of the time of the whole, as a large scene of one body takes it. False if nobody waits
  /// for the scene any more.
  using Listener = std::function<bool(std::string_view part, double fraction)>;

  Progress() = default;
  explicit Progress(Listener listener) : listener_(std::move(listener)) {}

  /// Fails with kCancelled if nobody waits. done, of count: for parts that come once a body.
  Result<void> begin(LoadPart part, std::size_t done = 0, std::size_t count = 1) const;

 private:
  Listener listener_;
};

}  // namespace tensormass::model
