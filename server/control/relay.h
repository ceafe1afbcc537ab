#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string_view>
#include <thread>
#include <vector>

#include "control/doorkeeper.h"
#include "control/http2_meter.h"

namespace tensormass::control {

/// Carries the bytes of admitted connections to gRPC and back, and closes a connection that passes a limit of HTTP/2.
///
///     client <── socket ──> one buffer each way <── socket pair ──> gRPC
///                                └─ Http2Meter: too many resets, too long headers, ... ──> close both, refuse(why)
///
/// A buffer is read into only when it is empty, so a side that does not read makes the other wait, as without a relay.
/// One thread does all of this. It sleeps in epoll, calls `refuse`, and is joined by the destructor.
class Relay {
 public:
  /// Called with gRPC's end of each connection; it takes ownership of the descriptor, a non-blocking socket.
  using Admit = std::function<void(int descriptor)>;
  /// Called with the reason for each connection that was closed for a limit; must not block.
  using Refuse = std::function<void(std::string_view why)>;

  Relay(Admit admit, Refuse refuse);
  ~Relay();

  /// Takes ownership of a client's socket, non-blocking. Any thread may call it; `admit` runs on it.
  void add(int client);

 private:
  /// Bytes on their way from one socket to the other.
  struct Buffer {
    std::array<char, std::size_t{64} << 10> bytes;
    std::size_t begin = 0, end = 0;
    bool source_ended = false, passed_on = false;  // the end of the stream came, and was passed on

    bool empty() const { return begin == end; }
    std::string_view view() const { return {bytes.data() + begin, end - begin}; }
  };
  struct Connection {
    Connection(Descriptor of_client, Descriptor of_inner, std::atomic<std::uint64_t>& half_sent);
    Descriptor client, inner;
    Http2Meter meter;
    Buffer in, out;
    std::uint32_t client_events = 0, inner_events = 0;  // that epoll waits for
  };
  enum class Outcome : std::uint8_t { kGoesOn, kEnded };

  void run();
  void take_new();
  Outcome carry(Connection& connection);
  /// Moves what it can; taken: std::string_view(std::string_view), gets the bytes that were read and returns why the
  /// connection must be closed, or "".
  template <class Taken>
  Outcome carry(int from, int to, Buffer& buffer, const Taken& taken);
  void wait_for(std::uint64_t id, Connection& connection);
  void watch(std::uint64_t key, int descriptor, std::uint32_t& present, std::uint32_t wanted);
  void check_time();

  const Admit admit_;
  const Refuse refuse_;
  Descriptor poll_, wake_;
  std::atomic<std::uint64_t> half_sent_{0};
  std::atomic<std::size_t> count_{0};
  std::atomic<bool> stopping_{false};
  std::mutex mutex_;
  std::vector<std::unique_ptr<Connection>> new_;  // guarded by mutex_
  std::map<std::uint64_t, std::unique_ptr<Connection>> connections_;
  std::uint64_t next_id_ = 1;
  std::chrono::steady_clock::time_point next_check_{};
  std::thread thread_;
};

}  // namespace tensormass::control
