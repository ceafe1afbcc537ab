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
#include "bus/zeromq/handshake_watch.h"
#include "core/result.h"

namespace tensormass::bus {

struct ZeroMqOptions {
  /// "tcp://127.0.0.1:5556", "tcp://127.0.0.1:*" for a free port, "ipc:///run/user/1000/tensormass".
  std::string publish_endpoint;
  std::string pose_endpoint;
};

/// Messages go out on an XPUB socket: it hears of each subscription, and sends what is retained under that prefix once
/// more, so that who joins late has the topology. Poses come in on a PULL socket, to which clients PUSH the newest.
///
/// A ZeroMQ socket belongs to one thread at a time. The PULL socket and the monitors belong to the receiver thread; the
/// XPUB socket is shared by that thread and the publishers, under a mutex that nobody holds while waiting.
class ZeroMqTransport final : public Transport {
 public:
  /// `input` outlives the transport. Errors name the endpoint that could not be bound.
  static Result<std::unique_ptr<ZeroMqTransport>> open(const ZeroMqOptions& options, PoseInput& input);
  ~ZeroMqTransport() override;

  void publish(const MessagePtr& message, PublishOptions options) override;
  void forget(std::string_view key) override;

  /// With the port that was chosen.
  const std::string& publish_endpoint() const { return publish_endpoint_; }
  const std::string& pose_endpoint() const { return pose_endpoint_; }

 private:
  /// What ZeroMQ tells of a socket's connections.
  struct Monitor {
    Monitor(zmq::context_t& context, zmq::socket_t& socket, const std::string& name);
    zmq::socket_t events;
    HandshakeWatch watch;
  };

  explicit ZeroMqTransport(PoseInput& input);
  void receive_loop();
  void receive_poses();
  void watch_handshakes(Monitor& monitor);
  /// Sends what is retained for whoever just subscribed. The caller holds the mutex.
  void serve_subscriptions();
  void send(const MessagePtr& message);

  PoseInput& input_;
  zmq::context_t context_{1};
  std::mutex mutex_;
  zmq::socket_t publisher_;                                  // guarded by mutex_
  std::map<std::string, MessagePtr, std::less<>> retained_;  // guarded by mutex_; by key
  zmq::socket_t poses_;
  Monitor publisher_monitor_;
  Monitor poses_monitor_;
  std::string publish_endpoint_;
  std::string pose_endpoint_;
  int stop_event_ = -1;
  std::thread receiver_;
};

}  // namespace tensormass::bus
