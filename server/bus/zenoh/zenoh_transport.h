#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <string_view>

#include "bus/pose_input.h"
#include "bus/transport.h"
#include "bus/zenoh/session.h"
#include "core/bus_limits.h"
#include "core/result.h"

namespace tensormass::bus {

struct ZenohOptions {
  /// <server> in the keys.
  std::string server;
  /// The address to listen on, "tcp/127.0.0.1:7447"; port 0 takes a free one.
  std::string listen;
  /// Clients connected at once; a further one is refused.
  std::uint32_t max_sessions = limits::kDefaultZenohSessions;
};

/// Streams and poses over zenoh, under the same keys and with the same protobuf bytes as over ZeroMQ.
///
/// Clients may put poses and nothing else, and see neither each other's poses nor each other's answers: zenoh's access
/// control refuses the rest, whatever address the client comes from. A late joiner asks for a retained message with
/// zenoh's `get` of its key. Poses arrive on zenoh's threads, which call `input` directly. session.h says what is
/// dropped and who waits.
class ZenohTransport final : public Transport {
 public:
  /// `input` must outlive the transport. Fails with kUnavailable if `listen` cannot be listened on.
  static Result<std::unique_ptr<ZenohTransport>> open(const ZenohOptions& options, PoseInput& input);

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;

  /// The address that clients connect to, with the port that was chosen.
  const std::string& locator() const { return locator_; }

 private:
  explicit ZenohTransport(zenoh::Session session) : session_(std::move(session)), locator_(session_.locator()) {}

  zenoh::Session session_;
  std::string locator_;
  // After `session_`, because a subscriber must be destroyed before its session.
  zenoh::Subscriber poses_;
};

}  // namespace tensormass::bus
