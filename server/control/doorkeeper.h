#pragma once

#include <poll.h>

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "core/result.h"

namespace tensormass::control {

/// Owns a file descriptor and closes it; -1 is empty.
class Descriptor {
 public:
  explicit Descriptor(int descriptor = -1) : descriptor_(descriptor) {}
  Descriptor(Descriptor&& other) noexcept : descriptor_(other.release()) {}
  Descriptor& operator=(Descriptor&& other) noexcept;
  ~Descriptor();

  int get() const { return descriptor_; }
  /// Gives the descriptor to the caller and becomes empty.
  int release();

 private:
  int descriptor_;
};

/// Listens on gRPC's port and passes on only the connections that start with HTTP/2's preface, or, with keys, with TLS.
///
/// gRPC would close all other connections without reporting them. The doorkeeper exists to count them, so that a client
/// that speaks the wrong protocol shows up in `GetVersion.malformed_messages` and in the log.
///
///     client ── connect ──> accept ──> waiting_, at most kMaxWaiting connections
///                                          ├─ the whole preface arrived ──> admit(descriptor)
///                                          ├─ other bytes ────────────────> close, refuse()
///                                          ├─ timeout with some bytes ────> close, refuse()
///                                          ├─ timeout or end, no bytes ───> close
///                                          └─ one too many: the oldest ───> close, refuse()
///
/// The preface is read with MSG_PEEK, so gRPC receives it too. A connection without bytes is not refused, because a
/// port scan or a health check is not an error.
///
/// One thread does all of this. It sleeps in poll, runs `admit` and `refuse`, which must not block, and is joined by
/// the destructor.
class Doorkeeper {
 public:
  /// Called with each accepted connection; it takes ownership of the descriptor, a non-blocking socket.
  using Admit = std::function<void(int descriptor)>;
  /// Called once for each refused connection, with its peer's address.
  using Refuse = std::function<void(std::string_view who)>;

  /// Listens on `address`, HOST:PORT or [HOST]:PORT; port 0 takes a free one. Fails with kUnavailable, and names the
  /// address and the cause. Connections wait in the kernel's queue until `open`.
  static Result<std::unique_ptr<Doorkeeper>> listen(const std::string& address);
  ~Doorkeeper();

  /// What a connection must start with.
  enum class Opening : std::uint8_t { kHttp2, kTls };
  /// Starts the thread. Call it once.
  void open(Admit admit, Refuse refuse, Opening opening = Opening::kHttp2);
  /// HOST:PORT that clients connect to, with the port that was chosen.
  const std::string& endpoint() const { return endpoint_; }

 private:
  struct Connection {
    Descriptor socket;
    std::chrono::steady_clock::time_point deadline;
  };

  Doorkeeper(Descriptor listener, std::string endpoint);
  void run();
  /// Waits for connections and serves them; returns false if the thread must end. items: memory that is used again.
  bool serve(std::vector<pollfd>& items);
  /// Accepts every connection that the kernel has ready. If the process is out of descriptors, it stops polling the
  /// listener for kAcceptPause, because poll would return at once again and again.
  void accept_connections(std::chrono::steady_clock::time_point now);
  /// Admits or refuses the connection, if its preface or its deadline has come. Returns false if it must wait longer.
  bool decide(Connection& connection, bool is_readable, std::chrono::steady_clock::time_point now);
  /// Admits the connection if it starts as it must. Returns the number of bytes that came instead, if it does not.
  std::optional<std::size_t> try_admit(Connection& connection);

  Descriptor listener_;
  Descriptor stop_;
  const std::string endpoint_;
  Admit admit_;
  Refuse refuse_;
  Opening opening_ = Opening::kHttp2;
  std::vector<Connection> waiting_;  // oldest first
  std::chrono::steady_clock::time_point accept_after_{};
  std::thread thread_;
};

}  // namespace tensormass::control
