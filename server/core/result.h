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
  kCancelled,           ///< Nobody waits for the result any more.
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

/// Returns the error of a failed Result from the enclosing function, which must return a Result.
#define TM_RETURN_IF_ERROR(expression)                                                            \
  do {                                                                                            \
    if (auto tm_result = (expression); !tm_result) return tl::make_unexpected(tm_result.error()); \
  } while (false)

/// Returns the error likewise; otherwise names the value: TM_ASSIGN_OR_RETURN(mesh, read_mesh(body));
#define TM_ASSIGN_OR_RETURN(name, expression)                            \
  auto name##_result = (expression);                                     \
  if (!name##_result) return tl::make_unexpected(name##_result.error()); \
  auto& name = *name##_result
