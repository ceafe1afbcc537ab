#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "access/client_list.h"
#include "core/result.h"

namespace tensormass::access {

/// The daemon's own keys, as daemon.json has them.
struct DaemonKeys {
  std::string certificate_pem, private_key_pem;
  std::string authority_pem;               ///< certificate of those who made all keys
  std::string curve_public, curve_secret;  ///< ZeroMQ's, as Z85
};

/// The folder of `tensormassd --keys`, followed while the daemon runs.
///
///     folder/daemon.json    read once: keys of the daemon
///     folder/clients.json   read at the start and after each change: who has a key, and which role
///
///     thread: every kPeriod ─ changed? ─ read ─┬─ good ──> the new list counts
///                                              ├─ broken ──> a line in the log; the list before counts
///                                              └─ missing or unreadable ──> the same, and read again every kPeriod
///             who counts has changed, by the file or by the clock ──> on_change()
///
/// A client that is not in the list, or whose key has expired, is nobody. All methods may be called from any thread.
class KeyRing {
 public:
  /// Reads both files. Fails with kInvalidArgument, and names file and remedy, if one is missing, broken, expired or
  /// readable by everybody.
  static Result<std::unique_ptr<KeyRing>> open(const std::string& folder);
  ~KeyRing();

  const DaemonKeys& daemon() const { return daemon_; }
  /// Returns the client with this id; nullptr if its key was removed or has expired, or never was.
  ClientPtr find(std::string_view id) const;
  /// The same for a public key of ZeroMQ in Z85.
  ClientPtr find_curve(std::string_view curve_public) const;
  /// All clients that count now.
  std::vector<ClientPtr> list() const;
  /// Starts the thread. Call it once.
  /// on_change: bool(), called on the thread whenever others count than before. It is called again in each period until
  /// it returns true; false, or an exception: not everything follows yet.
  void follow(std::function<bool()> on_change);
  /// Ends the thread. May be called again.
  void stop();

 private:
  KeyRing(std::string folder, DaemonKeys daemon, ClientList clients, std::uint64_t seen);
  void run(const std::function<bool()>& on_change);
  void read_again();

  const std::string folder_;
  const DaemonKeys daemon_;
  mutable std::mutex mutex_;
  ClientList clients_;  // guarded by mutex_
  // The thread's own: signatures of the file that was read last, and of the one about which the log says why it cannot
  // be used.
  std::uint64_t seen_;
  std::optional<std::uint64_t> told_;
  std::condition_variable wake_;
  bool stopping_ = false;  // guarded by mutex_
  std::thread thread_;
};

}  // namespace tensormass::access
