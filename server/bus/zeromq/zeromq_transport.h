#pragma once

#include <atomic>
#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>

#include <zmq.hpp>

#include "bus/bus_counts.h"
#include "bus/pose_input.h"
#include "bus/transport.h"
#include "bus/zeromq/connections.h"
#include "bus/zeromq/handshake_counter.h"
#include "bus/zeromq/subscribers.h"
#include "core/result.h"

namespace tensormass::bus {

struct ZeroMqOptions {
  /// <server> in the keys.
  std::string server;
  /// Addresses to listen on: "tcp://127.0.0.1:5556"; "tcp://127.0.0.1:*" takes a free port; a socket file is
  /// "ipc:///run/user/1000/tensormass".
  std::string publish_endpoint;
  std::string pose_endpoint;
  /// Who may connect, subscribe and push; must outlive the transport. nullptr: everybody, in plain text.
  const access::KeyRing* keys = nullptr;
};

/// Streams to clients and poses from clients over ZeroMQ, on one socket each.
///
///     any publishing thread                receiver thread (one, sleeps in poll)
///     publish() ──lock──> XPUB socket <──lock── serve_subscriptions()
///                             ├─ a queue of kSendQueue messages per subscriber ──> SUB sockets of clients
///                             │  (a full queue drops the message)
///                             ├─ retained_: the newest message of each retained key
///                             └─ subscribers_: what each peer subscribed to; a peer that may not is disconnected
///
///     receiver thread, too:
///     PUSH sockets of clients ──> PULL socket ──> receive_poses() ──> PoseInput
///     monitors of both sockets ──> read_events() ──> PoseInput::refuse; a connection too many ends
///     authenticator_, with keys: ZeroMQ asks by ZAP whether a CURVE key is let in ──> authenticate()
///     wake_event_ ──> a repetition of a retained message is due later, requests are left, or the thread must end
///
/// Four choices, each with its reason:
///
/// 1. XPUB instead of PUB, because it reports each subscription. The transport then repeats the retained message of
/// that
///    key, so a late joiner gets the topology and the status. All subscribers of the key get it, so a key is repeated
///    at most once in kRetainedPeriodS: who joins in between waits for the rest of it.
/// 2. One mutex around the XPUB socket and its monitor, because only one thread at a time may use a ZeroMQ socket. Its
///    holders send and receive with `dontwait`, so nobody holds it while waiting. Only the receiver thread uses the
///    others.
/// 3. Poses are not dropped here. The receiver thread reads every pose, and the scene's inbox keeps the newest.
/// 4. Peers must speak ZMTP 3, which every ZeroMQ since 4.0 does. ZeroMQ does not say which peer of an older protocol a
///    subscription comes from.
class ZeroMqTransport final : public Transport {
 public:
  /// `input` and `counters` must outlive the transport. Fails with kUnavailable and names the endpoint that it cannot
  /// listen on.
  static Result<std::unique_ptr<ZeroMqTransport>> open(const ZeroMqOptions& options, PoseInput& input,
                                                       BusCounters& counters);
  /// Joins the receiver thread, then waits at most kLingerMs for the last messages to leave.
  ~ZeroMqTransport() override;

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;
  bool keys_changed() override;

  /// The addresses that clients connect to, with the ports that were chosen.
  const std::string& publish_endpoint() const { return publish_endpoint_; }
  const std::string& pose_endpoint() const { return pose_endpoint_; }

 private:
  /// The events that ZeroMQ reports about one socket's connections, and the failures counted from them.
  struct Monitor {
    Monitor(zmq::context_t& context, zmq::socket_t& socket, const std::string& name);
    zmq::socket_t events;
    HandshakeCounter handshakes;
    Connections connections{limits::kMaxZeroMqConnections};
  };

  struct Retained {
    MessagePtr message;
    std::chrono::steady_clock::time_point repeat_after{};
    bool wanted = false;  // somebody joined since it was last repeated
  };

  ZeroMqTransport(const ZeroMqOptions& options, PoseInput& input, BusCounters& counters);
  /// Runs on the receiver thread until stopping_.
  void receive_loop();
  /// Answers ZeroMQ's questions whether a client is let in (ZAP, rfc.zeromq.org/spec/27).
  void authenticate();
  /// Disconnects subscribers whose keys do not count any more, or do not allow what they subscribed to. The caller must
  /// hold mutex_.
  void cut_removed();
  /// Whether a client may subscribe to a key.
  bool may_subscribe(std::string_view client, std::string_view key) const;
  /// Passes at most kPosesPerTurn poses to `input_`.
  void receive_poses();
  /// Reads the monitor's events, refuses each peer that failed the handshake, and ends connections beyond the limit.
  void read_events(Monitor& monitor);
  /// Notes a connection to `endpoint`, and ends one if there are too many.
  void end_one_too_many(Monitor& monitor, int descriptor, const std::string& endpoint);
  /// Reads at most kRequestsPerTurn requests of the XPUB socket, disconnects peers that may not subscribe, and repeats
  /// the retained messages that are wanted and due. The caller must hold mutex_.
  void serve_subscriptions();
  /// Takes one request. The caller must hold mutex_.
  void serve_request(zmq::message_t& request);
  /// Sends each retained message that is wanted and due, to every subscriber of its key: XPUB cannot address one. The
  /// caller must hold mutex_.
  void repeat_retained();
  /// Counts a subscriber as malformed and closes its connection. The caller must hold mutex_.
  void disconnect(const Subscribers::Connection& subscriber, std::string_view scene, std::string_view reason);
  /// Returns how long the receiver thread may sleep; a negative time: until something happens.
  std::chrono::milliseconds sleep_time();
  /// Ends the sleep of the receiver thread, once for each sleep. The caller must hold mutex_.
  void wake_receiver();
  /// Sends without waiting and without copying, and counts a full queue. The caller must hold mutex_.
  void send(const MessagePtr& message);

  PoseInput& input_;
  BusCounters& counters_;
  const access::KeyRing* const keys_;
  const std::string server_;
  zmq::context_t context_{1};
  std::mutex mutex_;
  // Guarded by mutex_.
  zmq::socket_t publisher_;
  Monitor publisher_monitor_;
  Subscribers subscribers_;
  std::map<std::string, Retained, std::less<>> retained_;  // by key
  bool has_requests_ = false;                              // a turn ended before all requests were read
  std::optional<std::chrono::steady_clock::time_point> next_repeat_;
  bool receiver_woken_ = false;
  // Receiver thread only.
  std::optional<zmq::socket_t> authenticator_;
  zmq::socket_t poses_;
  Monitor poses_monitor_;

  std::string publish_endpoint_;
  std::string pose_endpoint_;
  int wake_event_ = -1;  // eventfd
  std::atomic<bool> stopping_{false}, keys_changed_{false};
  std::thread receiver_;
};

}  // namespace tensormass::bus
