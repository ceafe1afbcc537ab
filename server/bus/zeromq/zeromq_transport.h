#pragma once

#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <thread>

#include <zmq.hpp>

#include "bus/pose_input.h"
#include "bus/transport.h"
#include "bus/zeromq/handshake_counter.h"
#include "core/result.h"

namespace tensormass::bus {

struct ZeroMqOptions {
  /// Addresses to listen on: "tcp://127.0.0.1:5556"; "tcp://127.0.0.1:*" takes a free port; a socket file is
  /// "ipc:///run/user/1000/tensormass".
  std::string publish_endpoint;
  std::string pose_endpoint;
};

/// Streams to clients and poses from clients over ZeroMQ, on one socket each.
///
///     any publishing thread                receiver thread (one, sleeps in poll)
///     publish() ──lock──> XPUB socket <──lock── serve_subscriptions()
///                             ├─ a queue of kSendQueue messages per subscriber ──> SUB sockets of clients
///                             │  (a full queue drops the message)
///                             └─ retained_: the newest message of each retained key
///
///     receiver thread, too:
///     PUSH sockets of clients ──> PULL socket ──> receive_poses() ──> PoseInput
///     monitors of both sockets ──> count_handshakes() ──> PoseInput::refuse
///     destructor ──> stop_event_ ──> the thread ends
///
/// Three choices, each with its reason:
///
/// 1. XPUB instead of PUB, because it reports each subscription. The transport then sends the retained messages under
///    that prefix again, so a late joiner gets the topology and the status.
/// 2. One mutex around the XPUB socket, because only one thread at a time may use a ZeroMQ socket. Its holders send and
///    receive with `dontwait`, so nobody holds it while waiting. Only the receiver thread uses the other sockets.
/// 3. Poses are not dropped here. The receiver thread reads every pose, and the scene's inbox keeps the newest.
class ZeroMqTransport final : public Transport {
 public:
  /// `input` must outlive the transport. Fails with kUnavailable and names the endpoint that it cannot listen on.
  static Result<std::unique_ptr<ZeroMqTransport>> open(const ZeroMqOptions& options, PoseInput& input);
  /// Joins the receiver thread, then waits at most kLingerMs for the last messages to leave.
  ~ZeroMqTransport() override;

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;

  /// The addresses that clients connect to, with the ports that were chosen.
  const std::string& publish_endpoint() const { return publish_endpoint_; }
  const std::string& pose_endpoint() const { return pose_endpoint_; }

 private:
  /// The events that ZeroMQ reports about one socket's connections, and the failures counted from them.
  struct Monitor {
    Monitor(zmq::context_t& context, zmq::socket_t& socket, const std::string& name);
    zmq::socket_t events;
    HandshakeCounter handshakes;
  };

  explicit ZeroMqTransport(PoseInput& input);
  /// Runs on the receiver thread until stop_event_ is written.
  void receive_loop();
  /// Passes at most kPosesPerTurn poses to `input_`.
  void receive_poses();
  /// Reads the monitor's events and refuses each peer that failed the handshake.
  void count_handshakes(Monitor& monitor);
  /// Sends the retained messages that match new subscriptions, to every subscriber of their keys: XPUB cannot address
  /// one. The caller must hold mutex_.
  void serve_subscriptions();
  /// Sends without waiting and without copying. The caller must hold mutex_.
  void send(const MessagePtr& message);

  PoseInput& input_;
  zmq::context_t context_{1};
  std::mutex mutex_;
  zmq::socket_t publisher_;                                  // guarded by mutex_
  std::map<std::string, MessagePtr, std::less<>> retained_;  // guarded by mutex_; by key
  zmq::socket_t poses_;                                      // receiver thread only, as are the monitors
  Monitor publisher_monitor_;
  Monitor poses_monitor_;
  std::string publish_endpoint_;
  std::string pose_endpoint_;
  int stop_event_ = -1;  // eventfd; wakes the receiver thread for its end
  std::thread receiver_;
};

}  // namespace tensormass::bus
