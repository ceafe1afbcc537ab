#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "control/doorkeeper.h"
#include "control/http2_meter.h"
#include "control/tls.h"

namespace tensormass::control {

/// CPU time that the calling thread has used [s].
double thread_cpu_s();

/// How connections are guarded by keys.
struct RelayGuard {
  const TlsContext* tls = nullptr;  ///< nullptr: plain text, and nobody is asked who it is
  /// Whether a client still has its key; must not block.
  std::function<bool(std::string_view id)> knows = nullptr;
  /// CPU time of the calling thread [s].
  double (*cpu_s)() = &thread_cpu_s;
};

/// Carries the bytes of admitted connections to gRPC and back, and closes a connection that passes a limit of HTTP/2.
///
///     client <── socket ──> one buffer each way <── socket pair ──> gRPC
///                                └─ Http2Meter: too many resets, too long headers, ... ──> close both, refuse()
///
/// All half-sent messages together have a bound. Beyond it the one that waits with most ends, so that a client that
/// sends goes on whoever holds what.
///
/// With keys, the client's side speaks TLS, and gRPC gets a connection when the handshake is done. gRPC calls its peer
/// by the name of the client's certificate, without keys by its address (name_of_peer), because the socket pair's other
/// end has that name. Connections that shake hands have limits of their own, so that peers without a key use up none of
/// those with one.
///
/// With keys, the CPU time of this thread that a client costs has a bound, too: bytes, frames and handshakes all cost
/// it, and all clients share it.
///
/// When there are too many connections, the one ends that has been without a call for longest, so that peers that only
/// hold connections keep nobody out. gRPC's clients connect again by themselves.
///
/// A buffer is read into only when it is empty, so a side that does not read makes the other wait, as without a relay.
/// One thread does all of this. It sleeps in epoll, calls `refuse`, and is joined by the destructor.
class Relay {
 public:
  /// Called with gRPC's end of each connection; it takes ownership of the descriptor, a non-blocking socket.
  using Admit = std::function<void(int descriptor)>;
  /// Called for each connection that was closed for a limit, with the client's id or address and the reason; must not
  /// block.
  using Refuse = std::function<void(std::string_view who, std::string_view why)>;

  Relay(Admit admit, Refuse refuse, RelayGuard guard = {}, Http2Meter::Messages messages = {});
  ~Relay();

  /// Takes ownership of a client's socket, non-blocking. Any thread may call it; `admit` runs on it or on the relay's.
  void add(int client);

  /// Returns the id of a client, or without keys its address, from what gRPC calls its peer; empty if it has no name.
  static std::string name_of_peer(std::string_view peer);

 private:
  /// Bytes on their way from one socket to the other.
  struct Buffer {
    std::array<char, std::size_t{64} << 10> bytes;
    std::size_t begin = 0, end = 0;
    bool source_ended = false, passed_on = false;  // the end of the stream came, and was passed on

    bool empty() const { return begin == end; }
    std::string_view view() const { return {bytes.data() + begin, end - begin}; }
  };
  /// What all connections of one key may do together.
  struct Key {
    std::shared_ptr<Http2Meter::Budget> budget;
    std::size_t connections = 0;
  };
  struct Connection {
    Connection(Descriptor of_client, Descriptor of_inner, std::atomic<std::uint64_t>& half_sent,
               const Http2Meter::Messages& messages);
    Descriptor client, inner;
    std::unique_ptr<TlsStream> tls;  // nullptr: plain text
    std::string address;             // the client's
    std::string id;                  // the client's, after the handshake
    const std::string& who() const { return id.empty() ? address : id; }
    std::chrono::steady_clock::time_point shakes_hands_until = std::chrono::steady_clock::time_point::max();
    Http2Meter meter;
    Buffer in, out;
    bool counted = false;                               // in count_
    std::chrono::steady_clock::time_point idle_since;   // max: it has a call
    bool told = false;                                  // why it ends, by say_goodbye
    std::shared_ptr<Key> key;                           // nullptr in plain text, and before the handshake
    std::uint32_t client_events = 0, inner_events = 0;  // that epoll waits for
  };
  /// A client that was told why its connection ends. Were its socket closed while it sends, it would see a reset, and
  /// gRPC would read no reason.
  struct Leaving {
    Descriptor client;
    std::chrono::steady_clock::time_point until;
  };
  enum class Outcome : std::uint8_t { kGoesOn, kEnded };

  using Connections = std::map<std::uint64_t, std::unique_ptr<Connection>>;

  void run();
  void take_new();
  /// Closes the oldest connection that shakes hands, if there are kMaxShaking of them.
  void make_room_to_shake_hands();
  Outcome carry(Connection& connection);
  Outcome shake_hands(Connection& connection);
  /// Closes connections that hold half-sent messages, those first that hold most for longest, until all of them
  /// together have messages_.max_bytes at most. Returns why `active`, which sends now, must end too, or "".
  std::string_view make_room_for_messages(const Connection& active);
  /// Tells the client why its connection ends, by a frame of HTTP/2, if one may follow. gRPC's errors repeat the text.
  static void say_goodbye(Connection& connection, std::string_view why);
  /// Keeps the client's socket until the client closes it, limits::kLeaveTime at most.
  void let_leave(std::uint64_t id, Connection& connection);
  /// Throws away what a leaving client sends.
  void discard(std::uint64_t id);
  /// Counts the connection, makes the socket pair and hands gRPC its end. Returns false beyond kMaxControlConnections,
  /// if all of them have calls, and without descriptors.
  bool connect_inner(Connection& connection);
  /// Closes the connection that has been without a call for longest. Returns false if each has one.
  bool make_room();
  /// Charges the CPU time since the last call to the connection's key. Returns why the connection must end, or "".
  std::string_view charge(const Connection& connection);
  /// Gives the connection what its key has left. Returns false beyond kMaxConnectionsPerKey.
  bool join_key(Connection& connection);
  /// Returns the connection after the one that it closes.
  Connections::iterator close(Connections::iterator connection);
  /// Moves what it can; taken: std::string_view(std::string_view), gets the bytes that were read and returns why the
  /// connection must be closed, or "".
  template <class From, class To, class Taken>
  Outcome carry(const From& from, const To& to, Buffer& buffer, std::string_view who, const Taken& taken);
  void wait_for(std::uint64_t id, Connection& connection);
  void watch(std::uint64_t key, int descriptor, std::uint32_t& present, std::uint32_t wanted);
  void check_time();

  const Admit admit_;
  const Refuse refuse_;
  const RelayGuard guard_;
  const Http2Meter::Messages messages_;
  Descriptor poll_, wake_;
  std::atomic<std::uint64_t> half_sent_{0};
  std::atomic<std::size_t> count_{0};
  std::atomic<bool> stopping_{false};
  std::mutex mutex_;
  std::vector<std::unique_ptr<Connection>> new_;  // guarded by mutex_
  Connections connections_;
  // By the id of a client. Kept while the key is good: a client that leaves and comes back has no more left.
  std::map<std::string, std::shared_ptr<Key>, std::less<>> keys_;
  std::map<std::uint64_t, Leaving> leaving_;  // by the id that the connection had
  std::uint64_t next_id_ = 1;
  std::chrono::steady_clock::time_point next_check_{};
  double charged_cpu_s_ = 0;  // guard_.cpu_s at the last charge
  std::thread thread_;
};

}  // namespace tensormass::control
