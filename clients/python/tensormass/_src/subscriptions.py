"""Subscriptions: the newest message of one stream, from ZeroMQ or zenoh."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import zenoh
import zenoh.handlers
import zmq
from google.protobuf.message import DecodeError, Message

from tensormass._shared.errors import (
    DeadlineExceededError,
)
from tensormass._src.streams import Stream

MessageType = TypeVar("MessageType", bound=Message)


class Source(ABC):
    @abstractmethod
    def receive(self, timeout_s: float) -> bytes | None:
        """Returns the newest payload that was not yet taken; None when the time is up."""

    @abstractmethod
    def close(self) -> None: ...


class ZeroMqSource(Source):
    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket

    def receive(self, timeout_s: float) -> bytes | None:
        if not self._socket.poll(max(0, round(timeout_s * 1000))):
            return None
        message = self._socket.recv()
        return message[message.index(b"\0") + 1 :]  # the key ends in a zero byte

    def close(self) -> None:
        self._socket.close()


class ZenohSource(Source):
    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        # zenoh's own threads call the handler. Otherwise each handler has a Python thread, and the process waits for it
        # at its end.
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(self._put, indirect=False))
        # A query brings the message that the daemon retains (topology, status). Other streams do not answer it.
        session.get(key, handler=zenoh.handlers.Callback(self._reply, indirect=False))

    def _reply(self, reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is not None:
            with self._changed:
                if self._newest is None:
                    self._newest = sample.payload.to_bytes()
                    self._changed.notify()

    def _put(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        with self._changed:
            self._newest = payload
            self._changed.notify()

    def receive(self, timeout_s: float) -> bytes | None:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None, timeout_s)
            newest, self._newest = self._newest, None
            return newest

    def close(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session may already be closed
            self._subscriber.undeclare()


#: Longest single wait of a subscription [s].
_WAIT_S = 1.0


class Subscription(Stream, Generic[MessageType]):
    """Receives the newest message of one stream. Use it from one thread only."""

    def __init__(self, check_plane: Callable[[], None], source: Source, key: str, kind: type[MessageType]) -> None:
        super().__init__(check_plane, key, source.close)
        self._source = source
        self._kind = kind
        #: Number of messages that were not protobuf of this kind.
        self.malformed_count = 0

    def receive(self, timeout_s: float = 5.0) -> MessageType:
        """Waits for the newest message that was not yet taken.

        Raises:
            DeadlineExceededError: no message came in `timeout_s`.
            UnavailableError: the subscription or its connection was closed.
        """
        self._check_open()
        left_s = timeout_s
        while True:
            # Waits in short parts. A process that was suspended for longer than the time-out then checks once more
            # after its transport had a chance to run, before it reports that nothing came.
            wait_s = min(left_s, _WAIT_S)
            begin = time.monotonic()
            payload = self._source.receive(wait_s)
            if payload is not None:
                try:
                    return self._kind.FromString(payload)
                except DecodeError:
                    self.malformed_count += 1
            elif left_s <= wait_s:
                raise DeadlineExceededError(f"nothing came on {self._key} in {timeout_s:g} s")
            left_s = max(0.0, left_s - min(wait_s, time.monotonic() - begin))

    def newest(self) -> MessageType | None:
        """Returns the newest message, or None if it was taken already."""
        self._check_open()
        payload = self._source.receive(0.0)
        if payload is None:
            return None
        try:
            return self._kind.FromString(payload)
        except DecodeError:
            self.malformed_count += 1
            return None

    def __iter__(self) -> Iterator[MessageType]:
        while True:
            yield self.receive()
