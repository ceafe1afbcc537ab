"""The gRPC connection to a daemon, and the data plane that the daemon announces over it."""

from __future__ import annotations

import contextlib
from typing import Any

import grpc

from tensormass._shared import errors
from tensormass._shared.client_keys import ClientKeys, KeysSource, channel_options, keys_of
from tensormass._shared.endpoints import reached_endpoints
from tensormass._src.data_plane import DataPlane
from tensormass._src.streams import Closing
from tensormass.v1 import control_pb2, control_pb2_grpc

# The daemon's own limit (server/core/limits.h).
_MAX_MESSAGE_BYTES = 512 << 20
CALL_TIMEOUT_S = 30.0
#: Time [s] that a call may take if it compiles a scene or measures all of it.
LOAD_TIMEOUT_S = 300.0


def _no_answer(address: str, keys: ClientKeys | None) -> str:
    if keys is None:
        return (
            f"no daemon answers on {address}; start one with `tensormass run`, `tensormassd` or tm.launch(). If it was "
            "started with --keys, give your file of keys: connect(..., keys=FILE), --keys FILE"
        )
    return (
        f"no daemon on {address} takes the keys {keys.path} ({keys.id}). Is it started, with --keys? The keys may have "
        "been removed, or belong to another daemon: `tensormass keys list` says who has keys there"
    )


class Connection(Closing):
    """Makes calls to one daemon. Close it, or use it as a context manager."""

    def __init__(self, address: str, *, timeout_s: float = 5.0, keys: KeysSource | None = None) -> None:
        if ":" not in address:
            raise errors.InvalidArgumentError(
                f"address {address!r}: has no port; write HOST:PORT, as in {address}:50051"
            )
        #: Address of the control plane, host:port.
        self.address = address
        #: Keys of this client; None: the daemon asks for none.
        self.keys = keys_of(keys)
        self._cleanup = contextlib.ExitStack()
        self._closed = False
        options = [
            ("grpc.max_send_message_length", _MAX_MESSAGE_BYTES),
            ("grpc.max_receive_message_length", _MAX_MESSAGE_BYTES),
            ("grpc.enable_http_proxy", 0),  # the data plane does not use a proxy either
        ]
        if self.keys is None:
            self._channel = grpc.insecure_channel(address, options=options)
        else:
            self._channel = grpc.secure_channel(
                address, self.keys.channel_credentials(), options=channel_options(self.keys, options)
            )
        self._stub = control_pb2_grpc.ControlStub(self._channel)
        try:
            grpc.channel_ready_future(self._channel).result(timeout_s)
            self._data_plane = DataPlane(self.version(), self.keys)
        except grpc.FutureTimeoutError:
            self._channel.close()
            raise errors.UnavailableError(_no_answer(address, self.keys)) from None
        except BaseException:
            self._channel.close()
            raise

    def close(self) -> None:
        """Closes the connection, then unwinds the work of `at_close`. May be called again."""
        self._closed = True
        self._data_plane.close()
        self._channel.close()
        self._cleanup.close()

    @property
    def data_plane(self) -> DataPlane:
        """Gives access to the streams, for clients that need more than `SceneHandle` offers."""
        return self._data_plane

    def version(self) -> control_pb2.GetVersionResponse:
        """Returns version, backend, device, counters of malformed input, and data endpoints as this client reaches
        them."""
        return reached_endpoints(self.call("GetVersion", control_pb2.GetVersionRequest()), self.address)

    def at_close(self, work: contextlib.ExitStack) -> None:
        """Unwinds `work` after the connection is closed."""
        self._cleanup.push(work)

    def call(self, method: str, request: Any, timeout_s: float | None = CALL_TIMEOUT_S, *, waits: bool = False) -> Any:  # noqa: ANN401
        """Makes one unary call. A failed call raises an exception of the SDK.

        Args:
            method: its name in control.proto.
            timeout_s: None waits as long as it takes.
            waits: True waits for a daemon that does not answer yet, until the timeout.
        """
        if self._closed:
            raise errors.UnavailableError(f"this connection to {self.address} is closed; connect again")
        try:
            return getattr(self._stub, method)(request, timeout=timeout_s, wait_for_ready=waits)
        except grpc.RpcError as error:
            raise errors.from_rpc_error(error) from error
