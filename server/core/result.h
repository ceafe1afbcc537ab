#pragma once

#include <string>
#include <utility>

#include <tl/expected.hpp>

namespace tensormass {

/// What a caller can do about an error; maps one to one on the gRPC status of the control plane.
enum class ErrorCode {
  kInvalidArgument,     ///< The input is wrong; the message names the place and the remedy.
  kNotFound,            ///< No such scene, body or tool.
  kAlreadyExists,       ///< The name is taken.
  kResourceExhausted,   ///< A limit of core/limits.h; the message names it.
  kFailedPrecondition,  ///< Not in the state that the call needs.
  kUnavailable,         ///< No device, no port, or shutting down.
};

/// The user's error (our own mistakes are assertions). Handled once, at the edge.
struct Error {
  ErrorCode code = ErrorCode::kInvalidArgument;
  std::string message;
};

template <class T>
using Result = tl::expected<T, Error>;

inline tl::unexpected<Error> fail(ErrorCode code, std::string message) {
  return tl::make_unexpected(Error{code, std::move(message)});
}

inline tl::unexpected<Error> invalid(std::string message) {
  return fail(ErrorCode::kInvalidArgument, std::move(message));
}

}  // namespace tensormass
