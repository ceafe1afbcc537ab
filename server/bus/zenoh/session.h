#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "bus/zenoh/tensormass_zenoh.h"
#include "core/result.h"

/// zenoh for C++: a session and its subscribers as owners, over the C interface of tensormass_zenoh.h. The server, the
/// haptic client and the tests use it.
///
/// Threads. zenoh runs its own threads; every method may be called from any thread.
///
///     put(key, payload) ──> queue of each peer ──> network    waits milliseconds at most; then a full queue drops it
///     network ──> zenoh's threads ──> MessageHandler of a Subscriber
///     retain(key, payload) ──> table ──> a thread answers a peer's get(key), and waits for the peer
///     get(key, timeout) ──> peers, waits ──> MessageHandler on the caller's thread
///
/// Four rules:
///
/// 1. Every put drops instead of blocking. zenoh's other mode lets one stopped subscriber stall the publisher.
/// 2. A late joiner asks for retained messages with `get`; subscribing alone does not send them.
/// 3. A session neither scouts nor gossips. It talks only to the addresses in its options.
/// 4. A session with `accept` lets peers put only there. zenoh would route everything else to other peers, on loopback
///    too.
///
/// Lifetimes. A Subscriber must be destroyed before its Session. Its destructor waits until the handler has returned,
/// so a handler must not destroy its own Subscriber.
namespace tensormass::zenoh {

/// Called with one message: on zenoh's threads for a subscription, on the caller's thread for a `get`. Both views are
/// valid during the call only. It must not throw.
using MessageHandler = std::function<void(std::string_view key, std::string_view payload)>;

struct SessionOptions {
  /// The address to listen on, "tcp/127.0.0.1:7447"; port 0 takes a free one. Empty: the session does not listen and
  /// is a client of `connect`.
  std::string listen = {};
  /// The address of the peer to connect to, "tcp/127.0.0.1:7447". Empty: no connection is made.
  std::string connect = {};
  /// The key expression whose gets this session answers with its retained messages, "tensormass/local/**". Empty: it
  /// answers none.
  std::string serve = {};
  /// The key expression under which peers may put, "tensormass/local/*/tool/*/pose". Peers may then put nothing else,
  /// answer nobody, and get only what this session puts and retains under `serve`. Empty: no rule holds, and peers
  /// speak to each other through this session.
  std::string accept = {};
  /// zenoh's access control as JSON, in place of the rules of `accept` (access_control.h). Empty: those rules.
  std::string access_control = {};
  /// PEM texts for mutual TLS: who signs the peers' certificates, and the own certificate and key. Addresses are then
  /// written tls/HOST:PORT. Empty: no TLS.
  std::string authority = {}, certificate = {}, private_key = {};
  /// Peers connected at once; a further one is refused. 0: zenoh's own limit, 1000.
  std::uint32_t max_sessions = 0;
  /// Bytes of a message of a peer; a larger one is dropped before it is held. A message that zenoh sends in one piece,
  /// below 64 KiB, passes whatever the limit. 0: zenoh's own limit, 1 GiB.
  std::uint32_t max_message_bytes = 0;
  /// Subscriptions and interests of a peer, and of all peers; beyond it a peer's connection is closed. 0: no limit.
  /// Nor does any of the next four hold then. They are counted once somebody receives zenoh's log.
  std::uint32_t max_declarations = 0, max_declarations_of_all = 0;
  /// Keys that zenoh keeps for what a peer declares, and the bytes of one. All peers together have
  /// max_declarations_of_all.
  std::uint32_t max_keys = 0, max_key_bytes = 0;
  /// Declarations and queries of a peer: so many at once, and so many a second [1/s] after that.
  double max_requests = 0, max_requests_per_s = 0;
  /// Sends large messages through shared memory to peers on the same machine that also turned it on.
  bool shared_memory = true;
};

namespace detail {

inline void call_handler(void* context, const char* key, std::size_t key_size, const std::uint8_t* payload,
                         std::size_t size) noexcept {
  (*static_cast<MessageHandler*>(context))({key, key_size}, {reinterpret_cast<const char*>(payload), size});
}

inline const std::uint8_t* bytes(std::string_view payload) {
  return reinterpret_cast<const std::uint8_t*>(payload.data());
}

}  // namespace detail

/// One subscription, ended by the destructor, which waits until the handler has returned. Empty if default-constructed.
class Subscriber {
 public:
  Subscriber() = default;

 private:
  friend class Session;
  struct Undeclare {
    void operator()(tensormass_zenoh_subscriber* subscriber) const { tensormass_zenoh_unsubscribe(subscriber); }
  };
  // Members are destroyed in reverse order: the subscription ends before the handler that it calls is freed.
  std::unique_ptr<MessageHandler> handler_;
  std::unique_ptr<tensormass_zenoh_subscriber, Undeclare> subscriber_;
};

/// One connection to zenoh, closed by the destructor.
class Session {
 public:
  /// Returns when the session listens and is connected, as `options` ask. Fails with kUnavailable, and the address and
  /// the cause in the message, if it cannot.
  static Result<Session> open(const SessionOptions& options) {
    std::array<char, 1024> error{};
    const tensormass_zenoh_options raw{.listen = options.listen.c_str(),
                                       .connect = options.connect.c_str(),
                                       .serve = options.serve.c_str(),
                                       .accept = options.accept.c_str(),
                                       .access_control = options.access_control.c_str(),
                                       .authority = options.authority.c_str(),
                                       .certificate = options.certificate.c_str(),
                                       .private_key = options.private_key.c_str(),
                                       .max_sessions = options.max_sessions,
                                       .max_message_bytes = options.max_message_bytes,
                                       .max_declarations = options.max_declarations,
                                       .max_declarations_of_all = options.max_declarations_of_all,
                                       .max_keys = options.max_keys,
                                       .max_key_bytes = options.max_key_bytes,
                                       .max_requests = options.max_requests,
                                       .max_requests_per_s = options.max_requests_per_s,
                                       .shared_memory = options.shared_memory};
    Session session(tensormass_zenoh_open(&raw, error.data(), error.size()));
    if (!session.session_) {
      const std::string what =
          options.listen.empty() ? "connect to '" + options.connect : "listen on '" + options.listen;
      return fail(ErrorCode::kUnavailable,
                  "zenoh cannot " + what + "': " + error.data() + "; addresses are written tcp/127.0.0.1:7447");
    }
    return session;
  }

  /// The address that the session listens on, with the port that was chosen. Empty: it does not listen.
  std::string locator() const {
    std::array<char, 256> locator{};
    tensormass_zenoh_locator(session_.get(), locator.data(), locator.size());
    return locator.data();
  }

  /// Sends a message to the subscribers of `key`; a subscriber whose queue is full loses it. `urgent` messages overtake
  /// the others. full_queues: gets the number of subscribers whose queue became full by it. Returns false if `key` is
  /// not a valid key or the session is closed.
  bool put(std::string_view key, std::string_view payload, bool urgent = false, std::uint32_t* full_queues = nullptr) {
    return tensormass_zenoh_put(session_.get(), key.data(), key.size(), detail::bytes(payload), payload.size(), urgent,
                                full_queues);
  }

  /// Keeps a copy of the message as the answer to a peer's `get` of its key, in place of the one before. Needs
  /// `SessionOptions::serve`. Returns false if `key` is not a valid key.
  bool retain(std::string_view key, std::string_view payload) {
    return tensormass_zenoh_retain(session_.get(), key.data(), key.size(), detail::bytes(payload), payload.size());
  }

  /// Drops the retained message of `key`, if there is one.
  void forget(std::string_view key) { tensormass_zenoh_forget(session_.get(), key.data(), key.size()); }

  /// Calls `handler` for each message under `key`, which may contain the wildcards * and **. Fails with
  /// kInvalidArgument if `key` is not a key expression, or the session is closed.
  Result<Subscriber> subscribe(std::string_view key, MessageHandler handler) {
    Subscriber subscriber;
    subscriber.handler_ = std::make_unique<MessageHandler>(std::move(handler));
    subscriber.subscriber_.reset(tensormass_zenoh_subscribe(session_.get(), key.data(), key.size(),
                                                            detail::call_handler, subscriber.handler_.get()));
    if (!subscriber.subscriber_) return invalid("zenoh cannot subscribe to '" + std::string(key) + "'");
    return subscriber;
  }

  /// Asks the peers for the messages they retain under `key` and calls `handler` for each, on this thread. Waits at
  /// most `timeout_ms` [ms]. Returns the number of messages.
  std::size_t get(std::string_view key, std::uint32_t timeout_ms, MessageHandler handler) {
    return tensormass_zenoh_get(session_.get(), key.data(), key.size(), timeout_ms, detail::call_handler, &handler);
  }

 private:
  struct Close {
    void operator()(tensormass_zenoh_session* session) const { tensormass_zenoh_close(session); }
  };
  explicit Session(tensormass_zenoh_session* session) : session_(session) {}

  std::unique_ptr<tensormass_zenoh_session, Close> session_;
};

}  // namespace tensormass::zenoh
