#include "control/relay.h"

#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>

#include <cerrno>
#include <new>
#include <utility>

namespace tensormass::control {
namespace {

using Clock = std::chrono::steady_clock;

/// Time between two checks of what must not last.
constexpr std::chrono::seconds kCheckPeriod{1};
/// Buffers that one connection fills in a row before the others have their turn.
constexpr int kBuffersPerTurn = 8;
/// Key of the wake-up in epoll; a connection n has the keys 2 n for its client and 2 n + 1 for gRPC.
constexpr std::uint64_t kWakeKey = 0;

bool would_block() { return errno == EAGAIN || errno == EINTR; }

}  // namespace

Relay::Connection::Connection(Descriptor of_client, Descriptor of_inner, std::atomic<std::uint64_t>& half_sent)
    : client(std::move(of_client)), inner(std::move(of_inner)), meter(half_sent, Clock::now()) {}

Relay::Relay(Admit admit, Refuse refuse)
    : admit_(std::move(admit)),
      refuse_(std::move(refuse)),
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
  Descriptor client(descriptor);
  if (count_.load() >= limits::kMaxControlConnections) return refuse_("more than kMaxControlConnections connections");
  int ends[2] = {-1, -1};
  // Without descriptors the client is closed, as it is when accept fails.
  if (socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends) != 0) return;
  Descriptor ours(ends[0]), theirs(ends[1]);
  {
    const std::lock_guard lock(mutex_);
    new_.push_back(std::make_unique<Connection>(std::move(client), std::move(ours), half_sent_));
  }
  count_.fetch_add(1);
  eventfd_write(wake_.get(), 1);
  admit_(theirs.release());
}

void Relay::run() {
  std::array<epoll_event, 64> events;
  while (!stopping_) {
    const int period_ms = static_cast<int>(std::chrono::milliseconds(kCheckPeriod).count());
    const int ready =
        epoll_wait(poll_.get(), events.data(), static_cast<int>(events.size()), connections_.empty() ? -1 : period_ms);
    try {
      for (int i = 0; i < ready; ++i) {
        const std::uint64_t key = events[static_cast<std::size_t>(i)].data.u64;
        if (key == kWakeKey) {
          take_new();
          continue;
        }
        // Gone, if its other socket was served in this turn.
        const auto found = connections_.find(key / 2);
        if (found == connections_.end()) continue;
        if (carry(*found->second) == Outcome::kGoesOn) {
          wait_for(found->first, *found->second);
        } else {
          connections_.erase(found);
          count_.fetch_sub(1);
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
    const std::uint64_t id = next_id_++;
    const auto added = connections_.emplace(id, std::move(connection)).first;
    wait_for(id, *added->second);
  }
}

Relay::Outcome Relay::carry(Connection& connection) {
  const Clock::time_point now = Clock::now();
  const int client = connection.client.get(), inner = connection.inner.get();
  // The answers first: they say which calls have ended.
  const Outcome out = carry(inner, client, connection.out, [&](std::string_view bytes) {
    connection.meter.from_server(bytes);
    return std::string_view();
  });
  if (out == Outcome::kEnded) return out;
  const Outcome in = carry(client, inner, connection.in,
                           [&](std::string_view bytes) { return connection.meter.from_client(bytes, now); });
  // gRPC ends both ways at once, as soon as the client has ended its own.
  return connection.out.passed_on ? Outcome::kEnded : in;
}

template <class Taken>
Relay::Outcome Relay::carry(int from, int to, Buffer& buffer, const Taken& taken) {
  for (int turn = 0; turn < kBuffersPerTurn; ++turn) {
    if (buffer.empty() && !buffer.source_ended) {
      const ssize_t size = recv(from, buffer.bytes.data(), buffer.bytes.size(), 0);
      if (size < 0) return would_block() ? Outcome::kGoesOn : Outcome::kEnded;
      buffer.begin = 0;
      buffer.end = static_cast<std::size_t>(size);
      buffer.source_ended = size == 0;
      if (const std::string_view why = taken(buffer.view()); !why.empty()) {
        refuse_(why);
        return Outcome::kEnded;
      }
    }
    while (!buffer.empty()) {
      const ssize_t size = send(to, buffer.view().data(), buffer.view().size(), MSG_NOSIGNAL);
      if (size < 0) return would_block() ? Outcome::kGoesOn : Outcome::kEnded;
      buffer.begin += static_cast<std::size_t>(size);
    }
    if (!buffer.source_ended) continue;
    if (!std::exchange(buffer.passed_on, true)) shutdown(to, SHUT_WR);
    return Outcome::kGoesOn;
  }
  return Outcome::kGoesOn;
}

void Relay::wait_for(std::uint64_t id, Connection& connection) {
  const auto wanted = [](const Buffer& from, const Buffer& to) {
    const bool reads = from.empty() && !from.source_ended;
    return (reads ? std::uint32_t{EPOLLIN} : 0u) | (to.empty() ? 0u : std::uint32_t{EPOLLOUT});
  };
  watch(2 * id, connection.client.get(), connection.client_events, wanted(connection.in, connection.out));
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
    const std::string_view why = connection->second->meter.at(now);
    if (why.empty()) {
      ++connection;
      continue;
    }
    refuse_(why);
    connection = connections_.erase(connection);
    count_.fetch_sub(1);
  }
}

}  // namespace tensormass::control
