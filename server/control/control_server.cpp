#include "control/control_server.h"

#include <chrono>
#include <utility>

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include "control/unreadable_request.h"
#include "core/limits.h"

namespace tensormass::control {
namespace {

/// Time for running calls to end at shutdown. A StepScene ends within a turn, kStepTurn in control_service.cpp. A load
/// that takes longer is cancelled.
constexpr std::chrono::milliseconds kDrainTime{300};
/// Threads of all calls together; a call beyond them is answered with RESOURCE_EXHAUSTED.
constexpr int kMaxThreads = 64;

}  // namespace

Result<std::unique_ptr<ControlServer>> ControlServer::start(const std::string& address, ControlService& service,
                                                            std::function<void()> on_refused) {
  grpc::EnableDefaultHealthCheckService(true);
  grpc::reflection::InitProtoReflectionServerBuilderPlugin();
  TM_ASSIGN_OR_RETURN(doorkeeper, Doorkeeper::listen(address));
  grpc::ServerBuilder builder;
  Acceptor acceptor = builder.experimental().AddExternalConnectionAcceptor(
      grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, grpc::InsecureServerCredentials());
  builder.SetMaxReceiveMessageSize(static_cast<int>(limits::kMaxControlMessageBytes));
  builder.SetResourceQuota(grpc::ResourceQuota("control").SetMaxThreads(kMaxThreads));
  builder.experimental().SetInterceptorCreators(refuse_unreadable_requests());
  builder.RegisterService(&service);
  std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  if (server == nullptr) return fail(ErrorCode::kUnavailable, "gRPC does not start; its own log line says why");
  return std::unique_ptr<ControlServer>(
      new ControlServer(std::move(server), std::move(acceptor), std::move(doorkeeper), std::move(on_refused)));
}

ControlServer::ControlServer(std::unique_ptr<grpc::Server> server, Acceptor acceptor,
                             std::unique_ptr<Doorkeeper> doorkeeper, std::function<void()> on_refused)
    : server_(std::move(server)), acceptor_(std::move(acceptor)), doorkeeper_(std::move(doorkeeper)) {
  const auto admit = [this](int descriptor) {
    grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
    connection.fd = descriptor;
    acceptor_->HandleNewConnection(&connection);
  };
  doorkeeper_->open(admit, std::move(on_refused));
}

ControlServer::~ControlServer() {
  doorkeeper_.reset();
  server_->Shutdown(std::chrono::system_clock::now() + kDrainTime);
}

void ControlServer::announce_shutdown() { server_->GetHealthCheckService()->Shutdown(); }

}  // namespace tensormass::control
