#include "control/control_server.h"

#include <chrono>
#include <utility>

#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include "control/control_service.h"
#include "control/doorkeeper.h"
#include "control/refused_calls.h"
#include "control/relay.h"
#include "core/control_limits.h"
#include "core/limits.h"

namespace tensormass::control {
namespace {

/// Time for running calls to end at shutdown. A StepScene ends within a turn, kStepTurn in control_service.cpp. A load
/// that takes longer is cancelled.
constexpr std::chrono::milliseconds kDrainTime{300};
/// Time without a byte from a client with a call, after which it is asked whether it is there, and time for its answer.
/// The calls of one that is gone end then.
constexpr std::chrono::milliseconds kKeepalive{10'000}, kKeepaliveAnswer{5'000};

}  // namespace

struct ControlServer::Parts {
  ControlService service;
  std::unique_ptr<TlsContext> tls = nullptr;
  std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> acceptor = nullptr;
  std::unique_ptr<grpc::Server> server = nullptr;
  std::unique_ptr<Relay> relay = nullptr;
  std::unique_ptr<Doorkeeper> doorkeeper = nullptr;
};

Result<std::unique_ptr<ControlServer>> ControlServer::start(const std::string& address, SceneRegistry& registry,
                                                            const v1::GetVersionResponse& identity,
                                                            std::function<std::uint64_t()> malformed_count,
                                                            const OnRefused& on_refused, const access::KeyRing* keys,
                                                            std::function<std::string()> metrics) {
  grpc::EnableDefaultHealthCheckService(true);
  grpc::reflection::InitProtoReflectionServerBuilderPlugin();
  TM_ASSIGN_OR_RETURN(doorkeeper, Doorkeeper::listen(address));
  std::unique_ptr<Parts> parts(
      new Parts{.service = {registry, identity, std::move(malformed_count), keys, std::move(metrics)}});
  if (keys != nullptr) {
    const access::DaemonKeys& own = keys->daemon();
    TM_ASSIGN_OR_RETURN(tls, TlsContext::make(own.certificate_pem, own.private_key_pem, own.authority_pem));
    parts->tls = std::move(tls);
  }
  parts->doorkeeper = std::move(doorkeeper);
  grpc::ServerBuilder builder;
  parts->acceptor = builder.experimental().AddExternalConnectionAcceptor(
      grpc::ServerBuilder::experimental_type::ExternalConnectionType::FROM_FD, grpc::InsecureServerCredentials());
  builder.SetMaxReceiveMessageSize(static_cast<int>(limits::kMaxControlMessageBytes));
  builder.SetResourceQuota(grpc::ResourceQuota("control").SetMaxThreads(limits::kMaxControlThreads));
  builder.AddChannelArgument(GRPC_ARG_KEEPALIVE_TIME_MS, static_cast<int>(kKeepalive.count()));
  builder.AddChannelArgument(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, static_cast<int>(kKeepaliveAnswer.count()));
  builder.AddChannelArgument(GRPC_ARG_HTTP2_MAX_PINGS_WITHOUT_DATA, 0);  // no bound
  builder.experimental().SetInterceptorCreators(intercept_refusals(on_refused.call));
  builder.RegisterService(&parts->service);
  parts->server = builder.BuildAndStart();
  if (parts->server == nullptr) return fail(ErrorCode::kUnavailable, "gRPC does not start; its own log line says why");
  const auto admit = [acceptor = parts->acceptor.get()](int descriptor) {
    grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters connection;
    connection.fd = descriptor;
    acceptor->HandleNewConnection(&connection);
  };
  RelayGuard guard;
  if (keys != nullptr) guard = {parts->tls.get(), [keys](std::string_view id) { return keys->find(id) != nullptr; }};
  Admission& admission = registry.admission();
  parts->relay = std::make_unique<Relay>(
      admit, on_refused.connection, std::move(guard),
      Http2Meter::Messages{
          static_cast<std::uint64_t>(admission.limits().message_bytes),
          [&admission](std::uint64_t bytes) { return admission.has_room(static_cast<double>(bytes)); }});
  const char* const wrong = keys != nullptr ? "a peer that does not speak TLS" : "a peer that does not speak HTTP/2";
  parts->doorkeeper->open([relay = parts->relay.get()](int descriptor) { relay->add(descriptor); },
                          [refuse = on_refused.connection, wrong](std::string_view who) { refuse(who, wrong); },
                          keys != nullptr ? Doorkeeper::Opening::kTls : Doorkeeper::Opening::kHttp2);
  return std::unique_ptr<ControlServer>(new ControlServer(std::move(parts)));
}

ControlServer::ControlServer(std::unique_ptr<Parts> parts) : parts_(std::move(parts)) {}

ControlServer::~ControlServer() {
  parts_->doorkeeper.reset();
  parts_->server->Shutdown(std::chrono::system_clock::now() + kDrainTime);
}

const std::string& ControlServer::endpoint() const { return parts_->doorkeeper->endpoint(); }

void ControlServer::set_health(const std::string& name, bool serving) {
  parts_->server->GetHealthCheckService()->SetServingStatus(name, serving);
}

void ControlServer::announce_shutdown() { parts_->server->GetHealthCheckService()->Shutdown(); }

}  // namespace tensormass::control
