#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include <google/protobuf/message_lite.h>

#include "access/key_ring.h"
#include "bus/bus_counts.h"
#include "bus/pose_input.h"
#include "bus/transport.h"
#include "bus/zenoh/tensormass_zenoh.h"
#include "core/bus_limits.h"
#include "core/result.h"

namespace tensormass::bus {

struct BusOptions {
  /// <server> in the keys; must be a valid name (core/names.h).
  std::string server;
  /// ZeroMQ's two endpoints, as in ZeroMqOptions. Give both, or leave both empty to turn ZeroMQ off.
  std::string zeromq_publish_endpoint;
  std::string zeromq_pose_endpoint;
  /// zenoh's address, as in ZenohOptions. Empty turns zenoh off.
  std::string zenoh_listen;
  std::uint32_t zenoh_sessions = limits::kDefaultZenohSessions;
  /// Who may connect, subscribe and put; must outlive the bus. nullptr: everybody, in plain text.
  const access::KeyRing* keys = nullptr;
  /// Called for each valid pose, from threads of the transports; must not block.
  PoseHandler on_pose = [](auto&&...) {};
  /// Called for each refused message and client, from threads of the transports; must not block.
  MalformedHandler on_malformed = [](auto&&...) {};
  /// Called with each warning or error of zenoh, from any thread. zenoh has one log per process, so only the first bus
  /// of the process receives its lines. who: the client that was disconnected for the reason in `message`; empty: a
  /// line of zenoh's own.
  std::function<void(bool is_error, std::string_view who, std::string_view message)> on_log = [](auto&&...) {};
};

/// The addresses that clients connect to, with the ports that were chosen. Empty: the transport is off.
struct Endpoints {
  std::string zeromq_publish;
  std::string zeromq_pose;
  std::string zenoh_locator;
};

/// The data plane: streams to clients, poses from clients, over every transport that is turned on.
///
///     any thread                                                 clients
///     publish(key, message) ─ serialize once ─┬─ ZeroMQ ───────> subscribers
///                                             └─ zenoh ────────> subscribers     a full queue drops the message
///
///     transports' threads
///     on_pose, or on_malformed and a count <── PoseInput <─┬─ ZeroMQ <── poses
///                                                          └─ zenoh <─── poses
///
/// Clients may use either transport, because both carry the same keys and the same protobuf bytes. Nothing here waits
/// for a client.
class Bus {
 public:
  /// Opens every transport that `options` turns on; handlers may be called before it returns.
  /// Fails with kInvalidArgument for an invalid server name or only one of ZeroMQ's endpoints, and with kUnavailable
  /// for an endpoint that cannot be listened on.
  static Result<std::unique_ptr<Bus>> open(const BusOptions& options);
  /// Closes the transports. `on_pose` and `on_malformed` do not run after it returns; `on_log` may.
  ~Bus();

  /// Sends `content` under `key` on every transport. Any thread may call it; it never waits for a reader.
  void publish(std::string_view key, const google::protobuf::MessageLite& content, PublishOptions options = {});
  /// Drops the retained message of `key` on every transport. Any thread may call it.
  void forget(std::string_view key);

  /// Cuts clients whose keys do not count any more. The key ring calls it (access::KeyRing::follow), and again while it
  /// returns false.
  bool keys_changed();

  const Endpoints& endpoints() const { return endpoints_; }
  /// Refused messages, plus connections whose peer did not speak the transport's protocol, since this bus was opened.
  /// zenoh counts its failed handshakes per process, so with two buses both count them.
  std::uint64_t malformed_count() const;
  /// Messages that were dropped and refused since this bus was opened. zenoh counts refusals per process, as failed
  /// handshakes.
  BusCounts counts() const;

 private:
  explicit Bus(const BusOptions& options);

  BusCounters counters_;
  PoseInput input_;
  std::uint64_t failed_handshakes_before_;
  tensormass_zenoh_refusals refused_before_;
  Endpoints endpoints_;
  // The last member, so that it is destroyed first: the transports call `input_` until they are gone.
  std::vector<std::unique_ptr<Transport>> transports_;
};

}  // namespace tensormass::bus
