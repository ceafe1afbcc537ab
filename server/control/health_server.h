#pragma once

#include <functional>
#include <memory>
#include <string>
#include <string_view>

#include "control/relay.h"
#include "core/result.h"

namespace tensormass::control {

/// gRPC's health service alone, on a port of its own and without keys: for a kubelet or a load balancer, which have
/// none. Who connects learns whether the daemon is "live" and "ready", and nothing else. The connections have the
/// limits of the control plane (doorkeeper.h, relay.h).
class HealthServer {
 public:
  /// Listens on `address`, HOST:PORT. Every name but "" is unknown until `set`. Call it before ControlServer::start:
  /// servers that gRPC makes after that one have its reflection service.
  /// on_refused(who, why): called for each connection that is not HTTP/2 or passes a limit; must not block
  /// Fails with kUnavailable if the address cannot be listened on.
  static Result<std::unique_ptr<HealthServer>> start(const std::string& address, const Relay::Refuse& on_refused);
  ~HealthServer();

  void set(const std::string& name, bool serving);
  const std::string& endpoint() const;

 private:
  struct Parts;  // gRPC's classes, whose headers take seconds to compile
  explicit HealthServer(std::unique_ptr<Parts> parts);
  std::unique_ptr<Parts> parts_;
};

}  // namespace tensormass::control
