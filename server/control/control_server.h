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

/// The control service on its port, with health and reflection.
class ControlServer {
 public:
  /// `address` is host:port; port 0 takes a free one. `service` outlives the server. kUnavailable if the port is taken.
  /// `on_refused` is told, on a thread of the server, of each connection that does not speak HTTP/2.
  static Result<std::unique_ptr<ControlServer>> start(const std::string& address, ControlService& service,
                                                      std::function<void()> on_refused);
  /// Waits a moment for the calls that run; then they are cancelled.
  ~ControlServer();

  /// host:port, with the port that was chosen.
  const std::string& endpoint() const { return doorkeeper_->endpoint(); }
  /// Health says NOT_SERVING from now on, so that nobody sends new work here.
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
