#include "control/relay.h"

#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <ctime>
#include <new>
#include <utility>

#include <fmt/format.h>

#include "core/peer_address.h"
#include "core/thread_name.h"

namespace tensormass::control {
namespace {

using Clock = std::chrono::steady_clock;

/// Time between two checks of what must not last.
constexpr std::chrono::seconds kCheckPeriod{1};
/// Buffers that one connection fills in a row before the others have their turn.
constexpr int kBuffersPerTurn = 8;
/// Key of the wake-up in epoll; a connection n has the keys 2 n for its client and 2 n + 1 for gRPC.
constexpr std::uint64_t kWakeKey = 0;
/// Time for TLS's handshake.
constexpr std::chrono::seconds kHandshakeTimeout{3};
/// The address of our end of a socket pair: this, 16 random hexadecimal digits that make it unique, a hyphen, the id.
constexpr std::string_view kPeerPrefix = "tm-";
constexpr std::size_t kPeerDigits = 16;

bool would_block() { return errno == EAGAIN || errno == EINTR; }

/// Gives a socket an address in the abstract namespace, which nobody can connect to because it does not listen.
bool name_socket(int descriptor, const std::string& id) {
  std::uint64_t random = 0;
  if (getrandom(&random, sizeof(random), 0) != sizeof(random)) return false;
  const std::string name = fmt::format("{}{:016x}-{}", kPeerPrefix, random, id);
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (name.size() + 1 > sizeof(address.sun_path)) return false;
  std::copy(name.begin(), name.end(), address.sun_path + 1);
  const auto size = static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + 1 + name.size());
  return bind(descriptor, reinterpret_cast<const sockaddr*>(&address), size) == 0;
}

/// A plain socket, and a client's socket, which may have TLS around it.
struct Plain {
  int socket;
  ssize_t read(char* bytes, std::size_t size) const { return recv(socket, bytes, size, 0); }
  ssize_t write(const char* bytes, std::size_t size) const { return send(socket, bytes, size, MSG_NOSIGNAL); }
  void end() const { shutdown(socket, SHUT_WR); }
};
struct OfClient {
  int socket;
  TlsStream* tls;
  ssize_t read(char* bytes, std::size_t size) const {
    return tls != nullptr ? tls->read(bytes, size) : recv(socket, bytes, size, 0);
  }
  ssize_t write(const char* bytes, std::size_t size) const {
    return tls != nullptr ? tls->write(bytes, size) : send(socket, bytes, size, MSG_NOSIGNAL);
  }
  void end() const {
    if (tls != nullptr) tls->end();
    shutdown(socket, SHUT_WR);
  }
};

}  // namespace

Relay::Connection::Connection(Descriptor of_client, Descriptor of_inner, std::atomic<std::uint64_t>& half_sent,
                              const Http2Meter::Messages& messages)
    : client(std::move(of_client)),
      inner(std::move(of_inner)),
      address(address_of_peer(client.get())),
      meter(half_sent, messages, Clock::now()),
      idle_since(Clock::now()) {}

Relay::Relay(Admit admit, Refuse refuse, RelayGuard guard, Http2Meter::Messages messages)
    : admit_(std::move(admit)),
      refuse_(std::move(refuse)),
      guard_(std::move(guard)),
      messages_(std::move(messages)),
      poll_(epoll_create1(EPOLL_CLOEXEC)),
      wake_(eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {
  epoll_event event{.events = EPOLLIN, .data = {.u64 = kWakeKey}};
  epoll_ctl(poll_.get(), EPOLL_CTL_ADD, wake_.get(), &event);
  thread_ = std::thread([this] { run(); });
}

Relay::~Relay() {
  stopping_ = true;
  eventfd_write(wake_.get(), 1);
  thread_.join();
}

void Relay::add(int descriptor) {
  auto connection = std::make_unique<Connection>(Descriptor(descriptor), Descriptor(), half_sent_, messages_);
  if (guard_.tls != nullptr) {
    connection->tls = std::make_unique<TlsStream>(*guard_.tls, connection->client.get());
    connection->shakes_hands_until = Clock::now() + kHandshakeTimeout;
  } else if (count_.load() < limits::kMaxControlConnections && !connect_inner(*connection)) {
    return;
  }
  {
    const std::lock_guard lock(mutex_);
    new_.push_back(std::move(connection));
  }
  eventfd_write(wake_.get(), 1);
}

bool Relay::connect_inner(Connection& connection) {
  if (count_.load() >= limits::kMaxControlConnections && !make_room()) {
    refuse_(connection.who(), "more than kMaxControlConnections connections, each with a call");
    return false;
  }
  int ends[2] = {-1, -1};
  // Without descriptors the client is closed, as it is when accept fails.
  if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends) != 0) return false;
  connection.inner = Descriptor(ends[0]);
  Descriptor theirs(ends[1]);
  // Without keys the name is for the log alone.
  if (!name_socket(ends[0], connection.who()) && connection.tls) return false;
  connection.counted = true;
  count_.fetch_add(1);
  admit_(theirs.release());
  return true;
}

bool Relay::make_room() {
  auto idle = connections_.end();
  for (auto each = connections_.begin(); each != connections_.end(); ++each) {
    const Connection& one = *each->second;
    if (!one.counted || one.idle_since == Clock::time_point::max()) continue;
    if (idle == connections_.end() || one.idle_since < idle->second->idle_since) idle = each;
  }
  if (idle == connections_.end()) return false;
  constexpr std::string_view kWhy =
      "more than kMaxControlConnections connections; the one without a call for longest made room";
  say_goodbye(*idle->second, kWhy);
  refuse_(idle->second->who(), kWhy);
  close(idle);
  return true;
}

std::string Relay::name_of_peer(std::string_view peer) {
  const std::size_t at = peer.find(kPeerPrefix);
  if (!peer.starts_with("unix-abstract:") || at != std::string_view("unix-abstract:").size()) return {};
  const std::size_t id = at + kPeerPrefix.size() + kPeerDigits + 1;
  return id < peer.size() ? std::string(peer.substr(id)) : std::string();
}

double thread_cpu_s() {
  timespec used{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
  return static_cast<double>(used.tv_sec) + 1e-9 * static_cast<double>(used.tv_nsec);
}

std::string_view Relay::charge(const Connection& connection) {
  if (guard_.tls == nullptr) return {};
  const double before = std::exchange(charged_cpu_s_, guard_.cpu_s());
  if (connection.key == nullptr) return {};
  Http2Meter::Bucket& left = connection.key->budget->cpu;
  if (left.spend(charged_cpu_s_ - before, limits::kMaxRelayCpuAtOnceS, limits::kMaxRelayCpuShare, Clock::now()))
    return {};
  return "more than kMaxRelayCpuShare of the relay's CPU time for one key";
}

void Relay::run() {
  name_thread("relay");
  std::array<epoll_event, 64> events;
  while (!stopping_) {
    const int period_ms = static_cast<int>(std::chrono::milliseconds(kCheckPeriod).count());
    const int ready = epoll_wait(poll_.get(), events.data(), static_cast<int>(events.size()),
                                 connections_.empty() && leaving_.empty() ? -1 : period_ms);
    if (guard_.tls != nullptr) charged_cpu_s_ = guard_.cpu_s();
    try {
      for (int i = 0; i < ready; ++i) {
        const std::uint64_t key = events[static_cast<std::size_t>(i)].data.u64;
        if (key == kWakeKey) {
          take_new();
          continue;
        }
        // Gone or leaving, if its other socket was served in this turn.
        const auto found = connections_.find(key / 2);
        if (found == connections_.end()) {
          discard(key / 2);
          continue;
        }
        Outcome outcome = carry(*found->second);
        if (const std::string_view why = charge(*found->second); !why.empty() && outcome == Outcome::kGoesOn) {
          say_goodbye(*found->second, why);
          refuse_(found->second->who(), why);
          outcome = Outcome::kEnded;
        }
        if (outcome == Outcome::kGoesOn) {
          wait_for(found->first, *found->second);
        } else {
          close(found);
        }
      }
      if (Clock::now() >= next_check_) check_time();
    } catch (const std::bad_alloc&) {
      // A stream for which there is no memory: the connection that asked for it goes on with the next event, or ends.
    }
  }
}

void Relay::take_new() {
  eventfd_t count;
  eventfd_read(wake_.get(), &count);
  std::vector<std::unique_ptr<Connection>> taken;
  {
    const std::lock_guard lock(mutex_);
    taken.swap(new_);
  }
  for (std::unique_ptr<Connection>& connection : taken) {
    if (connection->tls) {
      make_room_to_shake_hands();
    } else if (connection->inner.get() < 0 && !connect_inner(*connection)) {
      continue;
    }
    const std::uint64_t id = next_id_++;
    const auto added = connections_.emplace(id, std::move(connection)).first;
    wait_for(id, *added->second);
  }
}

void Relay::make_room_to_shake_hands() {
  const auto shakes_hands = [](const auto& entry) { return !entry.second->counted; };
  const auto count = std::count_if(connections_.begin(), connections_.end(), shakes_hands);
  if (static_cast<std::size_t>(count) < limits::kMaxShaking) return;
  const auto oldest = std::find_if(connections_.begin(), connections_.end(), shakes_hands);
  refuse_(oldest->second->who(), "more than kMaxShaking peers that shake hands; the oldest made room");
  close(oldest);
}

Relay::Connections::iterator Relay::close(Connections::iterator connection) {
  if (connection->second->counted) count_.fetch_sub(1);
  if (connection->second->key != nullptr) --connection->second->key->connections;
  if (connection->second->told) let_leave(connection->first, *connection->second);
  return connections_.erase(connection);
}

void Relay::let_leave(std::uint64_t id, Connection& connection) {
  if (leaving_.size() >= limits::kMaxLeaving) return;
  const int descriptor = connection.client.get();
  shutdown(descriptor, SHUT_WR);
  watch(2 * id, descriptor, connection.client_events, EPOLLIN);
  leaving_.emplace(id, Leaving{std::move(connection.client), Clock::now() + limits::kLeaveTime});
}

void Relay::discard(std::uint64_t id) {
  const auto leaving = leaving_.find(id);
  if (leaving == leaving_.end()) return;
  std::array<char, std::size_t{16} << 10> bytes;
  for (int turn = 0; turn < kBuffersPerTurn; ++turn) {
    const ssize_t size = recv(leaving->second.client.get(), bytes.data(), bytes.size(), 0);
    if (size > 0) continue;
    if (size == 0 || !would_block()) leaving_.erase(leaving);
    return;
  }
}

Relay::Outcome Relay::carry(Connection& connection) {
  if (connection.inner.get() < 0) {
    const Outcome shaken = shake_hands(connection);
    if (shaken == Outcome::kEnded || connection.inner.get() < 0) return shaken;
  }
  const Clock::time_point now = Clock::now();
  const OfClient client{connection.client.get(), connection.tls.get()};
  const Plain inner{connection.inner.get()};
  // The answers first: they say which calls have ended.
  const Outcome out = carry(inner, client, connection.out, connection.who(), [&](std::string_view bytes) {
    connection.meter.from_server(bytes);
    return std::string_view();
  });
  if (out == Outcome::kEnded) return out;
  const Outcome in = carry(client, inner, connection.in, connection.who(), [&](std::string_view bytes) {
    std::string_view why = connection.meter.from_client(bytes, now);
    if (why.empty()) why = make_room_for_messages(connection);
    if (!why.empty()) say_goodbye(connection, why);
    return why;
  });
  if (connection.meter.stream_count() > 0) {
    connection.idle_since = Clock::time_point::max();
  } else if (connection.idle_since == Clock::time_point::max()) {
    connection.idle_since = now;
  }
  // gRPC ends both ways at once, as soon as the client has ended its own.
  return connection.out.passed_on ? Outcome::kEnded : in;
}

std::string_view Relay::make_room_for_messages(const Connection& active) {
  constexpr std::string_view kWhy =
      "half-sent messages of more than --max-message-mib; the one that waited with most made room";
  const Clock::time_point now = Clock::now();
  while (half_sent_.load() > messages_.max_bytes) {
    const auto holds_less = [now](const auto& a, const auto& b) {
      return a.second->meter.held_byte_s(now) < b.second->meter.held_byte_s(now);
    };
    const auto most = std::max_element(connections_.begin(), connections_.end(), holds_less);
    if (most == connections_.end() || most->second.get() == &active || !(most->second->meter.held_byte_s(now) > 0)) {
      return kWhy;
    }
    say_goodbye(*most->second, kWhy);
    refuse_(most->second->who(), kWhy);
    close(most);
  }
  return {};
}

void Relay::say_goodbye(Connection& connection, std::string_view why) {
  if (connection.inner.get() < 0 || !connection.out.empty() || !connection.meter.server_is_between_frames()) return;
  // RFC 9113, section 6.8: GOAWAY, which all calls so far outlive; ENHANCE_YOUR_CALM, and a text.
  constexpr std::string_view kHeader("\x07\0\0\0\0\0", 6), kLastCall("\x7f\xff\xff\xff", 4), kCalm("\0\0\0\x0b", 4);
  std::string frame(1, '\0');
  const std::size_t size = kLastCall.size() + kCalm.size() + why.size();
  frame += static_cast<char>(size >> 8);
  frame += static_cast<char>(size);
  frame.append(kHeader).append(kLastCall).append(kCalm).append(why);
  // If the socket is full, the client learns less.
  const ssize_t written = OfClient{connection.client.get(), connection.tls.get()}.write(frame.data(), frame.size());
  connection.told = written == static_cast<ssize_t>(frame.size());
}

Relay::Outcome Relay::shake_hands(Connection& connection) {
  switch (connection.tls->shake_hands()) {
    case TlsStream::Handshake::kGoesOn:
      return Outcome::kGoesOn;
    case TlsStream::Handshake::kFailed:
      refuse_(connection.who(), fmt::format("a peer without a valid key: {}", connection.tls->failure()));
      return Outcome::kEnded;
    case TlsStream::Handshake::kDone:
      break;
  }
  connection.shakes_hands_until = Clock::time_point::max();
  connection.id = connection.tls->peer_name();
  if (!guard_.knows(connection.id)) {
    refuse_(connection.who(), "a peer whose key was removed or has expired");
    return Outcome::kEnded;
  }
  return join_key(connection) && connect_inner(connection) ? Outcome::kGoesOn : Outcome::kEnded;
}

bool Relay::join_key(Connection& connection) {
  std::shared_ptr<Key>& key = keys_[connection.id];
  if (key == nullptr) key = std::make_shared<Key>(Key{std::make_shared<Http2Meter::Budget>(Clock::now())});
  if (key->connections >= limits::kMaxConnectionsPerKey) {
    refuse_(connection.who(), "more than kMaxConnectionsPerKey connections of one key");
    return false;
  }
  connection.key = key;
  ++key->connections;
  connection.meter.share(key->budget);
  return true;
}

template <class From, class To, class Taken>
Relay::Outcome Relay::carry(const From& from, const To& to, Buffer& buffer, std::string_view who, const Taken& taken) {
  for (int turn = 0; turn < kBuffersPerTurn; ++turn) {
    if (buffer.empty() && !buffer.source_ended) {
      const ssize_t size = from.read(buffer.bytes.data(), buffer.bytes.size());
      if (size < 0) return would_block() ? Outcome::kGoesOn : Outcome::kEnded;
      buffer.begin = 0;
      buffer.end = static_cast<std::size_t>(size);
      buffer.source_ended = size == 0;
      if (const std::string_view why = taken(buffer.view()); !why.empty()) {
        refuse_(who, why);
        return Outcome::kEnded;
      }
    }
    while (!buffer.empty()) {
      const ssize_t size = to.write(buffer.view().data(), buffer.view().size());
      if (size < 0) return would_block() ? Outcome::kGoesOn : Outcome::kEnded;
      buffer.begin += static_cast<std::size_t>(size);
    }
    if (!buffer.source_ended) continue;
    if (!std::exchange(buffer.passed_on, true)) to.end();
    return Outcome::kGoesOn;
  }
  return Outcome::kGoesOn;
}

void Relay::wait_for(std::uint64_t id, Connection& connection) {
  const auto wanted = [](const Buffer& from, const Buffer& to) {
    const bool reads = from.empty() && !from.source_ended;
    return (reads ? std::uint32_t{EPOLLIN} : 0u) | (to.empty() ? 0u : std::uint32_t{EPOLLOUT});
  };
  std::uint32_t of_client = wanted(connection.in, connection.out);
  if (connection.inner.get() < 0) {
    of_client = connection.tls->waits_to_write() ? EPOLLOUT : EPOLLIN;
    return watch(2 * id, connection.client.get(), connection.client_events, of_client);
  }
  if (connection.tls && connection.tls->waits_to_write()) of_client |= EPOLLOUT;
  watch(2 * id, connection.client.get(), connection.client_events, of_client);
  watch(2 * id + 1, connection.inner.get(), connection.inner_events, wanted(connection.out, connection.in));
}

/// Tells epoll what to wait for. A socket for which nothing is awaited leaves it: epoll reports a hang-up all the time.
void Relay::watch(std::uint64_t key, int descriptor, std::uint32_t& present, std::uint32_t wanted) {
  if (present == wanted) return;
  epoll_event event{.events = wanted, .data = {.u64 = key}};
  const int change = wanted == 0 ? EPOLL_CTL_DEL : present == 0 ? EPOLL_CTL_ADD : EPOLL_CTL_MOD;
  epoll_ctl(poll_.get(), change, descriptor, &event);
  present = wanted;
}

void Relay::check_time() {
  const Clock::time_point now = Clock::now();
  next_check_ = now + kCheckPeriod;
  for (auto connection = connections_.begin(); connection != connections_.end();) {
    Connection& one = *connection->second;
    std::string_view why = one.meter.at(now);
    if (why.empty() && now >= one.shakes_hands_until) why = "a peer that did not end TLS's handshake in time";
    if (why.empty() && one.tls && !one.id.empty() && !guard_.knows(one.id)) {
      why = "a client whose key was removed or has expired";
    }
    if (why.empty()) {
      ++connection;
      continue;
    }
    refuse_(one.who(), why);
    connection = close(connection);
  }
  std::erase_if(leaving_, [now](const auto& entry) { return now >= entry.second.until; });
  std::erase_if(keys_,
                [this](const auto& entry) { return entry.second->connections == 0 && !guard_.knows(entry.first); });
}

}  // namespace tensormass::control
