"""Common parts of subscriptions and pose senders: keys and closing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self

from tensormass._shared.errors import (
    UnavailableError,
)

Transport = Literal["zeromq", "zenoh"]


def stream_key(server: str, scene: str, stream: str) -> str:
    """Returns the key of a stream: `frame`, `topology`, `status`, `tool/<name>/feedback` or `tool/<name>/pose`."""
    return f"tensormass/{server}/{scene}/{stream}"


class Closing(ABC):
    """Base of everything that is closed, by `close` or as a context manager."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()


class Stream(Closing):
    """A stream of a data plane. Closing the plane closes it.

    Args:
        check_plane: () -> None; called before each use, raises UnavailableError once the data plane is closed. Holding
            it keeps the plane, and with it the transport, alive.
        key: of the stream, for messages.
        end: () -> anything; called once, releases the transport's side.
    """

    def __init__(self, check_plane: Callable[[], None], key: str, end: Callable[[], object]) -> None:
        self._check_plane = check_plane
        self._key = key
        self._end = end
        self._closed = False

    def close(self) -> None:
        """Closes the stream. May be called again."""
        if not self._closed:
            self._closed = True
            self._end()

    def _check_open(self) -> None:
        self._check_plane()
        if self._closed:
            raise UnavailableError(f"{self._key}: this stream is closed; open another one")
