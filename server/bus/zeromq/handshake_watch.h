#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <map>

namespace tensormass::bus {

/// Tells how many peers of a socket came without speaking ZeroMQ, from what the socket's monitor says.
///
/// ZeroMQ reports no failure for some of them: it takes bytes that are not its greeting for an ancient version of its
/// protocol. What it does report is each connection that is accepted or closed, with its descriptor, and each handshake
/// that succeeds, without. So with u the accepted that have not succeeded and have not been told of, and r the
/// connections that are open and young enough to be in their handshake, at least u − r peers did not speak ZeroMQ.
class HandshakeWatch {
 public:
  using Time = std::chrono::steady_clock::time_point;

  /// `patience`: longer than any handshake may take.
  explicit HandshakeWatch(std::chrono::milliseconds patience) : patience_(patience) {}

  void accepted(int descriptor, Time now) {
    ++unexplained_;
    young_.insert_or_assign(descriptor, now + patience_);
  }
  void succeeded() { --unexplained_; }
  void disconnected(int descriptor) { young_.erase(descriptor); }

  /// How many more there are since the last call.
  std::int64_t take_refused(Time now) {
    std::erase_if(young_, [now](const auto& connection) { return connection.second <= now; });
    const std::int64_t refused = std::max<std::int64_t>(0, unexplained_ - static_cast<std::int64_t>(young_.size()));
    unexplained_ -= refused;
    return refused;
  }
  /// Time alone may bring more.
  bool is_waiting() const { return !young_.empty(); }

 private:
  const std::chrono::milliseconds patience_;
  std::int64_t unexplained_ = 0;
  std::map<int, Time> young_;
};

}  // namespace tensormass::bus
