"""Exceptions of the SDK: one for each way in which a caller can react. Each has the daemon's own message."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import grpc


class TensormassError(Exception):
    """Base of all errors that the SDK raises on purpose."""


class InvalidArgumentError(TensormassError, ValueError):
    """The input is wrong; the message says what, where, and what to do."""


class NotFoundError(TensormassError, LookupError):
    """No such scene, body, tool or file."""


class AlreadyExistsError(TensormassError):
    """A scene of this name is loaded."""


class ResourceExhaustedError(TensormassError):
    """A limit was exceeded; the message names it."""


class FailedPreconditionError(TensormassError):
    """The scene is in the wrong state for this call."""


class UnavailableError(TensormassError, ConnectionError):
    """The daemon does not answer, or it is shutting down."""


class DeadlineExceededError(TensormassError, TimeoutError):
    """No answer, frame or feedback in the time allowed."""


class NotConvergedError(TensormassError):
    """A step ended above its tolerance, or a scene did not come to rest."""


class InternalError(TensormassError):
    """The daemon failed, and not through the caller's fault."""


class MeshFileWarning(UserWarning):
    """A mesh file has something that is not used: cells without a volume, nodes of no element, groups without a name.

    `warnings.simplefilter("error", tm.MeshFileWarning)` refuses such files.
    """


@contextlib.contextmanager
def naming(where: str) -> Iterator[None]:
    """Puts `where`, a place or an option, in front of the message of an error in the body."""
    try:
        yield
    except TensormassError as error:
        raise type(error)(f"{where}: {error}") from error


_BY_CODE: dict[grpc.StatusCode, type[TensormassError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: InvalidArgumentError,
    grpc.StatusCode.NOT_FOUND: NotFoundError,
    grpc.StatusCode.ALREADY_EXISTS: AlreadyExistsError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: ResourceExhaustedError,
    grpc.StatusCode.FAILED_PRECONDITION: FailedPreconditionError,
    grpc.StatusCode.UNAVAILABLE: UnavailableError,
    grpc.StatusCode.DEADLINE_EXCEEDED: DeadlineExceededError,
}


def from_rpc_error(error: grpc.RpcError) -> TensormassError:
    """Returns the exception for a failed call. `error` must come from a finished call."""
    assert isinstance(error, grpc.Call)
    return _BY_CODE.get(error.code(), InternalError)(error.details() or f"the daemon answered {error.code().name}")
