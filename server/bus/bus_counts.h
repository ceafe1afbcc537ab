#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <string_view>

namespace tensormass::bus {

enum class Carrier : std::uint8_t { kZeroMq, kZenoh };
inline constexpr std::array<std::string_view, 2> kCarrierNames{"zeromq", "zenoh"};

/// The ends of the keys of streams.
inline constexpr std::array<std::string_view, 6> kStreamNames{"topology", "frame",   "status",
                                                              "feedback", "changes", "events"};

/// Why a transport refuses what a client sends.
enum class Refusal : std::uint8_t {
  kAccess,         ///< the client may not send it: its key does not allow it, or nobody may (zenoh)
  kMessageSize,    ///< limits::kMaxPoseMessageBytes, kMaxZenohMessageBytes
  kSubscriptions,  ///< limits::kMaxSubscriptionsPerPeer, kMaxSubscriptionsPerKey, kMaxZenohDeclarations, kMaxZenohKeys,
                   ///< kMaxZenohRequestsAtOnce
  kPoseRate,       ///< limits::kMaxPosesPerSecond
  kConnections,    ///< limits::kMaxZeroMqConnections
};
inline constexpr std::array<std::string_view, 5> kRefusalNames{"access", "message_size", "subscriptions", "pose_rate",
                                                               "connections"};

/// What the data plane dropped and refused since it was opened, for metrics (docs/metrics.md).
struct BusCounts {
  template <std::size_t kCount>
  using OfEachCarrier = std::array<std::array<std::uint64_t, kCount>, kCarrierNames.size()>;
  /// [Carrier][kStreamNames] messages that found the queue to a client full. The client loses this one, and those after
  /// it until it reads again; neither ZeroMQ nor zenoh tells of them.
  OfEachCarrier<kStreamNames.size()> full_queues{};
  OfEachCarrier<kRefusalNames.size()> refusals{};  ///< [Carrier][Refusal]
};

/// Counts for BusCounts. Any thread counts and reads; nobody waits.
class BusCounters {
 public:
  void count_full_queues(Carrier carrier, std::string_view key, std::uint64_t more) {
    for (std::size_t stream = 0; stream < kStreamNames.size(); ++stream) {
      if (key.ends_with(kStreamNames[stream])) add(full_queues_[index(carrier)][stream], more);
    }
  }
  void count_refusal(Carrier carrier, Refusal refusal) {
    add(refusals_[index(carrier)][static_cast<std::size_t>(refusal)], 1);
  }
  BusCounts read() const {
    BusCounts out;
    for (std::size_t carrier = 0; carrier < kCarrierNames.size(); ++carrier) {
      for (std::size_t i = 0; i < kStreamNames.size(); ++i)
        out.full_queues[carrier][i] = full_queues_[carrier][i].load(std::memory_order_relaxed);
      for (std::size_t i = 0; i < kRefusalNames.size(); ++i)
        out.refusals[carrier][i] = refusals_[carrier][i].load(std::memory_order_relaxed);
    }
    return out;
  }

 private:
  static std::size_t index(Carrier carrier) { return static_cast<std::size_t>(carrier); }
  static void add(std::atomic<std::uint64_t>& count, std::uint64_t more) {
    count.fetch_add(more, std::memory_order_relaxed);
  }

  template <std::size_t kCount>
  using Counters = std::array<std::array<std::atomic<std::uint64_t>, kCount>, kCarrierNames.size()>;
  Counters<kStreamNames.size()> full_queues_{};
  Counters<kRefusalNames.size()> refusals_{};
};

}  // namespace tensormass::bus
