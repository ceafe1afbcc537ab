#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>

namespace tensormass::bus {

/// The open connections of one ZeroMQ socket, a limited number. ZeroMQ takes as many as the process has descriptors,
/// and then the rest of the daemon has none.
///
/// Beyond the limit the oldest connection ends whose peer has sent nothing that it may send. So peers that only hold
/// connections keep out none that uses one. Clients of ZeroMQ connect again by themselves.
///
/// ZeroMQ does not tell of every end, so at the limit the connections are looked at again, kLookPeriod apart at least.
///
/// One thread at a time may use an object.
class Connections {
 public:
  using Time = std::chrono::steady_clock::time_point;

  explicit Connections(std::size_t most) : most_(most) {}

  /// A peer connected. Returns the descriptor of the connection that must end, if there is one too many.
  /// is_open: bool(int descriptor)
  template <class IsOpen>
  std::optional<int> accepted(int descriptor, Time now, const IsOpen& is_open) {
    open_.insert_or_assign(descriptor, Connection{next_++, false});
    if (open_.size() <= most_) return std::nullopt;
    if (now >= look_after_) {
      look_after_ = now + kLookPeriod;
      std::erase_if(open_, [&](const auto& each) { return !is_open(each.first); });
      if (open_.size() <= most_) return std::nullopt;
    }
    const auto is_better = [](const auto& a, const auto& b) {
      return a.second.used != b.second.used ? b.second.used : a.second.number < b.second.number;
    };
    const auto ended = std::min_element(open_.begin(), open_.end(), is_better);
    const int ended_descriptor = ended->first;
    open_.erase(ended);
    return ended_descriptor;
  }
  void disconnected(int descriptor) { open_.erase(descriptor); }
  /// Something came that the peer may send.
  void used(int descriptor) {
    if (const auto found = open_.find(descriptor); found != open_.end()) found->second.used = true;
  }
  std::size_t count() const { return open_.size(); }

 private:
  static constexpr std::chrono::milliseconds kLookPeriod{100};

  struct Connection {
    std::uint64_t number;  // smaller: older
    bool used;
  };

  const std::size_t most_;
  std::map<int, Connection> open_;  // by descriptor
  std::uint64_t next_ = 0;
  Time look_after_{};
};

}  // namespace tensormass::bus
