#include "bus/zeromq/zeromq_transport.h"

#include <sys/eventfd.h>
#include <unistd.h>

#include <array>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <set>
#include <utility>

#include "core/limits.h"

namespace tensormass::bus {
namespace {

/// Messages queued to one subscriber; ZeroMQ drops the others. Room for one step of a scene with all its tools, because
/// a message that waits longer is old when it arrives.
constexpr int kSendQueue = static_cast<int>(limits::kMaxTools) + 4;
/// [ms] that the last messages, which set forces to zero, may take to leave when the transport closes.
constexpr int kLingerMs = 200;
/// [ms] until ZeroMQ disconnects a peer that has not finished the handshake.
constexpr int kHandshakeMs = 3000;
/// ZeroMQ closes the connection of a client that sends a longer message, uncounted. PoseInput counts messages that are
/// shorter than this and longer than limits::kMaxPoseMessageBytes.
constexpr std::int64_t kMaxInputBytes = std::int64_t{1} << 20;
/// Poses read in a row before the other sockets are served.
constexpr int kPosesPerTurn = 256;

/// Time between two counts while connections are young, because their timeout ends without an event.
constexpr std::chrono::milliseconds kHandshakeCheckPeriod{200};
/// ZeroMQ has disconnected a peer without a handshake by then.
constexpr std::chrono::milliseconds kHandshakeTimeout{kHandshakeMs + 500};

constexpr int kMonitored = ZMQ_EVENT_ACCEPTED | ZMQ_EVENT_HANDSHAKE_SUCCEEDED | ZMQ_EVENT_DISCONNECTED;

/// Returns the endpoint with the port that was chosen.
Result<std::string> bind(zmq::socket_t& socket, const std::string& endpoint) {
  try {
    socket.bind(endpoint);
    return socket.get(zmq::sockopt::last_endpoint);
  } catch (const zmq::error_t& error) {
    return fail(ErrorCode::kUnavailable, "ZeroMQ cannot listen on '" + endpoint + "': " + error.what() +
                                             "; give another address, or * as the port for a free one");
  }
}

}  // namespace

ZeroMqTransport::Monitor::Monitor(zmq::context_t& context, zmq::socket_t& socket, const std::string& name)
    : events(context, zmq::socket_type::pair), handshakes(kHandshakeTimeout) {
  const std::string address = "inproc://" + name;
  if (zmq_socket_monitor(socket.handle(), address.c_str(), kMonitored) != 0) throw zmq::error_t();
  events.connect(address);
}

Result<std::unique_ptr<ZeroMqTransport>> ZeroMqTransport::open(const ZeroMqOptions& options, PoseInput& input) {
  std::unique_ptr<ZeroMqTransport> transport(new ZeroMqTransport(input));
  auto publish = bind(transport->publisher_, options.publish_endpoint);
  if (!publish) return tl::make_unexpected(publish.error());
  auto pose = bind(transport->poses_, options.pose_endpoint);
  if (!pose) return tl::make_unexpected(pose.error());
  transport->publish_endpoint_ = std::move(*publish);
  transport->pose_endpoint_ = std::move(*pose);
  transport->receiver_ = std::thread([raw = transport.get()] { raw->receive_loop(); });
  return transport;
}

ZeroMqTransport::ZeroMqTransport(PoseInput& input)
    : input_(input),
      publisher_(context_, zmq::socket_type::xpub),
      poses_(context_, zmq::socket_type::pull),
      publisher_monitor_(context_, publisher_, "publisher"),
      poses_monitor_(context_, poses_, "poses"),
      stop_event_(eventfd(0, EFD_CLOEXEC)) {
  publisher_.set(zmq::sockopt::sndhwm, kSendQueue);
  publisher_.set(zmq::sockopt::linger, kLingerMs);
  // Reports every subscription. By default XPUB reports only the first to a key, but the second joined late too.
  publisher_.set(zmq::sockopt::xpub_verbose, true);
  poses_.set(zmq::sockopt::linger, 0);
  for (zmq::socket_t* socket : {&publisher_, &poses_}) {
    socket->set(zmq::sockopt::maxmsgsize, kMaxInputBytes);
    socket->set(zmq::sockopt::handshake_ivl, kHandshakeMs);
  }
}

ZeroMqTransport::~ZeroMqTransport() {
  if (receiver_.joinable()) {
    eventfd_write(stop_event_, 1);
    receiver_.join();
  }
  close(stop_event_);
}

void ZeroMqTransport::publish(const MessagePtr& message, PublishOptions options) {
  const std::lock_guard lock(mutex_);
  if (options.retain) retained_.insert_or_assign(std::string(message->key()), message);
  send(message);
  // ZeroMQ signals a subscription once, and the send above may have consumed the signal instead of the receiver thread.
  serve_subscriptions();
}

void ZeroMqTransport::forget(std::string_view key) {
  const std::lock_guard lock(mutex_);
  if (const auto found = retained_.find(key); found != retained_.end()) retained_.erase(found);
}

void ZeroMqTransport::send(const MessagePtr& message) {
  // ZeroMQ sends our bytes without a copy. It frees the hint, a MessagePtr that keeps them alive, after the last send.
  const std::string_view bytes = message->bytes();
  zmq::message_t frame(
      const_cast<char*>(bytes.data()), bytes.size(), [](void*, void* hint) { delete static_cast<MessagePtr*>(hint); },
      new MessagePtr(message));
  publisher_.send(frame, zmq::send_flags::dontwait);
}

void ZeroMqTransport::serve_subscriptions() {
  std::set<MessagePtr> wanted;
  zmq::message_t request;
  while (publisher_.recv(request, zmq::recv_flags::dontwait)) {
    const std::string_view bytes = request.to_string_view();
    // ZeroMQ's format: byte 1 and a prefix subscribes, byte 0 and a prefix ends the subscription.
    if (bytes.empty() || bytes.front() > 1 || request.more()) {
      input_.refuse({}, "not a subscription, on the ZeroMQ publish endpoint");
      continue;
    }
    if (bytes.front() == 0) continue;
    const std::string_view prefix = bytes.substr(1);
    for (const auto& [key, message] : retained_) {
      if (message->bytes().starts_with(prefix)) wanted.insert(message);
    }
  }
  for (const MessagePtr& message : wanted) send(message);
}

void ZeroMqTransport::receive_loop() {
  const int subscriptions = publisher_.get(zmq::sockopt::fd);
  std::array<zmq::pollitem_t, 5> items{{{poses_.handle(), 0, ZMQ_POLLIN, 0},
                                        {nullptr, subscriptions, ZMQ_POLLIN, 0},
                                        {publisher_monitor_.events.handle(), 0, ZMQ_POLLIN, 0},
                                        {poses_monitor_.events.handle(), 0, ZMQ_POLLIN, 0},
                                        {nullptr, stop_event_, ZMQ_POLLIN, 0}}};
  const zmq::pollitem_t &poses = items[0], &subscribed = items[1], &stop = items[4];
  while (true) {
    const bool waiting = publisher_monitor_.handshakes.is_waiting() || poses_monitor_.handshakes.is_waiting();
    zmq::poll(items.data(), items.size(), waiting ? kHandshakeCheckPeriod : std::chrono::milliseconds{-1});
    if (stop.revents != 0) return;
    if (poses.revents != 0) receive_poses();
    if (subscribed.revents != 0) {
      const std::lock_guard lock(mutex_);
      serve_subscriptions();
    }
    count_handshakes(publisher_monitor_);
    count_handshakes(poses_monitor_);
  }
}

void ZeroMqTransport::receive_poses() {
  zmq::message_t message;
  for (int count = 0; count < kPosesPerTurn && poses_.recv(message, zmq::recv_flags::dontwait); ++count) {
    if (!message.more()) {
      input_.receive_framed(message.to_string_view());
      continue;
    }
    while (message.more() && poses_.recv(message, zmq::recv_flags::dontwait)) continue;
    input_.refuse({}, "more than one frame, on the ZeroMQ pose endpoint");
  }
}

void ZeroMqTransport::count_handshakes(Monitor& monitor) {
  const auto now = std::chrono::steady_clock::now();
  zmq::message_t part;
  while (monitor.events.recv(part, zmq::recv_flags::dontwait)) {
    // ZeroMQ's format: a frame with the event (16 bits) and a value (32 bits, here the descriptor), then a frame with
    // the endpoint, which is skipped.
    if (!part.more() || part.size() != 6) continue;
    std::uint16_t event = 0;
    std::int32_t descriptor = 0;
    std::memcpy(&event, part.data(), sizeof(event));
    std::memcpy(&descriptor, part.data<char>() + sizeof(event), sizeof(descriptor));
    if (event == ZMQ_EVENT_ACCEPTED) monitor.handshakes.accepted(descriptor, now);
    if (event == ZMQ_EVENT_HANDSHAKE_SUCCEEDED) monitor.handshakes.succeeded();
    if (event == ZMQ_EVENT_DISCONNECTED) monitor.handshakes.disconnected(descriptor);
  }
  for (std::int64_t refused = monitor.handshakes.take_refused(now); refused > 0; --refused) {
    input_.refuse({}, "a peer that left before the handshake, or does not speak ZeroMQ");
  }
}

}  // namespace tensormass::bus
