#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

#include "access/key_ring.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::bus {

/// Receives a parsed pose. Transports call it from several threads at once; it must not block.
using PoseHandler = std::function<void(std::string_view scene, std::string_view tool, const v1::ToolPose& pose)>;
/// Receives the reason for each refused message, under the same conditions. `scene` is empty if the message does not
/// name a scene of this server in a valid key.
using MalformedHandler = std::function<void(std::string_view scene, std::string_view reason)>;

/// Parses every message that clients send on the data plane, whatever the transport. Each message becomes exactly one
/// call: `on_pose` with a pose, or `on_malformed` with a reason, which also adds one to `malformed_count`.
///
/// PoseInput checks the key, the size and the protobuf. It does not check numbers or names: the scene's pose inbox
/// refuses a pose that is not finite, and knows which tools exist.
///
/// All methods may be called from any thread.
class PoseInput {
 public:
  /// `server`: the <server> that keys must name. keys: say which tool a client may move (access/rules.h); nullptr:
  /// everybody may move every tool.
  PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed,
            const access::KeyRing* keys = nullptr);

  /// Parses one message whose transport carries the key separately (zenoh).
  void receive(std::string_view key, std::string_view payload);
  /// Parses one message of the form key, zero byte, payload (ZeroMQ). sender: id of the client that sent it, if keys
  /// say who that is. zenoh asks the same rules before a message comes here.
  void receive_framed(std::string_view bytes, std::string_view sender = {});
  /// Counts and reports a message that the transport itself could not accept.
  void refuse(std::string_view scene, std::string_view reason);
  /// Messages refused so far.
  std::uint64_t malformed_count() const { return malformed_.load(std::memory_order_relaxed); }

 private:
  bool may_move(std::string_view sender, std::string_view key);

  std::string server_;
  PoseHandler on_pose_;
  MalformedHandler on_malformed_;
  const access::KeyRing* const keys_;
  std::atomic<std::uint64_t> malformed_{0};
};

}  // namespace tensormass::bus
