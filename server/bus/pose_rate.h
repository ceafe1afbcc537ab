#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <unordered_map>

#include "core/bus_limits.h"

namespace tensormass::bus {

/// Bounds the poses of each client: limits::kMaxPosesPerSecond and kMaxPoseBytesPerSecond, and as much at once after a
/// second without any. A client that sends on and on beyond them floods.
///
///   cost       time that a message takes from its client's rates
///   full_at    when the client may send a second's worth at once again; each message that is taken moves it by its
///   cost quiet_at   when all that it sent, dropped messages too, is within the rates; limits::kMaxPoseLeadS ahead: a
///   flood
///
/// Any thread may call it. It waits for nothing but another call.
class PoseRate {
 public:
  using Time = std::chrono::steady_clock::time_point;
  enum class Verdict {
    kTaken,
    kDropped,
    kDroppedAndTold,  ///< dropped, and the first one of the client within a second
    kFlood,           ///< dropped, and the client's connection must end
    kFloodAndTold,    ///< the same, and the first one of the client within a second
  };

  /// bytes: of the message, with its key.
  Verdict take(std::uint64_t client, std::size_t bytes, Time now) {
    const std::lock_guard lock(mutex_);
    const bool added = clients_.try_emplace(client, Client{now, now}).second;
    if (added && clients_.size() > kClientsBeforeCleanUp) drop_idle(client, now);
    Client& sender = clients_.at(client);
    const std::chrono::nanoseconds cost = std::max(kCost, cost_of(bytes));
    sender.full_at = std::max(sender.full_at, now);
    sender.quiet_at = std::max(sender.quiet_at, now);
    const auto is_told = [now](Time& tell_at) {
      if (now < tell_at) return false;
      tell_at = now + std::chrono::seconds(1);
      return true;
    };
    if (sender.quiet_at - now + cost > kMaxLead) {
      return is_told(sender.tell_flood_at) ? Verdict::kFloodAndTold : Verdict::kFlood;
    }
    sender.quiet_at += cost;
    if (sender.full_at - now + cost > kBurst) {
      return is_told(sender.tell_at) ? Verdict::kDroppedAndTold : Verdict::kDropped;
    }
    sender.full_at += cost;
    return Verdict::kTaken;
  }
  /// Forgets a client whose number another one may get.
  void forget(std::uint64_t client) {
    const std::lock_guard lock(mutex_);
    clients_.erase(client);
  }
  std::size_t client_count() const { return clients_.size(); }

 private:
  static constexpr std::chrono::nanoseconds kBurst = std::chrono::seconds(1);
  static constexpr std::chrono::nanoseconds kCost = kBurst / limits::kMaxPosesPerSecond;
  static constexpr std::chrono::nanoseconds kMaxLead{static_cast<std::int64_t>(1e9 * limits::kMaxPoseLeadS)};
  static constexpr std::size_t kClientsBeforeCleanUp = 1024;

  struct Client {
    Time full_at, quiet_at;
    Time tell_at{}, tell_flood_at{};  // when a drop, and a flood, is told again
  };

  static constexpr std::chrono::nanoseconds cost_of(std::size_t bytes) {
    return std::chrono::nanoseconds(bytes * std::uint64_t{kBurst.count()} / limits::kMaxPoseBytesPerSecond);
  }
  /// Forgets the clients that may send everything, because a new one may as well.
  void drop_idle(std::uint64_t but, Time now) {
    std::erase_if(clients_, [&](const auto& each) { return each.first != but && each.second.quiet_at <= now; });
  }

  std::mutex mutex_;
  std::unordered_map<std::uint64_t, Client> clients_;  // as many as sent within the last kMaxPoseLeadS
};

}  // namespace tensormass::bus
