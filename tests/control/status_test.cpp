#include "control/status.h"

#include <gtest/gtest.h>

namespace tensormass::control {
namespace {

TEST(Status, MapsEveryCodeAndKeepsTheMessage) {
  const std::pair<ErrorCode, grpc::StatusCode> pairs[] = {
      {ErrorCode::kInvalidArgument, grpc::StatusCode::INVALID_ARGUMENT},
      {ErrorCode::kNotFound, grpc::StatusCode::NOT_FOUND},
      {ErrorCode::kAlreadyExists, grpc::StatusCode::ALREADY_EXISTS},
      {ErrorCode::kResourceExhausted, grpc::StatusCode::RESOURCE_EXHAUSTED},
      {ErrorCode::kFailedPrecondition, grpc::StatusCode::FAILED_PRECONDITION},
      {ErrorCode::kUnavailable, grpc::StatusCode::UNAVAILABLE},
      {ErrorCode::kCancelled, grpc::StatusCode::CANCELLED},
  };
  for (const auto& [code, expected] : pairs) {
    const grpc::Status status = to_status({code, "body 'liver': what to do"});
    EXPECT_EQ(status.error_code(), expected);
    EXPECT_EQ(status.error_message(), "body 'liver': what to do");
  }
}

}  // namespace
}  // namespace tensormass::control
