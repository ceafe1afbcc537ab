#pragma once

#include <memory>
#include <vector>

#include <grpcpp/support/server_interceptor.h>

namespace tensormass::control {

/// Interceptors that answer a request whose bytes are not the call's protobuf message with INVALID_ARGUMENT and the
/// call's name. gRPC alone answers INTERNAL with an empty message, before any of our code runs.
///
/// They also answer a call that ran out of memory with RESOURCE_EXHAUSTED, where gRPC alone says UNKNOWN.
///
/// Pass the result to `ServerBuilder::experimental().SetInterceptorCreators`. gRPC runs the interceptors on the thread
/// of the call.
std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> refuse_unreadable_requests();

}  // namespace tensormass::control
