#include "control/doorkeeper.h"

#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <new>
#include <string_view>
#include <utility>

#include <fmt/format.h>

#include "core/peer_address.h"
#include "core/thread_name.h"

namespace tensormass::control {
namespace {

using Clock = std::chrono::steady_clock;

/// The first bytes of every HTTP/2 connection (RFC 9113, section 3.4).
constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
/// The first bytes of every TLS connection: a record of its handshake, in a version that starts with 3. A record is
/// longer than the preface of HTTP/2, so both wait for as many bytes.
constexpr std::string_view kTlsRecord = "\x16\x03";
/// Time for the preface to arrive.
constexpr std::chrono::seconds kPrefaceTimeout{3};
/// Time without polling the listener after accept failed.
constexpr std::chrono::milliseconds kAcceptPause{100};
/// Connections whose preface has not arrived. When one more comes, the oldest is refused.
constexpr std::size_t kMaxWaiting = 64;
/// Connections in the kernel's queue before accept.
constexpr int kBacklog = 128;

Error cannot_listen(const std::string& address, const char* why) {
  return {ErrorCode::kUnavailable,
          fmt::format("cannot listen on '{}' for gRPC: {}; give another HOST:PORT, or port 0 for a free one", address,
                      why)};
}

struct AddressList {
  ~AddressList() {
    if (first != nullptr) freeaddrinfo(first);
  }
  addrinfo* first = nullptr;
};

std::uint16_t port_of(int socket) {
  sockaddr_storage bound{};
  socklen_t size = sizeof(bound);
  getsockname(socket, reinterpret_cast<sockaddr*>(&bound), &size);
  return ntohs(bound.ss_family == AF_INET6 ? reinterpret_cast<const sockaddr_in6&>(bound).sin6_port
                                           : reinterpret_cast<const sockaddr_in&>(bound).sin_port);
}

void set_option(int socket, int level, int option, int value) {
  setsockopt(socket, level, option, &value, sizeof(value));
}

}  // namespace

Descriptor& Descriptor::operator=(Descriptor&& other) noexcept {
  std::swap(descriptor_, other.descriptor_);
  return *this;
}

Descriptor::~Descriptor() {
  if (descriptor_ >= 0) close(descriptor_);
}

int Descriptor::release() { return std::exchange(descriptor_, -1); }

Result<std::unique_ptr<Doorkeeper>> Doorkeeper::listen(const std::string& address) {
  const std::size_t colon = address.rfind(':');
  if (colon == std::string::npos) return tl::make_unexpected(cannot_listen(address, "no port in it"));
  std::string host = address.substr(0, colon);
  if (host.starts_with('[') && host.ends_with(']')) host = host.substr(1, host.size() - 2);

  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  hints.ai_flags = AI_PASSIVE | AI_NUMERICSERV;
  AddressList addresses;
  const int failure = getaddrinfo(host.c_str(), address.substr(colon + 1).c_str(), &hints, &addresses.first);
  if (failure != 0) return tl::make_unexpected(cannot_listen(address, gai_strerror(failure)));
  int error = 0;
  for (const addrinfo* info = addresses.first; info != nullptr; info = info->ai_next) {
    Descriptor listener(::socket(info->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
    // Lets a restarted daemon bind while the kernel still holds the old daemon's closed connections (TIME_WAIT).
    set_option(listener.get(), SOL_SOCKET, SO_REUSEADDR, 1);
    if (::bind(listener.get(), info->ai_addr, info->ai_addrlen) != 0 || ::listen(listener.get(), kBacklog) != 0) {
      error = errno;
      continue;
    }
    std::string endpoint = fmt::format("{}:{}", address.substr(0, colon), port_of(listener.get()));
    return std::unique_ptr<Doorkeeper>(new Doorkeeper(std::move(listener), std::move(endpoint)));
  }
  return tl::make_unexpected(cannot_listen(address, std::strerror(error)));
}

Doorkeeper::Doorkeeper(Descriptor listener, std::string endpoint)
    : listener_(std::move(listener)), stop_(eventfd(0, EFD_CLOEXEC)), endpoint_(std::move(endpoint)) {}

Doorkeeper::~Doorkeeper() {
  if (!thread_.joinable()) return;
  eventfd_write(stop_.get(), 1);
  thread_.join();
}

void Doorkeeper::open(Admit admit, Refuse refuse, Opening opening) {
  opening_ = opening;
  admit_ = std::move(admit);
  refuse_ = std::move(refuse);
  thread_ = std::thread([this] { run(); });
}

void Doorkeeper::run() {
  name_thread("doorkeeper");
  std::vector<pollfd> items;
  while (true) {
    try {
      if (!serve(items)) return;
    } catch (const std::bad_alloc&) {
      // A connection for which there is no memory is closed; the others wait.
    }
  }
}

bool Doorkeeper::serve(std::vector<pollfd>& items) {
  const bool accepts = Clock::now() >= accept_after_;
  items.assign({{stop_.get(), POLLIN, 0}, {listener_.get(), static_cast<short>(accepts ? POLLIN : 0), 0}});
  for (const Connection& connection : waiting_) items.push_back({connection.socket.get(), POLLIN, 0});
  const int timeout_ms = static_cast<int>(std::chrono::milliseconds(kPrefaceTimeout).count());
  const int pause_ms = static_cast<int>(std::chrono::milliseconds(kAcceptPause).count());
  poll(items.data(), items.size(), !accepts ? pause_ms : waiting_.empty() ? -1 : timeout_ms);
  if (items[0].revents != 0) return false;
  const Clock::time_point now = Clock::now();
  // From the back, so that erasing one does not move those that follow in the loop.
  for (std::size_t i = waiting_.size(); i-- > 0;) {
    if (decide(waiting_[i], items[i + 2].revents != 0, now)) {
      waiting_.erase(waiting_.begin() + static_cast<std::ptrdiff_t>(i));
    }
  }
  if (items[1].revents != 0) accept_connections(now);
  return true;
}

void Doorkeeper::accept_connections(Clock::time_point now) {
  while (true) {
    Descriptor socket(accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (socket.get() < 0) {
      if (errno != EAGAIN && errno != ECONNABORTED && errno != EINTR) accept_after_ = now + kAcceptPause;
      return;
    }
    // poll then reports the socket when the whole preface is there, or when the peer closed it.
    set_option(socket.get(), SOL_SOCKET, SO_RCVLOWAT, static_cast<int>(kPreface.size()));
    if (waiting_.size() >= kMaxWaiting) {
      // The preface may be there, though nobody has looked: many may connect between two looks.
      if (try_admit(waiting_.front())) refuse_(address_of_peer(waiting_.front().socket.get()));
      waiting_.erase(waiting_.begin());
    }
    waiting_.push_back({std::move(socket), Clock::now() + kPrefaceTimeout});
  }
}

bool Doorkeeper::decide(Connection& connection, bool is_readable, Clock::time_point now) {
  if (!is_readable && now < connection.deadline) return false;
  // No bytes at all: the peer only tested whether the port is open. It is closed, and not refused.
  if (try_admit(connection).value_or(0) > 0) refuse_(address_of_peer(connection.socket.get()));
  return true;
}

std::optional<std::size_t> Doorkeeper::try_admit(Connection& connection) {
  std::array<char, kPreface.size()> received;
  const ssize_t size = recv(connection.socket.get(), received.data(), received.size(), MSG_PEEK);
  const std::string_view start(received.data(), received.size());
  if (size != static_cast<ssize_t>(kPreface.size()) ||
      !(opening_ == Opening::kTls ? start.starts_with(kTlsRecord) : start == kPreface)) {
    return static_cast<std::size_t>(std::max<ssize_t>(size, 0));
  }
  set_option(connection.socket.get(), SOL_SOCKET, SO_RCVLOWAT, 1);
  set_option(connection.socket.get(), IPPROTO_TCP, TCP_NODELAY, 1);
  admit_(connection.socket.release());
  return std::nullopt;
}

}  // namespace tensormass::control
