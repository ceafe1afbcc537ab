#include "control/refused_calls.h"

#include <new>
#include <string>
#include <string_view>
#include <utility>

#include <fmt/format.h>
#include <google/protobuf/message.h>
#include <grpcpp/server_context.h>

#include "control/relay.h"
#include "control/status.h"

namespace tensormass::control {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;
using grpc::experimental::InterceptionHookPoints;
using grpc::experimental::InterceptorBatchMethods;
using grpc::experimental::ServerRpcInfo;

constexpr std::string_view kOwnServices = "tensormass.v1.";

/// Returns the name of the scene that a request is about: its field `scene`, or the name of the scene in it.
std::string scene_of(const Message& request) {
  const FieldDescriptor* const field = request.GetDescriptor()->FindFieldByName("scene");
  if (field == nullptr || field->is_repeated()) return {};
  if (field->cpp_type() == FieldDescriptor::CPPTYPE_STRING) return request.GetReflection()->GetString(request, field);
  if (field->cpp_type() != FieldDescriptor::CPPTYPE_MESSAGE) return {};
  const Message& scene = request.GetReflection()->GetMessage(request, field);
  const FieldDescriptor* const name = scene.GetDescriptor()->FindFieldByName("name");
  if (name == nullptr || name->cpp_type() != FieldDescriptor::CPPTYPE_STRING || name->is_repeated()) return {};
  return scene.GetReflection()->GetString(scene, name);
}

bool is_refusal(grpc::StatusCode code) {
  switch (code) {
    case grpc::StatusCode::OK:
    case grpc::StatusCode::CANCELLED:
    case grpc::StatusCode::UNAVAILABLE:
    case grpc::StatusCode::NOT_FOUND:
      return false;
    default:
      return true;
  }
}

/// Checks one call at two hooks: when gRPC has parsed the request (a null pointer: it could not), and when it is about
/// to send the status. The request is gone by then.
///
/// Null alone does not prove unreadable bytes: gRPC also drops the request of a call that it refuses for lack of
/// threads, with RESOURCE_EXHAUSTED. Unreadable bytes give INTERNAL.
class Interceptor final : public grpc::experimental::Interceptor {
 public:
  Interceptor(ServerRpcInfo* call, const OnRefusedCall& on_refused)
      : call_(call), method_(call->method() + 1), on_refused_(on_refused) {}  // names start with a slash

  void Intercept(InterceptorBatchMethods* methods) override {
    try {
      look(*methods);
    } catch (const std::bad_alloc&) {  // nobody is told, and the answer is short enough to need no memory
      if (methods->QueryInterceptionHookPoint(InterceptionHookPoints::PRE_SEND_STATUS) &&
          methods->GetSendStatus().error_code() == grpc::StatusCode::UNKNOWN) {
        methods->ModifySendStatus({grpc::StatusCode::RESOURCE_EXHAUSTED, "no memory"});
      }
    }
    methods->Proceed();
  }

 private:
  void look(InterceptorBatchMethods& methods) {
    if (methods.QueryInterceptionHookPoint(InterceptionHookPoints::POST_RECV_MESSAGE)) {
      const void* const request = methods.GetRecvMessage();
      unreadable_ = request == nullptr;
      // gRPC's own services take bytes, and no message of protobuf.
      if (request != nullptr && on_refused_ && method_.starts_with(kOwnServices)) {
        const auto* const message = static_cast<const google::protobuf::MessageLite*>(request);
        scene_ = scene_of(dynamic_cast<const Message&>(*message));
      }
    }
    if (methods.QueryInterceptionHookPoint(InterceptionHookPoints::PRE_SEND_STATUS)) {
      mend_status(methods);
      tell(methods.GetSendStatus());
    }
  }

  void mend_status(InterceptorBatchMethods& methods) const {
    const grpc::StatusCode code = methods.GetSendStatus().error_code();
    // gRPC's answer to an exception in a call. Ours throw none but for lack of memory.
    if (code == grpc::StatusCode::UNKNOWN) {
      methods.ModifySendStatus(to_status(
          {ErrorCode::kResourceExhausted,
           fmt::format("{}: the server has no memory for this call; unload a scene, or ask for less", method_)}));
    }
    if (unreadable_ && code == grpc::StatusCode::INTERNAL) {
      methods.ModifySendStatus(to_status(
          {ErrorCode::kInvalidArgument,
           fmt::format("{}: the request is missing, or its bytes are not the protobuf message of this call; build the "
                       "client from proto/tensormass/v1/control.proto",
                       method_)}));
    }
  }

  void tell(const grpc::Status& status) const {
    const grpc::StatusCode code = status.error_code();
    if (!on_refused_ || !is_refusal(code)) return;
    const std::string who = Relay::name_of_peer(call_->server_context()->peer());
    on_refused_(code == grpc::StatusCode::PERMISSION_DENIED || code == grpc::StatusCode::UNAUTHENTICATED,
                {.who = who, .what = method_, .scene = scene_, .reason = status.error_message()});
  }

  ServerRpcInfo* const call_;
  const std::string_view method_;  // "tensormass.v1.Control/StepScene"; gRPC owns the text as long as the server
  const OnRefusedCall& on_refused_;
  std::string scene_;
  bool unreadable_ = false;
};

class Factory final : public grpc::experimental::ServerInterceptorFactoryInterface {
 public:
  explicit Factory(OnRefusedCall on_refused) : on_refused_(std::move(on_refused)) {}

  grpc::experimental::Interceptor* CreateServerInterceptor(ServerRpcInfo* call) override {
    // In a stream of requests null means that the stream ended.
    if (call->type() != ServerRpcInfo::Type::UNARY && call->type() != ServerRpcInfo::Type::SERVER_STREAMING) {
      return nullptr;
    }
    return new (std::nothrow) Interceptor(call, on_refused_);  // nullptr: the call goes on without
  }

 private:
  const OnRefusedCall on_refused_;
};

}  // namespace

std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> intercept_refusals(
    OnRefusedCall on_refused) {
  std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> factories;
  factories.push_back(std::make_unique<Factory>(std::move(on_refused)));
  return factories;
}

}  // namespace tensormass::control
