#include "haptic/zeromq_link.h"

#include <signal.h>

#include <string>
#include <string_view>
#include <thread>

#include <zmq.hpp>

#include "haptic/clock.h"

namespace tensormass::haptic {
namespace {

/// Longest wait of the receiver before it checks whether to stop.
constexpr int kReceiveTimeoutMs = 50;
/// Longest wait for the last pose to leave when the link closes.
constexpr int kLingerMs = 100;

class ZeroMqLink final : public Link {
 public:
  explicit ZeroMqLink(const LinkAddress& address)
      : prefix_(address.pose_key + '\0'), feedback_prefix_(address.feedback_key + '\0') {
    if (address.keys) {
      for (zmq::socket_t* socket : {&push_, &sub_}) {
        socket->set(zmq::sockopt::curve_serverkey, address.keys.curve_server);
        socket->set(zmq::sockopt::curve_publickey, address.keys.curve_public);
        socket->set(zmq::sockopt::curve_secretkey, address.keys.curve_secret);
      }
    }
    push_.set(zmq::sockopt::sndhwm, 1);
    push_.set(zmq::sockopt::immediate, true);
    push_.set(zmq::sockopt::linger, kLingerMs);
    push_.connect(address.zeromq_pose_endpoint);
    sub_.set(zmq::sockopt::conflate, true);
    sub_.set(zmq::sockopt::linger, 0);
    sub_.set(zmq::sockopt::rcvtimeo, kReceiveTimeoutMs);
    sub_.set(zmq::sockopt::subscribe, feedback_prefix_);
    sub_.connect(address.zeromq_publish_endpoint);
    // Started last: the receiver uses the sockets above.
    receiver_ = std::jthread([this](std::stop_token stop) { receive_until(stop); });
  }

  ~ZeroMqLink() override {
    if (!is_waiting_) return;
    try {
      push_.set(zmq::sockopt::sndtimeo, kLingerMs);
      push_.send(zmq::buffer(message_), zmq::send_flags::none);
    } catch (const zmq::error_t&) {
      // Interrupted. The pose is lost, as it is if no server comes in time.
    }
  }
  ZeroMqLink(const ZeroMqLink&) = delete;
  ZeroMqLink& operator=(const ZeroMqLink&) = delete;

  bool send(const OutgoingPose& pose) override {
    encode_pose(pose, payload_);
    message_ = prefix_;
    message_ += payload_;
    is_waiting_ = true;
    send_waiting();
    return !is_waiting_;
  }

  std::optional<Feedback> receive() override {
    send_waiting();
    return inbox_.take();
  }
  std::uint64_t malformed() const override { return inbox_.malformed(); }

 private:
  void send_waiting() {
    if (!is_waiting_) return;
    // Reading `events` makes ZeroMQ process its queue now. Send alone does so about once in a millisecond, so it would
    // refuse every other pose.
    if ((push_.get(zmq::sockopt::events) & ZMQ_POLLOUT) == 0) return;
    is_waiting_ = !push_.send(zmq::buffer(message_), zmq::send_flags::dontwait).has_value();
  }

  void receive_until(const std::stop_token& stop) {
    // Signals belong to the program's own threads. Here they would only interrupt a receive.
    sigset_t signals;
    sigfillset(&signals);
    pthread_sigmask(SIG_BLOCK, &signals, nullptr);
    zmq::message_t message;
    while (!stop.stop_requested()) {
      if (!sub_.recv(message)) continue;
      const std::int64_t arrival_ns = clock_.now_ns();
      const std::string_view bytes = message.to_string_view();
      if (!bytes.starts_with(feedback_prefix_)) {
        inbox_.count_malformed();
        continue;
      }
      inbox_.offer(bytes.substr(feedback_prefix_.size()), arrival_ns);
    }
  }

  std::string prefix_;
  std::string feedback_prefix_;
  std::string payload_;
  /// The newest pose, until the server takes it.
  std::string message_;
  bool is_waiting_ = false;
  MonotonicClock clock_;
  FeedbackInbox inbox_;
  zmq::context_t context_{1};
  zmq::socket_t push_{context_, zmq::socket_type::push};
  zmq::socket_t sub_{context_, zmq::socket_type::sub};
  std::jthread receiver_;
};

}  // namespace

Result<std::unique_ptr<Link>> connect_zeromq(const LinkAddress& address) {
  if (address.zeromq_pose_endpoint.empty() || address.zeromq_publish_endpoint.empty()) {
    return fail(ErrorCode::kUnavailable, "the server has ZeroMQ off; use --transport zenoh");
  }
  try {
    return std::make_unique<ZeroMqLink>(address);
  } catch (const zmq::error_t& error) {
    return invalid("ZeroMQ: cannot connect to " + address.zeromq_pose_endpoint + " and " +
                   address.zeromq_publish_endpoint + ": " + error.what());
  }
}

}  // namespace tensormass::haptic
