#pragma once

#include <cstdint>
#include <vector>

#include "haptic/histogram.h"

namespace tensormass::haptic {

/// Pairs poses with feedback: the round trip of a pose ends with the first feedback that echoes its sequence or a
/// newer one. So a pose that a newer one overtook counts too, with the time until the hand felt something newer.
class LatencyTracker {
 public:
  LatencyTracker();

  /// Sequences count up from 1 without gaps.
  void sent(std::uint64_t sequence, std::int64_t now_ns);
  /// Feedback for `sequence` arrived. False, and nothing counted, if no such pose was sent.
  bool echoed(std::uint64_t sequence, std::int64_t arrival_ns);

  std::uint64_t last_sent() const { return last_sent_; }
  std::uint64_t last_echoed() const { return last_echoed_; }
  /// Pose sent to first feedback that answers it or a newer one.
  const Histogram& round_trip() const { return round_trip_; }
  /// Sent so long ago (16,384 poses) when an echo came that their time was forgotten; not in the histogram.
  std::uint64_t forgotten() const { return forgotten_; }

 private:
  std::vector<std::int64_t> sent_ns_;  // ring by sequence
  std::uint64_t last_sent_ = 0;
  std::uint64_t last_echoed_ = 0;
  std::uint64_t forgotten_ = 0;
  Histogram round_trip_;
};

}  // namespace tensormass::haptic
