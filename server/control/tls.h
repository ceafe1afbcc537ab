#pragma once

#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "core/result.h"

struct ssl_ctx_st;
struct ssl_st;

namespace tensormass::control {

/// The daemon's side of mutual TLS 1.3: its certificate, and the authority that signed those of clients.
///
/// A client without a certificate of that authority, or with an expired one, fails the handshake. OpenSSL is the one
/// that gRPC links anyway.
class TlsContext {
 public:
  /// PEM texts. Fails with kInvalidArgument if OpenSSL does not take one, or the key does not belong to the
  /// certificate.
  static Result<std::unique_ptr<TlsContext>> make(const std::string& certificate, const std::string& private_key,
                                                  const std::string& authority);
  ssl_ctx_st* get() const { return context_.get(); }

 private:
  struct Free {
    void operator()(ssl_ctx_st* context) const;
  };
  explicit TlsContext(std::unique_ptr<ssl_ctx_st, Free> context) : context_(std::move(context)) {}
  std::unique_ptr<ssl_ctx_st, Free> context_;
};

/// One end of TLS on a non-blocking socket, which the caller owns. One thread at a time may use it.
class TlsStream {
 public:
  TlsStream(const TlsContext& context, int socket);

  enum class Handshake : std::uint8_t { kGoesOn, kDone, kFailed };
  /// Goes on with the handshake as far as the socket lets it.
  Handshake shake_hands();
  /// Why the handshake failed, for the log.
  const std::string& failure() const { return failure_; }
  /// The common name of the peer's certificate, after the handshake.
  std::string peer_name() const;

  /// As recv and send: bytes moved, 0 at the end of the stream, -1 with errno EAGAIN if the socket must become ready,
  /// -1 with another errno for a broken stream. `read` never leaves decrypted bytes behind if it is given 16 KiB, the
  /// most that a record has, so whoever waits for the socket misses none.
  ssize_t read(char* bytes, std::size_t size);
  ssize_t write(const char* bytes, std::size_t size);
  /// Tells the peer that nothing follows.
  void end();
  /// The last call waits until the socket can be written to, or read from.
  bool waits_to_write() const { return waits_to_write_; }

 private:
  struct Free {
    void operator()(ssl_st* stream) const;
  };
  ssize_t result(int code);
  std::unique_ptr<ssl_st, Free> stream_;
  std::string failure_;
  bool waits_to_write_ = false;
};

}  // namespace tensormass::control
