#pragma once

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

#include "access/key_ring.h"
#include "bus/bus_counts.h"
#include "bus/pose_rate.h"
#include "core/journal.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::bus {

/// Who sent a message.
struct Sender {
  Carrier carrier = Carrier::kZeroMq;
  /// The same for all that share a rate: a connection, or with keys all connections of a key.
  std::uint64_t number = 0;
  /// Id of the client, if keys say who that is and the transport has not asked the rules yet (ZeroMQ).
  std::string_view client = {};
  /// The connection's descriptor (ZeroMQ); -1: not known.
  int descriptor = -1;

  /// The client's id or its address, for the log. zenoh tells it only on the thread that handles the message.
  std::string who() const;
};

/// Receives a parsed pose. Transports call it from several threads at once; it must not block.
using PoseHandler =
    std::function<void(std::string_view scene, std::string_view tool, const v1::ToolPose& pose, const Sender& sender)>;
/// Receives what was refused, under the same conditions. `scene` is empty if the message does not name a scene of this
/// server in a valid key.
using MalformedHandler = std::function<void(const Refused&)>;

/// Parses every message that clients send on the data plane, whatever the transport. Each message becomes exactly one
/// call: `on_pose` with a pose, or `on_malformed` with a reason, which also adds one to `malformed_count`. What a
/// client sends beyond its rate is dropped unread, and only the first one is told to `on_malformed`. A client that goes
/// on floods (pose_rate.h), and its transport must end its connection.
///
/// PoseInput checks the key, the size and the protobuf. It does not check numbers or names: the scene's pose inbox
/// refuses a pose that is not finite, and knows which tools exist.
///
/// All methods may be called from any thread.
class PoseInput {
 public:
  /// `server`: the <server> that keys must name. keys: say which tool a client may move (access/rules.h); nullptr:
  /// everybody may move every tool. counters: count refusals; must outlive this.
  PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed, BusCounters& counters,
            const access::KeyRing* keys = nullptr);

  /// Parses one message whose transport carries the key separately (zenoh). Returns false if the sender floods.
  bool receive(std::string_view key, std::string_view payload, const Sender& sender = {});
  /// Parses one message of the form key, zero byte, payload (ZeroMQ). zenoh asks the same rules before a message comes
  /// here. Returns false if the sender floods.
  bool receive_framed(std::string_view bytes, const Sender& sender = {});
  /// Refuses one message of several frames, `bytes` in all (ZeroMQ). Returns false if the sender floods.
  bool refuse_frames(std::size_t bytes, const Sender& sender);
  /// Another client has this sender's number from now on.
  void forget(const Sender& sender);
  /// Counts and reports a message that the transport itself could not accept.
  void refuse(const Refused& refused);
  /// Messages refused so far.
  std::uint64_t malformed_count() const { return malformed_.load(std::memory_order_relaxed); }

 private:
  enum class Rate { kWithin, kBeyond, kFlood };
  Rate count(std::size_t bytes, const Sender& sender);
  PoseRate& rate_of(const Sender& sender) { return rates_[static_cast<std::size_t>(sender.carrier)]; }
  bool may_move(const Sender& sender, std::string_view key);
  void parse_framed(std::string_view bytes, const Sender& sender);
  void parse(std::string_view key, std::string_view payload, const Sender& sender);
  /// Refuses a pose.
  void refuse_of(const Sender& sender, std::string_view scene, std::string_view reason);

  std::string server_;
  PoseHandler on_pose_;
  MalformedHandler on_malformed_;
  BusCounters& counters_;
  const access::KeyRing* const keys_;
  std::array<PoseRate, kCarrierNames.size()> rates_;
  std::atomic<std::uint64_t> malformed_{0};
};

}  // namespace tensormass::bus
