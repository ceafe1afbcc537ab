#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "access/key_ring.h"
#include "control/scene_registry.h"
#include "core/journal.h"
#include "core/result.h"

namespace tensormass::v1 {
class GetVersionResponse;
}

namespace tensormass::control {

/// The gRPC server on its port: the control service, gRPC's health service and its reflection service.
///
///     client ──> Doorkeeper ──admit──> Relay ──> gRPC ──> a gRPC thread per running call ──> ControlService
///                     │                  │                       └─ an error ──> on_refused.call
///                     │                  ├─ beyond a limit of HTTP/2, or without a valid key ──> on_refused.connection
///                     │                  └─ with keys: TLS ends here
///                     └─ not HTTP/2 ──> on_refused.connection
///
/// A running call occupies one of gRPC's threads. Calls beyond limits::kMaxControlThreads fail with
/// RESOURCE_EXHAUSTED; long ones before that (call_share.h).
class ControlServer {
 public:
  struct OnRefused {
    /// A connection that does not speak HTTP/2, or that passes a limit: the client's id or address, and the reason.
    std::function<void(std::string_view who, std::string_view why)> connection;
    /// A call that was answered with an error. by_role: the client's key has no right to it. nullptr: nobody is told.
    std::function<void(bool by_role, const Refused& call)> call = nullptr;
  };
  /// Listens on `address`, HOST:PORT; port 0 takes a free one. `registry` must outlive the server. GetVersion answers
  /// `identity`. Fails with kUnavailable if the address cannot be listened on.
  ///
  ///   malformed_count()   returns what GetVersion adds to `identity`; called on gRPC's threads
  ///   keys                who may connect and call; must outlive the server. nullptr: everybody, in plain text
  ///   metrics()           returns the answer of GetMetrics; called on gRPC's threads
  ///   on_refused          called on threads of doorkeeper, relay and gRPC; must not block
  static Result<std::unique_ptr<ControlServer>> start(
      const std::string& address, SceneRegistry& registry, const v1::GetVersionResponse& identity,
      std::function<std::uint64_t()> malformed_count, const OnRefused& on_refused,
      const access::KeyRing* keys = nullptr, std::function<std::string()> metrics = [] { return std::string(); });
  /// Stops listening, waits at most kDrainTime for running calls, then cancels them.
  ~ControlServer();

  /// HOST:PORT that clients connect to, with the port that was chosen.
  const std::string& endpoint() const;
  /// Says what the health service answers for a name: SERVING, or NOT_SERVING. Without a call for it, "" is SERVING and
  /// every other name is unknown.
  void set_health(const std::string& name, bool serving);
  /// Makes the health service answer NOT_SERVING for every name, so that load balancers send no new work here. Calls
  /// still work.
  void announce_shutdown();

 private:
  struct Parts;  // gRPC's classes, whose headers take seconds to compile
  explicit ControlServer(std::unique_ptr<Parts> parts);

  std::unique_ptr<Parts> parts_;
};

}  // namespace tensormass::control
