#include "haptic/latency_tracker.h"

#include <algorithm>
#include <cassert>

namespace tensormass::haptic {
namespace {

constexpr std::uint64_t kRemembered = 1u << 14;

}  // namespace

LatencyTracker::LatencyTracker() : sent_ns_(kRemembered) {}

void LatencyTracker::sent(std::uint64_t sequence, std::int64_t now_ns) {
  assert(sequence == last_sent_ + 1);
  sent_ns_[sequence % kRemembered] = now_ns;
  last_sent_ = sequence;
}

bool LatencyTracker::echoed(std::uint64_t sequence, std::int64_t arrival_ns) {
  if (sequence == 0 || sequence > last_sent_) return false;
  const std::uint64_t oldest = last_sent_ >= kRemembered ? last_sent_ - kRemembered + 1 : 1;
  const std::uint64_t first = std::max(last_echoed_ + 1, oldest);
  if (sequence > last_echoed_) forgotten_ += std::min(first, sequence + 1) - (last_echoed_ + 1);
  for (std::uint64_t s = first; s <= sequence; ++s) round_trip_.add(arrival_ns - sent_ns_[s % kRemembered]);
  last_echoed_ = std::max(last_echoed_, sequence);
  return true;
}

}  // namespace tensormass::haptic
