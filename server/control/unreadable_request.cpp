#include "control/unreadable_request.h"

#include <string_view>

#include <fmt/format.h>

#include "control/status.h"

namespace tensormass::control {
namespace {

using grpc::experimental::InterceptionHookPoints;
using grpc::experimental::InterceptorBatchMethods;
using grpc::experimental::ServerRpcInfo;

/// Checks one call at two hooks: when gRPC has parsed the request (a null pointer: it could not), and when it is about
/// to send the status.
///
/// Null alone does not prove unreadable bytes: gRPC also drops the request of a call that it refuses for lack of
/// threads, with RESOURCE_EXHAUSTED. Unreadable bytes give INTERNAL.
class UnreadableRequest final : public grpc::experimental::Interceptor {
 public:
  explicit UnreadableRequest(const char* method) : method_(method) {}

  void Intercept(InterceptorBatchMethods* call) override {
    if (call->QueryInterceptionHookPoint(InterceptionHookPoints::POST_RECV_MESSAGE)) {
      unreadable_ = call->GetRecvMessage() == nullptr;
    }
    // gRPC's answer to an exception in a call. Ours throw none but for lack of memory.
    if (call->QueryInterceptionHookPoint(InterceptionHookPoints::PRE_SEND_STATUS) &&
        call->GetSendStatus().error_code() == grpc::StatusCode::UNKNOWN) {
      call->ModifySendStatus(to_status(
          {ErrorCode::kResourceExhausted,
           fmt::format("{}: the server has no memory for this call; unload a scene, or ask for less", method_)}));
    }
    if (unreadable_ && call->QueryInterceptionHookPoint(InterceptionHookPoints::PRE_SEND_STATUS) &&
        call->GetSendStatus().error_code() == grpc::StatusCode::INTERNAL) {
      call->ModifySendStatus(to_status(
          {ErrorCode::kInvalidArgument,
           fmt::format("{}: the request is missing, or its bytes are not the protobuf message of this call; build the "
                       "client from proto/tensormass/v1/control.proto",
                       method_)}));
    }
    call->Proceed();
  }

 private:
  const std::string_view method_;  // "tensormass.v1.Control/StepScene"; gRPC owns the text as long as the server
  bool unreadable_ = false;
};

class Factory final : public grpc::experimental::ServerInterceptorFactoryInterface {
 public:
  grpc::experimental::Interceptor* CreateServerInterceptor(ServerRpcInfo* call) override {
    // In a stream of requests null means that the stream ended.
    if (call->type() != ServerRpcInfo::Type::UNARY && call->type() != ServerRpcInfo::Type::SERVER_STREAMING) {
      return nullptr;
    }
    // gRPC's method names start with a slash.
    return new UnreadableRequest(call->method() + 1);
  }
};

}  // namespace

std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> refuse_unreadable_requests() {
  std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> factories;
  factories.push_back(std::make_unique<Factory>());
  return factories;
}

}  // namespace tensormass::control
