#pragma once

#include <chrono>
#include <optional>
#include <string>
#include <string_view>

namespace tensormass::daemon {

/// Tells systemd, or whoever started the daemon with NOTIFY_SOCKET, how it is: the protocol of sd_notify(3). Without
/// that variable it tells nobody. Any thread may call the methods; none of them blocks.
class ServiceManager {
 public:
  /// Reads NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID.
  ServiceManager();
  ~ServiceManager();
  ServiceManager(const ServiceManager&) = delete;
  ServiceManager& operator=(const ServiceManager&) = delete;

  /// state: lines as "READY=1"; dropped if the manager does not take it at once
  void tell(std::string_view state) const;
  /// Time within which the manager expects "WATCHDOG=1". No value: it expects none.
  std::optional<std::chrono::microseconds> watchdog() const { return watchdog_; }

 private:
  std::string address_;  // bytes of a sockaddr_un; empty: nobody
  int socket_ = -1;
  std::optional<std::chrono::microseconds> watchdog_;
};

}  // namespace tensormass::daemon
