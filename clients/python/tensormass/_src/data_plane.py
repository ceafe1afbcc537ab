"""The data plane: newest-wins subscriptions and tool poses, over ZeroMQ or zenoh, with the same keys and bytes.

A reader that is slower than the stream skips to the newest message, so it never makes the server wait. ZeroMQ's
CONFLATE keeps one message for each socket, so every subscription has a socket of its own. Poses are sent without
CONFLATE, because closing such a socket drops the message that it keeps.
"""

from __future__ import annotations

import json
import threading
import weakref
from collections.abc import Callable
from typing import Any, TypeVar, get_args

import zenoh
import zenoh.handlers
import zmq

from tensormass._shared.client_keys import ClientKeys, guard_socket
from tensormass._shared.errors import (
    InvalidArgumentError,
    UnavailableError,
)
from tensormass._src.poses import PoseSender, ZeroMqPoses
from tensormass._src.streams import Closing, Stream, Transport, stream_key
from tensormass._src.subscriptions import MessageType, Subscription, ZenohSource, ZeroMqSource
from tensormass.v1 import control_pb2

# A frame of the largest scene fits. No daemon of ours sends more.
_MAX_MESSAGE_BYTES = 1 << 30


class DataPlane(Closing):
    """Streams of a daemon. Opens a transport when it is first used."""

    def __init__(self, version: control_pb2.GetVersionResponse, keys: ClientKeys | None = None) -> None:
        self.server = version.server
        self._keys = keys
        self._version = version
        self._zenoh: zenoh.Session | None = None
        self._end_zenoh: Callable[[], object] | None = None
        self._zeromq: zmq.Context[zmq.Socket[bytes]] | None = None
        self._streams: weakref.WeakSet[Stream] = weakref.WeakSet()
        self._closed = False
        self._lock = threading.Lock()

    def close(self) -> None:
        """Closes all streams and transports. May be called again."""
        with self._lock:
            self._closed = True
        for stream in list(self._streams):
            stream.close()
        with self._lock:
            if self._end_zenoh is not None:
                self._end_zenoh()
                self._zenoh = self._end_zenoh = None
            if self._zeromq is not None:
                self._zeromq.destroy(linger=100)
                self._zeromq = None

    def check_open(self) -> None:
        """Raises UnavailableError after `close`."""
        if self._closed:
            raise UnavailableError(f"this connection to daemon {self.server!r} is closed; connect again")

    def subscribe(self, scene: str, stream: str, kind: type[MessageType], transport: Transport) -> Subscription[Any]:
        """Subscribes to the newest message of `stream`, parsed as `kind`."""
        _check_transport(transport)
        key = stream_key(self.server, scene, stream)
        source = ZenohSource(self.zenoh(), key) if transport == "zenoh" else ZeroMqSource(self._subscriber(key))
        return self._opened(Subscription(self.check_open, source, key, kind))

    def pose_sender(self, scene: str, tool: str, transport: Transport, valid_for_s: float | None = None) -> PoseSender:
        """Opens the stream of a tool's poses."""
        _check_transport(transport)
        key = stream_key(self.server, scene, f"tool/{tool}/pose")
        if transport == "zenoh":
            publisher = self.zenoh().declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
            )
            return self._opened(PoseSender(self.check_open, publisher.put, publisher.undeclare, key, valid_for_s))
        poses = ZeroMqPoses(self._pusher(), key)
        return self._opened(PoseSender(self.check_open, poses.put, poses.close, key, valid_for_s))

    def zenoh(self) -> zenoh.Session:
        """Returns the zenoh session, a client of the daemon's own peer."""
        with self._lock:
            self.check_open()
            if self._zenoh is None:
                if not self._version.zenoh_locator:
                    raise UnavailableError("zenoh is off in this daemon; start it with --zenoh-listen or use zeromq")
                config = zenoh.Config()
                config.insert_json5("mode", '"client"')
                config.insert_json5("connect/endpoints", json.dumps([self._version.zenoh_locator]))
                config.insert_json5("scouting/multicast/enabled", "false")
                if self._keys is not None:
                    self._keys.guard_zenoh(config)
                try:
                    self._zenoh = zenoh.open(config)
                except zenoh.ZError as error:
                    raise UnavailableError(f"zenoh at {self._version.zenoh_locator}: {error}") from error
                # The session must also end before the interpreter does, because zenoh's threads call back into it.
                self._end_zenoh = weakref.finalize(self, self._zenoh.close)
            return self._zenoh

    def _opened(self, stream: StreamType) -> StreamType:
        self._streams.add(stream)
        return stream

    def _subscriber(self, key: str) -> zmq.Socket[bytes]:
        socket = self._socket(zmq.SUB, self._version.zeromq_publish_endpoint)
        socket.setsockopt(zmq.CONFLATE, 1)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE_BYTES)
        socket.subscribe(key.encode() + b"\0")
        socket.connect(self._version.zeromq_publish_endpoint)
        return socket

    def _pusher(self) -> zmq.Socket[bytes]:
        socket = self._socket(zmq.PUSH, self._version.zeromq_pose_endpoint)
        socket.setsockopt(zmq.SNDHWM, 1)
        # Queues nothing while the daemon is away: such a pose would be old when the daemon is back.
        socket.setsockopt(zmq.IMMEDIATE, 1)
        socket.setsockopt(zmq.LINGER, 100)
        socket.connect(self._version.zeromq_pose_endpoint)
        return socket

    def _socket(self, kind: int, endpoint: str) -> zmq.Socket[bytes]:
        if not endpoint:
            raise UnavailableError("ZeroMQ is off in this daemon; use zenoh")
        with self._lock:
            self.check_open()
            if self._zeromq is None:
                self._zeromq = zmq.Context()
            socket = self._zeromq.socket(kind)
            guard_socket(self._keys, socket)
            return socket


def _check_transport(transport: str) -> None:
    known = get_args(Transport)
    if transport not in known:
        raise InvalidArgumentError(f"unknown transport {transport!r}; known: {', '.join(known)}")


StreamType = TypeVar("StreamType", bound=Stream)
