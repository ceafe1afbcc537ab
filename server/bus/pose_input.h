#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

#include "tensormass/v1/stream.pb.h"

namespace tensormass::bus {

/// Called from transports' threads, several at once; must not block.
using PoseHandler = std::function<void(std::string_view scene, std::string_view tool, const v1::ToolPose& pose)>;
/// `scene` is empty where the message does not even say which.
using MalformedHandler = std::function<void(std::string_view scene, std::string_view reason)>;

/// The one door for what clients send: whatever the transport, a message is read here, or refused and counted.
class PoseInput {
 public:
  PoseInput(std::string server, PoseHandler on_pose, MalformedHandler on_malformed);

  void receive(std::string_view key, std::string_view payload);
  /// `key`, zero byte, `payload`, as on ZeroMQ.
  void receive_framed(std::string_view bytes);
  void refuse(std::string_view scene, std::string_view reason);
  std::uint64_t malformed_count() const { return malformed_.load(std::memory_order_relaxed); }

 private:
  std::string server_;
  PoseHandler on_pose_;
  MalformedHandler on_malformed_;
  std::atomic<std::uint64_t> malformed_{0};
};

}  // namespace tensormass::bus
