#include "bus/zeromq/zeromq_transport.h"

#include <netinet/in.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <functional>
#include <new>
#include <string>
#include <utility>
#include <vector>

#include "bus/keys.h"
#include "core/bus_limits.h"
#include "core/limits.h"
#include "core/peer_address.h"
#include "core/thread_name.h"

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
/// Poses, and requests of subscribers, read in a row before the other sockets are served.
constexpr int kPosesPerTurn = 256;
constexpr int kRequestsPerTurn = 256;
/// Requests of one subscriber that ZeroMQ queues. It moves a whole queue at once to where it has no limit, and goes on
/// while the queue fills again, so the queue is short.
constexpr int kRequestQueue = 64;
/// Any name does: ZeroMQ then refuses ZMTP 1 and 2. Without keys no handler is registered for it, and none is needed.
constexpr const char* kZapDomain = "tensormass";
constexpr const char* kZapEndpoint = "inproc://zeromq.zap.01";
constexpr std::size_t kCurveKeyBytes = 32;
constexpr auto kRetainedPeriod = std::chrono::duration_cast<std::chrono::steady_clock::duration>(
    std::chrono::duration<double>(limits::kRetainedPeriodS));

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

/// Returns true if the socket's own end is at `endpoint`, "tcp://HOST:PORT" or "ipc://PATH".
bool is_at(int descriptor, const std::string& endpoint) {
  sockaddr_storage own{};
  socklen_t size = sizeof(own);
  if (getsockname(descriptor, reinterpret_cast<sockaddr*>(&own), &size) != 0) return false;
  if (own.ss_family == AF_UNIX) {
    const std::string_view path(reinterpret_cast<sockaddr_un&>(own).sun_path);
    return endpoint.starts_with("ipc://") && endpoint.ends_with(path);
  }
  if (own.ss_family != AF_INET && own.ss_family != AF_INET6) return false;
  const std::uint16_t port = ntohs(own.ss_family == AF_INET ? reinterpret_cast<sockaddr_in&>(own).sin_port
                                                            : reinterpret_cast<sockaddr_in6&>(own).sin6_port);
  return endpoint.substr(endpoint.rfind(':') + 1) == std::to_string(port);
}

/// ZeroMQ has no call that ends one connection, but its thread notices the end of the stream. If the connection is gone
/// and its descriptor belongs to something else by now, that is left alone.
void end_connection(int descriptor, const std::string& endpoint) {
  if (is_at(descriptor, endpoint)) shutdown(descriptor, SHUT_RDWR);
}

}  // namespace

ZeroMqTransport::Monitor::Monitor(zmq::context_t& context, zmq::socket_t& socket, const std::string& name)
    : events(context, zmq::socket_type::pair), handshakes(kHandshakeTimeout) {
  const std::string address = "inproc://" + name;
  if (zmq_socket_monitor(socket.handle(), address.c_str(), kMonitored) != 0) throw zmq::error_t();
  events.connect(address);
}

Result<std::unique_ptr<ZeroMqTransport>> ZeroMqTransport::open(const ZeroMqOptions& options, PoseInput& input,
                                                               BusCounters& counters) {
  std::unique_ptr<ZeroMqTransport> transport(new ZeroMqTransport(options, input, counters));
  auto publish = bind(transport->publisher_, options.publish_endpoint);
  if (!publish) return tl::make_unexpected(publish.error());
  auto pose = bind(transport->poses_, options.pose_endpoint);
  if (!pose) return tl::make_unexpected(pose.error());
  transport->publish_endpoint_ = std::move(*publish);
  transport->pose_endpoint_ = std::move(*pose);
  transport->receiver_ = std::thread([raw = transport.get()] { raw->receive_loop(); });
  return transport;
}

ZeroMqTransport::ZeroMqTransport(const ZeroMqOptions& options, PoseInput& input, BusCounters& counters)
    : input_(input),
      counters_(counters),
      keys_(options.keys),
      server_(options.server),
      publisher_(context_, zmq::socket_type::xpub),
      publisher_monitor_(context_, publisher_, "publisher"),
      subscribers_(options.server),
      poses_(context_, zmq::socket_type::pull),
      poses_monitor_(context_, poses_, "poses"),
      wake_event_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {
  publisher_.set(zmq::sockopt::sndhwm, kSendQueue);
  publisher_.set(zmq::sockopt::rcvhwm, kRequestQueue);
  publisher_.set(zmq::sockopt::linger, kLingerMs);
  publisher_.set(zmq::sockopt::maxmsgsize, limits::kMaxSubscriptionBytes);
  publisher_.set(zmq::sockopt::zap_domain, kZapDomain);
  // Reports every subscription and every end of one. By default XPUB reports only the first to a key and the last end,
  // but the second joined late too.
  publisher_.set(zmq::sockopt::xpub_verboser, true);
  // A send fails if a queue is full, instead of dropping the message without a word.
  publisher_.set(zmq::sockopt::xpub_nodrop, true);
  poses_.set(zmq::sockopt::linger, 0);
  poses_.set(zmq::sockopt::maxmsgsize, kMaxInputBytes);
  for (zmq::socket_t* socket : {&publisher_, &poses_}) socket->set(zmq::sockopt::handshake_ivl, kHandshakeMs);
  if (keys_ == nullptr) return;
  authenticator_.emplace(context_, zmq::socket_type::rep);
  authenticator_->set(zmq::sockopt::linger, 0);
  authenticator_->bind(kZapEndpoint);
  for (zmq::socket_t* socket : {&publisher_, &poses_}) {
    socket->set(zmq::sockopt::zap_domain, kZapDomain);
    socket->set(zmq::sockopt::curve_server, true);
    socket->set(zmq::sockopt::curve_secretkey, keys_->daemon().curve_secret);
  }
}

ZeroMqTransport::~ZeroMqTransport() {
  if (receiver_.joinable()) {
    stopping_ = true;
    eventfd_write(wake_event_, 1);
    receiver_.join();
  }
  close(wake_event_);
}

void ZeroMqTransport::publish(const MessagePtr& message, PublishOptions options) {
  const std::lock_guard lock(mutex_);
  if (options.retain) {
    Retained& retained = retained_[std::string(message->key())];
    retained.message = message;
    retained.wanted = false;
  }
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
  if (publisher_.send(frame, zmq::send_flags::dontwait)) return;
  // The others get it, and whose queue is full loses it. ZeroMQ then leaves that one out, and its queue counts as full
  // no more until it reads.
  counters_.count_full_queues(Carrier::kZeroMq, message->key(), 1);
  publisher_.set(zmq::sockopt::xpub_nodrop, false);
  publisher_.send(frame, zmq::send_flags::dontwait);
  publisher_.set(zmq::sockopt::xpub_nodrop, true);
}

void ZeroMqTransport::serve_subscriptions() {
  zmq::message_t request;
  int left = kRequestsPerTurn;
  for (; left > 0 && publisher_.recv(request, zmq::recv_flags::dontwait); --left) {
    // The monitor tells first that a descriptor has another peer: ZeroMQ reports a connection before its requests.
    read_events(publisher_monitor_);
    serve_request(request);
  }
  has_requests_ = left == 0;
  if (!has_requests_) subscribers_.clean_up(std::chrono::steady_clock::now());
  repeat_retained();
  if (has_requests_ || next_repeat_) wake_receiver();
}

void ZeroMqTransport::serve_request(zmq::message_t& request) {
  const std::string_view bytes = request.to_string_view();
  // The ends of subscriptions that follow from the end of a connection come without a connection. ZeroMQ keeps the text
  // of the descriptor once for each connection, so its place is an id.
  const char* const client = keys_ != nullptr ? zmq_msg_gets(request.handle(), "User-Id") : nullptr;
  const Subscribers::Connection from{zmq_msg_gets(request.handle(), "__fd"), zmq_msg_get(request.handle(), ZMQ_SRCFD),
                                     client != nullptr ? client : ""};
  if (from.id == nullptr) return;
  // ZeroMQ's format: byte 1 and a prefix subscribes, byte 0 and a prefix ends the subscription.
  if (bytes.empty() || bytes.front() > 1 || request.more()) {
    if (subscribers_.refuse(from, request)) disconnect(from, {}, "not a subscription");
    return;
  }
  const std::string_view prefix = bytes.substr(1);
  if (bytes.front() == 0) return subscribers_.unsubscribe(from, prefix);
  const auto address = parse_stream_key(server_, prefix.substr(0, prefix.empty() ? 0 : prefix.size() - 1));
  const std::string_view scene = address ? address->scene : std::string_view();
  if (keys_ != nullptr && prefix.ends_with('\0') && !may_subscribe(from.client, prefix.substr(0, prefix.size() - 1))) {
    if (subscribers_.refuse(from, request)) {
      counters_.count_refusal(Carrier::kZeroMq, Refusal::kAccess);
      disconnect(from, scene, "a subscription that its client's key does not allow");
    }
    return;
  }
  const Subscribers::Verdict verdict = subscribers_.subscribe(from, request, prefix);
  if (verdict == Subscribers::Verdict::kTooMany || verdict == Subscribers::Verdict::kTooManyOfKey) {
    counters_.count_refusal(Carrier::kZeroMq, Refusal::kSubscriptions);
  }
  switch (verdict) {
    case Subscribers::Verdict::kIgnored:
      return;
    case Subscribers::Verdict::kWrongKey:
      return disconnect(from, {}, "not a key of this server's streams with its zero byte");
    case Subscribers::Verdict::kTooMany:
      return disconnect(from, scene, "more than kMaxSubscriptionsPerPeer subscriptions");
    case Subscribers::Verdict::kTooManyOfKey:
      return disconnect(from, scene, "more than kMaxSubscriptionsPerKey subscriptions of its key");
    case Subscribers::Verdict::kAccepted:
      publisher_monitor_.connections.used(from.descriptor);
      break;
  }
  const auto retained = retained_.find(prefix.substr(0, prefix.size() - 1));  // without the zero byte
  if (retained != retained_.end()) retained->second.wanted = true;
}

void ZeroMqTransport::repeat_retained() {
  const auto now = std::chrono::steady_clock::now();
  next_repeat_.reset();
  for (auto& [key, retained] : retained_) {
    if (!retained.wanted) continue;
    if (retained.repeat_after <= now) {
      retained.wanted = false;
      retained.repeat_after = now + kRetainedPeriod;
      send(retained.message);
    } else if (!next_repeat_ || retained.repeat_after < *next_repeat_) {
      next_repeat_ = retained.repeat_after;
    }
  }
}

void ZeroMqTransport::disconnect(const Subscribers::Connection& subscriber, std::string_view scene,
                                 std::string_view reason) {
  const std::string who =
      subscriber.client.empty() ? address_of_peer(subscriber.descriptor) : std::string(subscriber.client);
  input_.refuse({.who = who,
                 .what = "a subscription over ZeroMQ",
                 .scene = scene,
                 .reason = std::string(reason) + "; its client was disconnected"});
  end_connection(subscriber.descriptor, publish_endpoint_);
}

std::chrono::milliseconds ZeroMqTransport::sleep_time() {
  using std::chrono::milliseconds;
  const std::lock_guard lock(mutex_);
  receiver_woken_ = false;
  if (has_requests_) return milliseconds{0};
  const bool young = publisher_monitor_.handshakes.is_waiting() || poses_monitor_.handshakes.is_waiting();
  milliseconds time = young ? kHandshakeCheckPeriod : milliseconds{-1};
  if (next_repeat_) {
    const auto left = std::chrono::ceil<milliseconds>(*next_repeat_ - std::chrono::steady_clock::now());
    time = young ? std::min(time, left) : left;
    time = std::max(time, milliseconds{0});
  }
  return time;
}

void ZeroMqTransport::wake_receiver() {
  if (!std::exchange(receiver_woken_, true)) eventfd_write(wake_event_, 1);
}

void ZeroMqTransport::receive_loop() {
  name_thread("zeromq poses");
  const int subscriptions = publisher_.get(zmq::sockopt::fd);
  const int connections = publisher_monitor_.events.get(zmq::sockopt::fd);
  std::array<zmq::pollitem_t, 6> items{{{poses_.handle(), 0, ZMQ_POLLIN, 0},
                                        {nullptr, subscriptions, ZMQ_POLLIN, 0},
                                        {nullptr, connections, ZMQ_POLLIN, 0},
                                        {poses_monitor_.events.handle(), 0, ZMQ_POLLIN, 0},
                                        {nullptr, wake_event_, ZMQ_POLLIN, 0},
                                        {nullptr, wake_event_, 0, 0}}};
  if (authenticator_) items[5] = {authenticator_->handle(), 0, ZMQ_POLLIN, 0};
  const zmq::pollitem_t &poses = items[0], &subscribed = items[1], &connected = items[2], &wake = items[4];
  while (true) {
    const bool time_is_up = zmq::poll(items.data(), items.size(), sleep_time()) == 0;
    if (stopping_) return;
    if (wake.revents != 0) {
      eventfd_t count;
      eventfd_read(wake_event_, &count);
    }
    try {
      if (authenticator_) authenticate();
      if (poses.revents != 0) receive_poses();
      read_events(poses_monitor_);
      if (!time_is_up && subscribed.revents == 0 && connected.revents == 0 && wake.revents == 0) continue;
      const std::lock_guard lock(mutex_);
      serve_subscriptions();
      read_events(publisher_monitor_);
      if (keys_changed_.exchange(false)) cut_removed();
    } catch (const std::bad_alloc&) {
      // What could not be served is dropped; the thread must go on.
    }
  }
}

void ZeroMqTransport::receive_poses() {
  zmq::message_t message;
  for (int count = 0; count < kPosesPerTurn && poses_.recv(message, zmq::recv_flags::dontwait); ++count) {
    const int descriptor = zmq_msg_get(message.handle(), ZMQ_SRCFD);
    const char* const client = keys_ != nullptr ? zmq_msg_gets(message.handle(), "User-Id") : nullptr;
    const std::string id = client != nullptr ? client : "";
    // A key's connections count together, and without keys each for itself.
    const std::uint64_t number =
        client != nullptr ? std::hash<std::string_view>()(id) : static_cast<std::uint64_t>(descriptor);
    const Sender sender{Carrier::kZeroMq, number, id, descriptor};
    bool stays = true;
    if (!message.more()) {
      stays = input_.receive_framed(message.to_string_view(), sender);
      poses_monitor_.connections.used(descriptor);
    } else {
      std::size_t bytes = message.size();
      while (message.more() && poses_.recv(message, zmq::recv_flags::dontwait)) bytes += message.size();
      stays = input_.refuse_frames(bytes, sender);
    }
    if (!stays || (client != nullptr && keys_->find(id) == nullptr)) end_connection(descriptor, pose_endpoint_);
  }
}

bool ZeroMqTransport::keys_changed() {
  const std::lock_guard lock(mutex_);
  keys_changed_ = true;
  eventfd_write(wake_event_, 1);
  return true;
}

void ZeroMqTransport::cut_removed() {
  const auto counts = [this](std::string_view client) { return keys_->find(client) != nullptr; };
  const auto may = [this](std::string_view client, std::string_view subscription) {
    return may_subscribe(client, subscription.substr(0, subscription.size() - 1));
  };
  for (const Subscribers::Connection& subscriber : subscribers_.refuse_removed(counts, may)) {
    disconnect(subscriber, {},
               "a subscriber whose key was removed, has expired, or does not allow its subscriptions any more");
  }
}

bool ZeroMqTransport::may_subscribe(std::string_view id, std::string_view key) const {
  const auto address = parse_stream_key(server_, key);
  const access::ClientPtr client = keys_->find(id);
  return address && client != nullptr &&
         access::allows(access::find_rule(access::kStreams, address->stream), client->subject(), address->scene,
                        address->tool);
}

void ZeroMqTransport::authenticate() {
  // A question: version, number, domain, address, identity, mechanism, key of 32 bytes. An answer: version, number,
  // status, text, user id, metadata.
  std::vector<zmq::message_t> question;
  while (true) {
    question.clear();
    do {
      if (!authenticator_->recv(question.emplace_back(), zmq::recv_flags::dontwait)) return;
    } while (question.back().more());
    access::ClientPtr client;
    if (question.size() == 7 && question[5].to_string_view() == "CURVE" && question[6].size() == kCurveKeyBytes) {
      std::array<char, 5 * kCurveKeyBytes / 4 + 1> text{};
      zmq_z85_encode(text.data(), question[6].data<std::uint8_t>(), kCurveKeyBytes);
      client = keys_->find_curve(text.data());
    }
    const std::string_view number = question.size() > 1 ? question[1].to_string_view() : "";
    const std::string_view id = client != nullptr ? std::string_view(client->id) : "";
    std::array<std::string_view, 6> answer{"1.0", number, client != nullptr ? "200" : "400", "", id, ""};
    for (std::size_t i = 0; i < answer.size(); ++i) {
      const auto flags = i + 1 < answer.size() ? zmq::send_flags::sndmore : zmq::send_flags::none;
      authenticator_->send(zmq::buffer(answer[i]), flags | zmq::send_flags::dontwait);
    }
  }
}

void ZeroMqTransport::read_events(Monitor& monitor) {
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
    const bool publishes = &monitor == &publisher_monitor_;
    const bool another_peer = event == ZMQ_EVENT_ACCEPTED || event == ZMQ_EVENT_DISCONNECTED;
    if (another_peer && publishes) subscribers_.forget(descriptor, now);
    if (event == ZMQ_EVENT_ACCEPTED) {
      monitor.handshakes.accepted(descriptor, now);
      if (!publishes && keys_ == nullptr) {
        input_.forget({.carrier = Carrier::kZeroMq, .number = static_cast<std::uint64_t>(descriptor)});
      }
      end_one_too_many(monitor, descriptor, publishes ? publish_endpoint_ : pose_endpoint_);
    }
    if (event == ZMQ_EVENT_HANDSHAKE_SUCCEEDED) monitor.handshakes.succeeded();
    if (event == ZMQ_EVENT_DISCONNECTED) {
      monitor.handshakes.disconnected(descriptor);
      monitor.connections.disconnected(descriptor);
    }
  }
  for (std::int64_t refused = monitor.handshakes.take_refused(now); refused > 0; --refused) {
    input_.refuse({.what = "a connection over ZeroMQ",
                   .reason = "a peer that left before the handshake, or does not speak ZeroMQ"});
  }
}

void ZeroMqTransport::end_one_too_many(Monitor& monitor, int descriptor, const std::string& endpoint) {
  const auto ended = monitor.connections.accepted(descriptor, std::chrono::steady_clock::now(),
                                                  [&](int each) { return is_at(each, endpoint); });
  if (!ended) return;
  counters_.count_refusal(Carrier::kZeroMq, Refusal::kConnections);
  const std::string who = address_of_peer(*ended);
  input_.refuse({.who = who,
                 .what = "a connection over ZeroMQ",
                 .reason = "more than kMaxZeroMqConnections connections; the oldest that had sent nothing made room"});
  end_connection(*ended, endpoint);
}

}  // namespace tensormass::bus
