#include "control/control_server.h"

#include <chrono>
#include <utility>

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include "core/limits.h"

namespace tensormass::control {
namespace {

constexpr std::chrono::seconds kDrainTime{1};
/// Threads of all calls together; a call beyond them is answered RESOURCE_EXHAUSTED.
constexpr int kMaxThreads = 64;

}  // namespace

Result<std::unique_ptr<ControlServer>> ControlServer::start(const std::string& address, ControlService& service) {
  grpc::EnableDefaultHealthCheckService(true);
  grpc::reflection::InitProtoReflectionServerBuilderPlugin();
  grpc::ServerBuilder builder;
  int port = 0;
  builder.AddListeningPort(address, grpc::InsecureServerCredentials(), &port);
  // Else a second daemon would take half of the first one's calls.
  builder.AddChannelArgument(GRPC_ARG_ALLOW_REUSEPORT, 0);
  builder.SetMaxReceiveMessageSize(static_cast<int>(limits::kMaxControlMessageBytes));
  builder.SetResourceQuota(grpc::ResourceQuota("control").SetMaxThreads(kMaxThreads));
  builder.RegisterService(&service);
  std::unique_ptr<grpc::Server> server = builder.BuildAndStart();
  if (server == nullptr || port == 0) {
    return fail(ErrorCode::kUnavailable,
                "gRPC cannot listen on '" + address + "': the address is wrong or taken; give another one, or port 0");
  }
  std::string endpoint = address.substr(0, address.rfind(':') + 1) + std::to_string(port);
  return std::unique_ptr<ControlServer>(new ControlServer(std::move(server), std::move(endpoint)));
}

ControlServer::ControlServer(std::unique_ptr<grpc::Server> server, std::string endpoint)
    : server_(std::move(server)), endpoint_(std::move(endpoint)) {}

ControlServer::~ControlServer() { server_->Shutdown(std::chrono::system_clock::now() + kDrainTime); }

void ControlServer::announce_shutdown() { server_->GetHealthCheckService()->Shutdown(); }

}  // namespace tensormass::control
