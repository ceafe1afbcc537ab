#pragma once

#include <functional>
#include <memory>
#include <string>

#include <grpcpp/server.h>
#include <grpcpp/server_builder.h>

#include "control/control_service.h"
#include "control/doorkeeper.h"
#include "core/result.h"

namespace tensormass::control {

/// The gRPC server on its port: the control service, gRPC's health service and its reflection service.
///
///     client ──> Doorkeeper's thread ──admit──> gRPC ──> a gRPC thread per running call ──> ControlService
///                     └─ not HTTP/2 ──> on_refused()
///
/// A running call occupies one of gRPC's threads. Calls beyond kMaxThreads fail with RESOURCE_EXHAUSTED.
class ControlServer {
 public:
  /// Listens on `address`, HOST:PORT; port 0 takes a free one. `service` must outlive the server. `on_refused` is
  /// called for each connection that does not speak HTTP/2, on the doorkeeper's thread; it must not block. Fails with
  /// kUnavailable if the address cannot be listened on.
  static Result<std::unique_ptr<ControlServer>> start(const std::string& address, ControlService& service,
                                                      std::function<void()> on_refused);
  /// Stops listening, waits at most kDrainTime for running calls, then cancels them.
  ~ControlServer();

  /// HOST:PORT that clients connect to, with the port that was chosen.
  const std::string& endpoint() const { return doorkeeper_->endpoint(); }
  /// Makes the health service answer NOT_SERVING, so that load balancers send no new work here. Calls still work.
  void announce_shutdown();

 private:
  using Acceptor = std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor>;
  ControlServer(std::unique_ptr<grpc::Server> server, Acceptor acceptor, std::unique_ptr<Doorkeeper> doorkeeper,
                std::function<void()> on_refused);

  std::unique_ptr<grpc::Server> server_;
  Acceptor acceptor_;
  std::unique_ptr<Doorkeeper> doorkeeper_;
};

}  // namespace tensormass::control
