#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <unordered_map>

#include "core/bus_limits.h"

namespace tensormass::bus {

/// Bounds the poses of each client: limits::kMaxPosesPerSecond, and as many at once after a second without any.
///
/// Any thread may call it. It waits for nothing but another call.
class PoseRate {
 public:
  using Time = std::chrono::steady_clock::time_point;
  enum class Verdict {
    kTaken,
    kDropped,
    kDroppedAndTold,  ///< dropped, and the first one of the client within a second
  };

  Verdict take(std::uint64_t client, Time now) {
    const std::lock_guard lock(mutex_);
    const bool added = clients_.try_emplace(client, Client{now}).second;
    if (added && clients_.size() > kClientsBeforeCleanUp) drop_idle(client, now);
    Client& sender = clients_.at(client);
    sender.full_at = std::max(sender.full_at, now);
    if (sender.full_at - now + kCost > kBurst) {
      if (now < sender.tell_at) return Verdict::kDropped;
      sender.tell_at = now + std::chrono::seconds(1);
      return Verdict::kDroppedAndTold;
    }
    sender.full_at += kCost;
    return Verdict::kTaken;
  }
  std::size_t client_count() const { return clients_.size(); }

 private:
  static constexpr std::chrono::nanoseconds kBurst = std::chrono::seconds(1);
  static constexpr std::chrono::nanoseconds kCost = kBurst / limits::kMaxPosesPerSecond;
  static constexpr std::size_t kClientsBeforeCleanUp = 1024;

  struct Client {
    Time full_at;    // when it may send kBurst at once again; each pose moves it by kCost
    Time tell_at{};  // when a drop is told again
  };

  /// Forgets the clients that may send everything, because a new one may as well.
  void drop_idle(std::uint64_t but, Time now) {
    std::erase_if(clients_, [&](const auto& each) { return each.first != but && each.second.full_at <= now; });
  }

  std::mutex mutex_;
  std::unordered_map<std::uint64_t, Client> clients_;  // as many as sent within the last second
};

}  // namespace tensormass::bus
