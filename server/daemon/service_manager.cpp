#include "daemon/service_manager.h"

#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <charconv>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>

namespace tensormass::daemon {
namespace {

std::optional<std::uint64_t> number_in(const char* variable) {
  const char* const text = std::getenv(variable);
  if (text == nullptr) return std::nullopt;
  std::uint64_t number = 0;
  const char* const stop = text + std::strlen(text);
  const auto [end, failure] = std::from_chars(text, stop, number);
  return failure == std::errc{} && end == stop ? std::optional(number) : std::nullopt;
}

}  // namespace

ServiceManager::ServiceManager() {
  const char* const path = std::getenv("NOTIFY_SOCKET");
  sockaddr_un address{};
  // A path, or with @ a name of Linux's abstract sockets, which begins with a zero byte.
  if (path == nullptr || (path[0] != '/' && path[0] != '@') || std::strlen(path) >= sizeof(address.sun_path)) return;
  address.sun_family = AF_UNIX;
  std::memcpy(address.sun_path, path, std::strlen(path));
  if (path[0] == '@') address.sun_path[0] = '\0';
  socket_ = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  if (socket_ < 0) return;
  address_.assign(reinterpret_cast<const char*>(&address), offsetof(sockaddr_un, sun_path) + std::strlen(path));
  const auto pid = number_in("WATCHDOG_PID");
  const auto time_us = number_in("WATCHDOG_USEC");
  const bool ours = !pid || *pid == static_cast<std::uint64_t>(getpid());
  if (ours && time_us && *time_us > 0) watchdog_ = std::chrono::microseconds(*time_us);
}

ServiceManager::~ServiceManager() {
  if (socket_ >= 0) close(socket_);
}

void ServiceManager::tell(std::string_view state) const {
  if (socket_ < 0) return;
  sendto(socket_, state.data(), state.size(), MSG_NOSIGNAL | MSG_DONTWAIT,
         reinterpret_cast<const sockaddr*>(address_.data()), static_cast<socklen_t>(address_.size()));
}

}  // namespace tensormass::daemon
