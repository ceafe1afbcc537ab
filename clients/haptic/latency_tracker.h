#pragma once

// Round-trip times of poses. Times in ns on one clock. Not thread-safe; the loop's thread owns it.

#include <cstdint>
#include <vector>

#include "haptic/histogram.h"

namespace tensormass::haptic {

/// Pairs poses with feedback. The round trip of a pose ends with the first feedback that echoes its sequence or a newer
/// one. A pose that a newer one replaced therefore counts too.
class LatencyTracker {
 public:
  LatencyTracker();

  /// Records a pose. Sequences must rise from 1 without gaps (asserted).
  void sent(std::uint64_t sequence, std::int64_t now_ns);
  /// Records feedback that echoes `sequence`. Returns false, and counts nothing, if no such pose was sent.
  bool echoed(std::uint64_t sequence, std::int64_t arrival_ns);

  std::uint64_t last_sent() const { return last_sent_; }
  std::uint64_t last_echoed() const { return last_echoed_; }
  /// From sending a pose to the first feedback that answers it or a newer one.
  const Histogram& round_trip() const { return round_trip_; }
  /// Poses without a round trip: more than 16,384 newer ones were sent before an echo, so their time was overwritten.
  std::uint64_t forgotten() const { return forgotten_; }

 private:
  std::vector<std::int64_t> sent_ns_;  // ring by sequence
  std::uint64_t last_sent_ = 0;
  std::uint64_t last_echoed_ = 0;
  std::uint64_t forgotten_ = 0;
  Histogram round_trip_;
};

}  // namespace tensormass::haptic
