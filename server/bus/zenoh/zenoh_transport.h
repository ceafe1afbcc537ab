#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <shared_mutex>
#include <string>
#include <string_view>

#include "bus/bus_counts.h"
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
  /// Who may connect, subscribe and put; must outlive the transport. nullptr: everybody, in plain text.
  const access::KeyRing* keys = nullptr;
};

/// Streams and poses over zenoh, under the same keys and with the same protobuf bytes as over ZeroMQ.
///
/// Clients may put poses and nothing else, and see neither each other's poses nor each other's answers: zenoh's access
/// control refuses the rest, whatever address the client comes from. A late joiner asks for a retained message with
/// zenoh's `get` of its key. Poses arrive on zenoh's threads, which call `input` directly. session.h says what is
/// dropped and who waits.
///
/// With keys, zenoh speaks TLS, and its access control is the table of access/rules.h (access_control.h). zenoh reads
/// its rules once, when a session opens. When other clients count, the session is therefore closed and opened again at
/// its address. Clients connect again by themselves.
class ZenohTransport final : public Transport {
 public:
  /// `input` and `counters` must outlive the transport. Fails with kUnavailable if `listen` cannot be listened on.
  static Result<std::unique_ptr<ZenohTransport>> open(const ZenohOptions& options, PoseInput& input,
                                                      BusCounters& counters);

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;
  /// Opens the session again if the rules are others now. Tries once, and returns false if there is no session then.
  /// Called on one thread.
  bool keys_changed() override;

  /// The address that clients connect to, with the port that was chosen.
  const std::string& locator() const { return locator_; }

 private:
  ZenohTransport(ZenohOptions options, PoseInput& input, BusCounters& counters);
  Result<void> open_session();
  void put(const MessagePtr& message, PublishOptions options);

  ZenohOptions options_;
  PoseInput& input_;
  BusCounters& counters_;
  std::string locator_;
  std::string access_control_;
  bool told_off_ = false;  // the log says that there is no session
  // With keys only: the messages that a new session must retain, and who may open one. Lock them in this order.
  std::mutex retained_mutex_;
  std::map<std::string, MessagePtr, std::less<>> retained_;
  std::shared_mutex session_mutex_;
  std::optional<zenoh::Session> session_;
  // After `session_`, because a subscriber must be destroyed before its session.
  zenoh::Subscriber poses_;
};

}  // namespace tensormass::bus
