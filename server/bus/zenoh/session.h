#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "bus/zenoh/tensormass_zenoh.h"
#include "core/result.h"

/// zenoh for C++: owners and options over the C interface. Clients use it as well as the server.
namespace tensormass::zenoh {

/// Runs on threads of zenoh; views are valid during the call. Must not throw.
using MessageHandler = std::function<void(std::string_view key, std::string_view payload)>;

struct SessionOptions {
  /// "tcp/127.0.0.1:7447"; port 0 for a free one. Empty: the session is a client of `connect`.
  std::string listen = {};
  /// "tcp/127.0.0.1:7447"; empty: connects to nobody.
  std::string connect = {};
  /// Key expression under which retained messages are answered; empty: none are.
  std::string serve = {};
  /// For large messages to peers on the same machine that have it on too.
  bool shared_memory = true;
};

namespace detail {

inline void call_handler(void* context, const char* key, std::size_t key_size, const std::uint8_t* payload,
                         std::size_t size) noexcept {
  (*static_cast<MessageHandler*>(context))({key, key_size}, {reinterpret_cast<const char*>(payload), size});
}

inline const char* or_null(const std::string& text) { return text.empty() ? nullptr : text.c_str(); }

inline const std::uint8_t* bytes(std::string_view payload) {
  return reinterpret_cast<const std::uint8_t*>(payload.data());
}

}  // namespace detail

/// Ends the subscription when it goes; then the handler does not run any more. Goes before its session.
class Subscriber {
 public:
  Subscriber() = default;

 private:
  friend class Session;
  struct Undeclare {
    void operator()(tensormass_zenoh_subscriber* subscriber) const { tensormass_zenoh_unsubscribe(subscriber); }
  };
  // The handler is declared first: it goes after the subscription has ended.
  std::unique_ptr<MessageHandler> handler_;
  std::unique_ptr<tensormass_zenoh_subscriber, Undeclare> subscriber_;
};

class Session {
 public:
  static Result<Session> open(const SessionOptions& options) {
    std::array<char, 1024> error{};
    Session session(tensormass_zenoh_open(detail::or_null(options.listen), detail::or_null(options.connect),
                                          detail::or_null(options.serve), options.shared_memory, error.data(),
                                          error.size()));
    if (!session.session_) {
      const std::string what =
          options.listen.empty() ? "connect to '" + options.connect : "listen on '" + options.listen;
      return fail(ErrorCode::kUnavailable,
                  "zenoh cannot " + what + "': " + error.data() + "; addresses are written tcp/127.0.0.1:7447");
    }
    return session;
  }

  /// What it listens on, with the port that was chosen; empty if it does not.
  std::string locator() const {
    std::array<char, 256> locator{};
    tensormass_zenoh_locator(session_.get(), locator.data(), locator.size());
    return locator.data();
  }

  /// Who cannot take the message loses it. `urgent` goes ahead of what is not. False: not a key, or closed.
  bool put(std::string_view key, std::string_view payload, bool urgent = false) {
    return tensormass_zenoh_put(session_.get(), key.data(), key.size(), detail::bytes(payload), payload.size(), urgent);
  }

  /// Keeps the message as the answer to a `get` of its key. False: not a key.
  bool retain(std::string_view key, std::string_view payload) {
    return tensormass_zenoh_retain(session_.get(), key.data(), key.size(), detail::bytes(payload), payload.size());
  }

  void forget(std::string_view key) { tensormass_zenoh_forget(session_.get(), key.data(), key.size()); }

  Result<Subscriber> subscribe(std::string_view key, MessageHandler handler) {
    Subscriber subscriber;
    subscriber.handler_ = std::make_unique<MessageHandler>(std::move(handler));
    subscriber.subscriber_.reset(tensormass_zenoh_subscribe(session_.get(), key.data(), key.size(),
                                                            detail::call_handler, subscriber.handler_.get()));
    if (!subscriber.subscriber_) return invalid("zenoh cannot subscribe to '" + std::string(key) + "'");
    return subscriber;
  }

  /// Calls the handler, on this thread, for each message retained under the key; returns how many there were.
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
