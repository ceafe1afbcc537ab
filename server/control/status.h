#pragma once

#include <grpcpp/support/status.h>

#include "core/result.h"

namespace tensormass::control {

/// Converts an error to a gRPC status; no other code does. Each code has one counterpart, and the message is unchanged.
inline grpc::Status to_status(const Error& error) {
  switch (error.code) {
    case ErrorCode::kInvalidArgument:
      return {grpc::StatusCode::INVALID_ARGUMENT, error.message};
    case ErrorCode::kNotFound:
      return {grpc::StatusCode::NOT_FOUND, error.message};
    case ErrorCode::kAlreadyExists:
      return {grpc::StatusCode::ALREADY_EXISTS, error.message};
    case ErrorCode::kResourceExhausted:
      return {grpc::StatusCode::RESOURCE_EXHAUSTED, error.message};
    case ErrorCode::kFailedPrecondition:
      return {grpc::StatusCode::FAILED_PRECONDITION, error.message};
    case ErrorCode::kUnavailable:
      return {grpc::StatusCode::UNAVAILABLE, error.message};
    case ErrorCode::kCancelled:
      return {grpc::StatusCode::CANCELLED, error.message};
  }
  return {grpc::StatusCode::INTERNAL, error.message};
}

}  // namespace tensormass::control
