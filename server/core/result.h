#pragma once

#include <string>
#include <utility>

#include <tl/expected.hpp>

namespace tensormass {

/// Kinds of errors, by what the caller can do about them. Each maps to one gRPC status code of the control plane.
enum class ErrorCode {
  kInvalidArgument,     ///< The input is wrong; the message names the place and the remedy.
  kNotFound,            ///< No such scene, body or tool.
  kAlreadyExists,       ///< The name is taken.
  kResourceExhausted,   ///< A limit of core/limits.h; the message names it.
  kFailedPrecondition,  ///< Not in the state that the call needs.
  kUnavailable,         ///< No device, no port, or shutting down.
  kCancelled,           ///< Nobody waits for the result any more.
};

/// An error that the user can cause and mend. Mistakes in our own code are assertions instead (core/assert.h).
/// Functions pass an error on; the server's edge reports it once.
struct Error {
  ErrorCode code = ErrorCode::kInvalidArgument;
  std::string message;
};

/// A value or the error that prevented it.
template <class T>
using Result = tl::expected<T, Error>;

/// Makes a failed Result, for `return fail(code, message)`.
inline tl::unexpected<Error> fail(ErrorCode code, std::string message) {
  return tl::make_unexpected(Error{code, std::move(message)});
}

/// Makes a failed Result with code kInvalidArgument.
inline tl::unexpected<Error> invalid(std::string message) {
  return fail(ErrorCode::kInvalidArgument, std::move(message));
}

}  // namespace tensormass

/// Returns the error of a failed Result from the enclosing function, which must return a Result.
#define TM_RETURN_IF_ERROR(expression)                                                            \
  do {                                                                                            \
    if (auto tm_result = (expression); !tm_result) return tl::make_unexpected(tm_result.error()); \
  } while (false)

/// Returns the error of a failed Result likewise. Otherwise declares `name` as a reference to the value:
/// TM_ASSIGN_OR_RETURN(mesh, read_mesh(body));
#define TM_ASSIGN_OR_RETURN(name, expression)                            \
  auto name##_result = (expression);                                     \
  if (!name##_result) return tl::make_unexpected(name##_result.error()); \
  auto& name = *name##_result
