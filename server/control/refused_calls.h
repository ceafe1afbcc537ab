#pragma once

#include <functional>
#include <memory>
#include <vector>

#include <grpcpp/support/server_interceptor.h>

#include "core/journal.h"

namespace tensormass::control {

/// Called for each call that was answered with an error, except those about scenes that are not there or end, and those
/// that the client gave up. by_role: the client's key has no right to it. Runs on the thread of the call.
using OnRefusedCall = std::function<void(bool by_role, const Refused& call)>;

/// Interceptors that answer a request whose bytes are not the call's protobuf message with INVALID_ARGUMENT and the
/// call's name. gRPC alone answers INTERNAL with an empty message, before any of our code runs.
///
/// They also answer a call that ran out of memory with RESOURCE_EXHAUSTED, where gRPC alone says UNKNOWN, and tell
/// `on_refused` of every refusal, gRPC's own included. nullptr: nobody is told.
///
/// Pass the result to `ServerBuilder::experimental().SetInterceptorCreators`. gRPC runs the interceptors on the thread
/// of the call.
std::vector<std::unique_ptr<grpc::experimental::ServerInterceptorFactoryInterface>> intercept_refusals(
    OnRefusedCall on_refused);

}  // namespace tensormass::control
