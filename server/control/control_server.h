#pragma once

#include <memory>
#include <string>

#include <grpcpp/server.h>

#include "control/control_service.h"
#include "core/result.h"

namespace tensormass::control {

/// The control service on its port, with health and reflection.
class ControlServer {
 public:
  /// `address` is host:port; port 0 takes a free one. `service` outlives the server. kUnavailable if the port is taken.
  static Result<std::unique_ptr<ControlServer>> start(const std::string& address, ControlService& service);
  /// Waits for the calls that run, for a second at most; then they are cancelled.
  ~ControlServer();

  /// host:port, with the port that was chosen.
  const std::string& endpoint() const { return endpoint_; }
  /// Health says NOT_SERVING from now on, so that nobody sends new work here.
  void announce_shutdown();

 private:
  ControlServer(std::unique_ptr<grpc::Server> server, std::string endpoint);
  std::unique_ptr<grpc::Server> server_;
  std::string endpoint_;
};

}  // namespace tensormass::control
