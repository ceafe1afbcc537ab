#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <zmq.hpp>

#include "bus/keys.h"
#include "core/bus_limits.h"

namespace tensormass::bus {

/// Which peer of the publish socket subscribed to what, and whether it may.
///
/// A peer may subscribe to exact keys of this server's streams, each with its zero byte, and to
/// limits::kMaxSubscriptionsPerPeer of them at once; with keys, all peers of a key to kMaxSubscriptionsPerKey. ZeroMQ
/// itself stores every prefix that any peer asks for, and sends everything to a peer that asks for the empty one.
///
/// ZeroMQ's XPUB_MANUAL would refuse single subscriptions. It is not used: up to version 4.3.4, that of Debian 12, the
/// socket then keeps a pointer to a connection that may have ended (fixed upstream by "XPUB socket allows manual
/// subscription on terminated pipe"), and the memory of a refused subscription stays until its connection ends. So a
/// peer that breaks a rule is disconnected instead.
///
/// One thread at a time may use an object.
class Subscribers {
 public:
  using Time = std::chrono::steady_clock::time_point;

  /// The connection that a request came from.
  struct Connection {
    /// The same for all requests of a connection, and for those of no other connection whose requests are kept.
    const void* id;
    int descriptor;
    /// Id of the client, with keys.
    std::string_view client = {};
  };
  enum class Verdict {
    kAccepted,
    kIgnored,   ///< it comes from a peer that was refused, or is gone
    kWrongKey,  ///< not an exact key of a stream of this server
    kTooMany,
    kTooManyOfKey,  ///< all connections of its client together have the bound
  };

  /// `server`: the <server> that keys must name.
  explicit Subscribers(std::string server) : server_(std::move(server)) {}

  /// Notes a subscription to the prefix `subscription`, which came in `request`. A peer that is refused, by kWrongKey,
  /// kTooMany or kTooManyOfKey, must be disconnected. kIgnored is the answer to what it sent before that.
  Verdict subscribe(const Connection& from, zmq::message_t& request, std::string_view subscription) {
    Peer& peer = find_or_add(from, request);
    if (peer.refused || peer.gone) return Verdict::kIgnored;
    const bool exact =
        subscription.ends_with('\0') && is_stream_key(server_, subscription.substr(0, subscription.size() - 1));
    if (exact && peer.subscriptions.contains(subscription)) return Verdict::kAccepted;
    const bool too_many = peer.subscriptions.size() >= limits::kMaxSubscriptionsPerPeer;
    const bool too_many_of_key =
        !from.client.empty() && subscriptions_of(from.client) >= limits::kMaxSubscriptionsPerKey;
    if (exact && !too_many && !too_many_of_key) {
      peer.subscriptions.emplace(subscription);
      return Verdict::kAccepted;
    }
    peer.subscriptions.clear();
    peer.refused = true;
    return !exact ? Verdict::kWrongKey : too_many ? Verdict::kTooMany : Verdict::kTooManyOfKey;
  }
  void unsubscribe(const Connection& from, std::string_view subscription) {
    const auto found = peers_.find(from.id);
    if (found == peers_.end()) return;
    auto& subscriptions = found->second.subscriptions;
    if (const auto ended = subscriptions.find(subscription); ended != subscriptions.end()) subscriptions.erase(ended);
  }
  /// Refuses a peer that sent something else than a subscription. Returns false if it was refused before, or is gone.
  bool refuse(const Connection& from, zmq::message_t& request) {
    Peer& peer = find_or_add(from, request);
    peer.subscriptions.clear();
    return !std::exchange(peer.refused, true) && !peer.gone;
  }
  /// A connection began or ended under this descriptor. What an earlier one sent may still come for a while.
  void forget(int descriptor, Time now) {
    const auto found = by_descriptor_.find(descriptor);
    if (found == by_descriptor_.end()) return;
    leave(peers_.at(found->second), now);
    by_descriptor_.erase(found);
  }
  /// Drops the peers that are gone for kLeftover.
  void clean_up(Time now) {
    if (!clean_after_ || now < *clean_after_) return;
    clean_after_.reset();
    std::erase_if(peers_, [now](const auto& peer) { return peer.second.gone && *peer.second.gone + kLeftover <= now; });
    for (const auto& [id, peer] : peers_) {
      if (peer.gone) clean_after_ = now + kLeftover;
    }
  }
  /// Refuses the peers whose client does not count any more, or may not have one of its subscriptions any more. Returns
  /// them; their clients' ids live as long as the peers do.
  /// counts: bool(std::string_view client)
  /// may: bool(std::string_view client, std::string_view subscription), the subscription with its zero byte
  template <class Counts, class May>
  std::vector<Connection> refuse_removed(const Counts& counts, const May& may) {
    std::vector<Connection> refused;
    for (const auto& [descriptor, id] : by_descriptor_) {
      Peer& peer = peers_.at(id);
      const auto may_have = [&](const std::string& subscription) { return may(peer.client, subscription); };
      if (peer.refused ||
          (counts(peer.client) && std::all_of(peer.subscriptions.begin(), peer.subscriptions.end(), may_have))) {
        continue;
      }
      peer.subscriptions.clear();
      peer.refused = true;
      refused.push_back({id, descriptor, peer.client});
    }
    return refused;
  }
  std::size_t peer_count() const { return peers_.size(); }

 private:
  /// Time after which nothing comes any more from a connection that ended.
  static constexpr std::chrono::seconds kLeftover{1};

  struct Peer {
    // ZeroMQ frees the memory whose place is the id when the last request of a connection is gone. With one of them
    // kept, no other connection gets the id.
    zmq::message_t kept;
    std::set<std::string, std::less<>> subscriptions;
    std::string client;
    bool refused = false;
    std::optional<Time> gone;
  };

  Peer& find_or_add(const Connection& from, zmq::message_t& request) {
    const auto [found, added] = peers_.try_emplace(from.id);
    if (added) {
      found->second.kept.copy(request);
      found->second.client = from.client;
      by_descriptor_.insert_or_assign(from.descriptor, from.id);
    }
    return found->second;
  }
  std::size_t subscriptions_of(std::string_view client) const {
    std::size_t count = 0;
    for (const auto& [id, peer] : peers_) {
      if (peer.client == client) count += peer.subscriptions.size();
    }
    return count;
  }
  void leave(Peer& peer, Time now) {
    peer.subscriptions.clear();
    peer.gone = now;
    if (!clean_after_) clean_after_ = now + kLeftover;
  }

  const std::string server_;
  std::map<const void*, Peer> peers_;
  std::map<int, const void*> by_descriptor_;
  std::optional<Time> clean_after_;
};

}  // namespace tensormass::bus
