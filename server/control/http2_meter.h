#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string_view>

#include "core/http2_limits.h"

namespace tensormass::control {

/// Reads the frames of one HTTP/2 connection on their way and says when the client goes too far (core/http2_limits.h).
///
/// gRPC 1.51 has no such bounds: streams that are opened and reset, header blocks without end and messages that never
/// end cost it memory and time without limit. The meter looks at frame headers and at gRPC's message prefixes alone,
/// and changes no byte. It does not check HTTP/2: what is not a frame, gRPC refuses.
///
///     client ── preface, frames ──> from_client ──> gRPC
///     client <────────── frames ── from_server <── gRPC      tells which streams have ended
///
/// One thread at a time may use an object; `half_sent` is shared by all connections of a server.
class Http2Meter {
 public:
  using Time = std::chrono::steady_clock::time_point;

  /// The messages that a server takes.
  struct Messages {
    std::uint64_t max_bytes = limits::kDefaultHalfSentBytes;  ///< the size that the prefix of one may announce
    /// Whether the daemon has memory for so many bytes; must not block. Asked about messages above kSmallMessageBytes.
    std::function<bool(std::uint64_t bytes)> has_room = nullptr;
  };

  /// A number of events that may happen at once, and a rate at which it recovers.
  struct Bucket {
    double left;
    Time since;
    bool take(double most, double per_s, Time now);
    /// Takes what an event has cost. Returns false if more than all was taken.
    bool spend(double cost, double most, double per_s, Time now);
  };
  /// What one client may do: shared by all connections of a key, because a client could open many of them.
  struct Budget {
    explicit Budget(Time now)
        : resets{limits::kMaxResetsAtOnce, now},
          control_frames{limits::kMaxControlFramesAtOnce, now},
          cpu{limits::kMaxRelayCpuAtOnceS, now} {}
    Bucket resets, control_frames;
    Bucket cpu;  // [s], counted by the relay for keys alone
    std::size_t streams = 0;
  };

  /// half_sent: bytes of messages that have not arrived as a whole, of all connections. Both must outlive the meter.
  Http2Meter(std::atomic<std::uint64_t>& half_sent, const Messages& messages, Time now);
  ~Http2Meter();
  Http2Meter(const Http2Meter&) = delete;
  Http2Meter& operator=(const Http2Meter&) = delete;

  /// Counts against `budget` from now on, before the first byte of the client. Without a call it has one of its own.
  void share(std::shared_ptr<Budget> budget);
  /// Takes the next bytes of the client. Returns why the connection must be closed, or "". The text is constant.
  std::string_view from_client(std::string_view bytes, Time now);
  void from_server(std::string_view bytes);
  /// Returns why the connection must be closed because of time that has passed, or "".
  std::string_view at(Time now) const;

  std::size_t stream_count() const { return streams_.size(); }
  /// Bytes of half-sent messages times the time for which nothing more of them came [B s]. Who waits with a large
  /// message has much; who sends has none.
  double held_byte_s(Time now) const;
  /// Whether the server's bytes so far end with a frame, so that another frame may follow.
  bool server_is_between_frames() const { return server_.header_size == 0; }

 private:
  /// Splits bytes into frames. Only the first nine bytes of a frame are kept.
  struct Reader {
    std::array<unsigned char, 9> header{};
    std::size_t header_size = 0;     // bytes of the header that have come
    std::uint32_t payload_left = 0;  // bytes of the payload that have not come
    std::uint8_t type = 0, flags = 0;
    std::uint32_t stream = 0;
  };
  struct Stream {
    std::array<unsigned char, 5> prefix{};  // gRPC's, of the message that comes
    std::size_t prefix_size = 0;
    std::uint64_t message_left = 0;
    std::uint64_t half_sent = 0;  // bytes of it that have come
    bool had_message = false;
    bool client_ended = false, server_ended = false;
    Time progress;
  };
  /// begins: std::string_view(), after the header of a frame; payload: std::string_view(std::string_view), for its
  /// bytes. Both return why the connection must be closed, or "".
  template <class Begins, class Payload>
  static std::string_view read(Reader& reader, std::string_view bytes, const Begins& begins, const Payload& payload);
  std::string_view begin_client_frame(Time now);
  std::string_view take_data(std::string_view bytes, Time now);
  void end(std::uint32_t stream, bool by_client);
  void close(std::map<std::uint32_t, Stream>::iterator stream);
  void take_half_sent(Stream& stream, std::uint64_t bytes);

  std::atomic<std::uint64_t>& half_sent_;
  const Messages& messages_;
  std::size_t preface_left_;
  Reader client_, server_;
  std::size_t header_block_ = 0;  // bytes of the block that comes
  std::map<std::uint32_t, Stream> streams_;
  std::shared_ptr<Budget> budget_;
};

}  // namespace tensormass::control
