#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <map>

namespace tensormass::bus {

/// Counts the peers of one ZeroMQ socket that connected and did not speak ZeroMQ.
///
/// ZeroMQ does not report all of them as failures: it takes bytes that are not its greeting for an old version of its
/// protocol. Its monitor does report three events, and only the first two carry the connection's file descriptor:
///
///     accepted(d)       a peer connected
///     disconnected(d)   the connection closed
///     succeeded         some peer finished the handshake
///
/// The count follows from them. Let
///
///     u = accepted − succeeded − already counted     connections without a known outcome
///     r = connections that are open and younger than the timeout, so their handshake may still succeed
///
/// Then at least u − r peers did not speak ZeroMQ. A peer that succeeded and is young hides a failed one in r, until it
/// is older than the timeout; so every failure is counted in the end.
///
/// One thread at a time may use an object.
class HandshakeCounter {
 public:
  using Time = std::chrono::steady_clock::time_point;

  /// `timeout`: longer than any handshake may take.
  explicit HandshakeCounter(std::chrono::milliseconds timeout) : timeout_(timeout) {}

  void accepted(int descriptor, Time now) {
    ++unexplained_;
    young_.insert_or_assign(descriptor, now + timeout_);
  }
  void succeeded() { --unexplained_; }
  void disconnected(int descriptor) { young_.erase(descriptor); }

  /// Returns the number of failures found since the last call.
  std::int64_t take_refused(Time now) {
    std::erase_if(young_, [now](const auto& connection) { return connection.second <= now; });
    const std::int64_t refused = std::max<std::int64_t>(0, unexplained_ - static_cast<std::int64_t>(young_.size()));
    unexplained_ -= refused;
    return refused;
  }
  /// True if a later call of take_refused may find failures without any further event.
  bool is_waiting() const { return !young_.empty(); }

 private:
  const std::chrono::milliseconds timeout_;
  std::int64_t unexplained_ = 0;  // u
  std::map<int, Time> young_;     // descriptor -> end of its timeout; r is the size
};

}  // namespace tensormass::bus
