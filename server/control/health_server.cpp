#include "control/health_server.h"

#include <chrono>
#include <utility>

#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include "control/doorkeeper.h"
#include "control/relay.h"
#include "core/control_limits.h"

namespace tensormass::control {

struct HealthServer::Parts {
  std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> acceptor = nullptr;
  std::unique_ptr<grpc::Server> server = nullptr;
  std::unique_ptr<Relay> relay = nullptr;
  std::unique_ptr<Doorkeeper> doorkeeper = nullptr;
};

Result<std::unique_ptr<HealthServer>> HealthServer::start(const std::string& address, const Relay::Refuse& on_refused) {
  grpc::EnableDefaultHealthCheckService(true);
  TM_ASSIGN_OR_RETURN(doorkeeper, Doorkeeper::listen(address));
  auto parts = std::make_unique<Parts>();
  parts->doorkeeper = std::move(doorkeeper);
  grpc::ServerBuilder builder;
  parts->acceptor = builder.experimental().AddExternalConnectionAcceptor(
      grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, grpc::InsecureServerCredentials());
  builder.SetMaxReceiveMessageSize(limits::kMaxHealthMessageBytes);
  builder.SetResourceQuota(grpc::ResourceQuota("health").SetMaxThreads(limits::kMaxHealthThreads));
  parts->server = builder.BuildAndStart();
  if (parts->server == nullptr) return fail(ErrorCode::kUnavailable, "gRPC does not start; its own log line says why");
  parts->relay = std::make_unique<Relay>(
      [acceptor = parts->acceptor.get()](int descriptor) {
        grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
        connection.fd = descriptor;
        acceptor->HandleNewConnection(&connection);
      },
      on_refused, RelayGuard{});
  parts->doorkeeper->open([relay = parts->relay.get()](int descriptor) { relay->add(descriptor); },
                          [on_refused](std::string_view who) { on_refused(who, "a peer that does not speak HTTP/2"); },
                          Doorkeeper::Opening::kHttp2);
  return std::unique_ptr<HealthServer>(new HealthServer(std::move(parts)));
}

HealthServer::HealthServer(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}

HealthServer::~HealthServer() {
  parts_->doorkeeper.reset();
  parts_->server->Shutdown(std::chrono::system_clock::now());
}

const std::string& HealthServer::endpoint() const { return parts_->doorkeeper->endpoint(); }

void HealthServer::set(const std::string& name, bool serving) {
  parts_->server->GetHealthCheckService()->SetServingStatus(name, serving);
}

}  // namespace tensormass::control
