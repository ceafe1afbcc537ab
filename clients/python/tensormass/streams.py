"""The data plane: newest-wins subscriptions and tool poses, over ZeroMQ or zenoh, with the same keys and bytes.

A reader that is slower than the stream skips to the newest message; it never makes the server wait. ZeroMQ's CONFLATE
keeps one message for each socket, so every subscription has a socket of its own. Poses are sent without it, because a
socket that is closed drops what it keeps so.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import select
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, get_args

import numpy as np
import numpy.typing as npt
import zenoh
import zenoh.handlers
import zmq
from google.protobuf.message import DecodeError, Message

from tensormass.errors import (
    DeadlineExceededError,
    InternalError,
    InvalidArgumentError,
    NotFoundError,
    UnavailableError,
)
from tensormass.scene import Vector, quaternion, vector3
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

Transport = Literal["zeromq", "zenoh"]
MessageType = TypeVar("MessageType", bound=Message)

# A frame of the largest scene fits; anything longer comes from no daemon of ours.
_MAX_MESSAGE_BYTES = 1 << 30


def stream_key(server: str, scene: str, stream: str) -> str:
    """The key of a stream: `frame`, `topology`, `status`, `tool/<name>/feedback` or `tool/<name>/pose`."""
    return f"tensormass/{server}/{scene}/{stream}"


# An address of every interface: a daemon binds it, a client has to connect to one of them.
_WILDCARD = re.compile(r"(?P<scheme>\w+(?:://|/))(?:0\.0\.0\.0|\[::\]|\*)(?P<port>:\d+)")
# The host of a gRPC target that ends in host:port; an IPv6 one keeps its brackets.
_HOST = re.compile(r"(\[[^]]*\]|[^/:]+)(?::\d+)?$")


def reached_endpoint(endpoint: str, control: str) -> str:
    """A data endpoint (tcp://host:port, tcp/host:port) as a client connects to it that reached the daemon at `control`.

    A daemon that listens on every interface does not know which of them leads to the client; the client does: it goes
    to the host at which it reached the control plane (host:port). Every other endpoint stays as it is.
    """
    wildcard, host = _WILDCARD.fullmatch(endpoint), _HOST.search(control)
    return f"{wildcard['scheme']}{host[1]}{wildcard['port']}" if wildcard and host else endpoint


def reached_endpoints(version: control_pb2.GetVersionResponse, control: str) -> control_pb2.GetVersionResponse:
    """A daemon's answer with each of its endpoints as `reached_endpoint` says."""
    reached = control_pb2.GetVersionResponse()
    reached.CopyFrom(version)
    reached.zeromq_publish_endpoint = reached_endpoint(version.zeromq_publish_endpoint, control)
    reached.zeromq_pose_endpoint = reached_endpoint(version.zeromq_pose_endpoint, control)
    reached.zenoh_locator = reached_endpoint(version.zenoh_locator, control)
    return reached


@dataclass(frozen=True)
class Feedback:
    """What a tool feels. See `ToolFeedback` in stream.proto."""

    tool: str
    step: int
    #: Since the Unix epoch on the server's clock, when the step ended.
    server_time_ns: int
    #: Sequence of the newest pose that the step used; 0 before the first.
    pose_sequence: int
    #: The client's own clock, as sent with that pose.
    client_time_ns: int
    #: Whose pose that was: a hand renders only answers to its own, those with `PoseSender.client_id`.
    client_id: int
    #: [3] m: where the tool is in the simulation.
    position_m: npt.NDArray[np.float64]
    #: [4] w, x, y, z
    orientation: npt.NDArray[np.float64]
    #: [3] N, on the tool.
    force_n: npt.NDArray[np.float64]
    #: [3] N m, about the tool's position.
    torque_n_m: npt.NDArray[np.float64]
    #: [3, 3] N/m: force(p) = force_n - stiffness_n_per_m (p - position_m), for `valid_for_s` from its arrival.
    stiffness_n_per_m: npt.NDArray[np.float64]
    valid_for_s: float

    @staticmethod
    def from_message(message: stream_pb2.ToolFeedback) -> Feedback:
        stiffness = np.array(message.local_model.stiffness_n_per_m, dtype=np.float64)
        orientation = message.orientation
        return Feedback(
            tool=message.tool,
            step=message.step,
            server_time_ns=message.server_time_ns,
            pose_sequence=message.pose_sequence,
            client_time_ns=message.client_time_ns,
            client_id=message.client_id,
            position_m=_array(message.position_m),
            orientation=np.array([orientation.w, orientation.x, orientation.y, orientation.z]),
            force_n=_array(message.force_n),
            torque_n_m=_array(message.torque_n_m),
            stiffness_n_per_m=stiffness.reshape(3, 3) if stiffness.size == 9 else np.zeros((3, 3)),
            valid_for_s=message.local_model.valid_for_s,
        )


@dataclass(frozen=True)
class Frame:
    """The surfaces of all bodies at one moment. See `Frame` in stream.proto."""

    topology: stream_pb2.Topology
    #: Counts frames; a gap is a dropped frame.
    sequence: int
    step: int
    simulated_time_s: float
    server_time_ns: int
    #: float32 [vertex_count, 3] m, all bodies one after the other (read-only).
    positions: npt.NDArray[np.float32]
    tools: dict[str, Feedback]

    def vertices(self, body: str) -> npt.NDArray[np.float32]:
        """[vertex_count, 3] m: the part of `positions` that belongs to a body."""
        surface = find_body(self.topology, body)
        return self.positions[surface.first_vertex : surface.first_vertex + surface.vertex_count]

    @staticmethod
    def from_message(message: stream_pb2.Frame, topology: stream_pb2.Topology) -> Frame:
        size = frame_size_bytes(topology)
        if len(message.positions) != size:
            raise InternalError(
                f"frame {message.sequence} of {topology.scene!r} has {len(message.positions)} bytes of positions; "
                f"its topology needs {size}"
            )
        return Frame(
            topology=topology,
            sequence=message.sequence,
            step=message.step,
            simulated_time_s=message.simulated_time_s,
            server_time_ns=message.server_time_ns,
            positions=np.frombuffer(message.positions, dtype="<f4").reshape(-1, 3),
            tools={tool.tool: Feedback.from_message(tool) for tool in message.tools},
        )


def frame_size_bytes(topology: stream_pb2.Topology) -> int:
    """Bytes of `positions` in a frame of this topology."""
    return 12 * sum(body.vertex_count for body in topology.bodies)


def find_body(topology: stream_pb2.Topology, body: str) -> stream_pb2.BodySurface:
    """The surface of a body; an unknown name is refused with the names there are."""
    return _find(topology, topology.bodies, "body", body)


def find_tool(topology: stream_pb2.Topology, tool: str) -> stream_pb2.ToolShape:
    """The shape of a tool; an unknown name is refused with the names there are."""
    return _find(topology, topology.tools, "tool", tool)


NamedType = TypeVar("NamedType", stream_pb2.BodySurface, stream_pb2.ToolShape)


def _find(topology: stream_pb2.Topology, there: Sequence[NamedType], kind: str, name: str) -> NamedType:
    for each in there:
        if each.name == name:
            return each
    known = ", ".join(each.name for each in there) or "none"
    raise NotFoundError(f"scene {topology.scene!r} has no {kind} {name!r}; it has: {known}")


class Closing(ABC):
    """Something to close, or to use as a context manager."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()


class DataPlane(Closing):
    """Where a daemon's streams are (from `Server.version`); opens the transports on first use."""

    def __init__(self, version: control_pb2.GetVersionResponse) -> None:
        self.server = version.server
        self._version = version
        self._zenoh: zenoh.Session | None = None
        self._end_zenoh: Callable[[], object] | None = None
        self._zeromq: zmq.Context[zmq.Socket[bytes]] | None = None
        self._streams: weakref.WeakSet[_Stream] = weakref.WeakSet()
        self._closed = False
        self._lock = threading.Lock()

    def close(self) -> None:
        """Ends what is open, streams too. May be called again."""
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
        source = _ZenohSource(self.zenoh(), key) if transport == "zenoh" else _ZeroMqSource(self._subscriber(key))
        return self._opened(Subscription(self, source, key, kind))

    def pose_sender(self, scene: str, tool: str, transport: Transport) -> PoseSender:
        """Opens the stream of a tool's poses."""
        _check_transport(transport)
        key = stream_key(self.server, scene, f"tool/{tool}/pose")
        if transport == "zenoh":
            publisher = self.zenoh().declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
            )
            return self._opened(PoseSender(self, publisher.put, publisher.undeclare, key))
        poses = _ZeroMqPoses(self._pusher(), key)
        return self._opened(PoseSender(self, poses.put, poses.close, key))

    def zenoh(self) -> zenoh.Session:
        """The session, a client of the daemon's own peer."""
        with self._lock:
            self.check_open()
            if self._zenoh is None:
                if not self._version.zenoh_locator:
                    raise UnavailableError("zenoh is off in this daemon; start it with --zenoh-listen or use zeromq")
                config = zenoh.Config()
                config.insert_json5("mode", '"client"')
                config.insert_json5("connect/endpoints", json.dumps([self._version.zenoh_locator]))
                config.insert_json5("scouting/multicast/enabled", "false")
                try:
                    self._zenoh = zenoh.open(config)
                except zenoh.ZError as error:
                    raise UnavailableError(f"zenoh at {self._version.zenoh_locator}: {error}") from error
                # Before the interpreter ends, too: zenoh's threads call back into it.
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
        # Holds nothing for a daemon that is away: it would be old when that is back.
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
            return self._zeromq.socket(kind)


def _check_transport(transport: str) -> None:
    known = get_args(Transport)
    if transport not in known:
        raise InvalidArgumentError(f"unknown transport {transport!r}; known: {', '.join(known)}")


class _Source(ABC):
    @abstractmethod
    def receive(self, timeout_s: float) -> bytes | None:
        """The newest payload not yet taken; None when the time is up."""

    @abstractmethod
    def close(self) -> None: ...


class _ZeroMqSource(_Source):
    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self._socket = socket

    def receive(self, timeout_s: float) -> bytes | None:
        if not self._socket.poll(max(0, round(timeout_s * 1000))):
            return None
        message = self._socket.recv()
        return message[message.index(b"\0") + 1 :]  # the subscription is a prefix that ends in it

    def close(self) -> None:
        self._socket.close()


class _ZenohSource(_Source):
    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        # Called by zenoh's own threads: else each handler has a Python thread, which a process waits for when it ends.
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(self._put, indirect=False))
        # What the daemon retains (topology, status) comes by query; a stream that retains nothing does not answer.
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
        with contextlib.suppress(zenoh.ZError):  # the session may be closed already
            self._subscriber.undeclare()


class _Stream(Closing):
    """A stream of a data plane, which ends it with itself."""

    def __init__(self, plane: DataPlane, key: str, end: Callable[[], object]) -> None:
        self._plane = plane
        self._key = key
        self._end = end
        self._closed = False

    def close(self) -> None:
        """Ends the stream. May be called again."""
        if not self._closed:
            self._closed = True
            self._end()

    def _check_open(self) -> None:
        self._plane.check_open()
        if self._closed:
            raise UnavailableError(f"{self._key}: this stream is closed; open another one")


StreamType = TypeVar("StreamType", bound=_Stream)

#: The longest single wait of a subscription [s].
_WAIT_S = 1.0


class Subscription(_Stream, Generic[MessageType]):
    """The newest message of one stream. Not to be shared between threads."""

    def __init__(self, plane: DataPlane, source: _Source, key: str, kind: type[MessageType]) -> None:
        super().__init__(plane, key, source.close)
        self._source = source
        self._kind = kind
        #: Messages that were not protobuf of this kind.
        self.malformed_count = 0

    def receive(self, timeout_s: float = 5.0) -> MessageType:
        """The newest message that was not yet taken; waits for one.

        Raises:
            DeadlineExceededError: none came in `timeout_s`.
            UnavailableError: the subscription or its connection was closed.
        """
        self._check_open()
        left_s = timeout_s
        while True:
            # In short waits: a process that was stopped for longer than the time-out looks once more when it goes on,
            # after its transport had a chance to run, before it says that nothing came.
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

    def __iter__(self) -> Iterator[MessageType]:
        while True:
            yield self.receive()


class PoseSequence:
    """Numbers the poses of one client: a random id, then sequences from 1 on."""

    def __init__(self) -> None:
        self.client_id = secrets.randbits(63) | 1
        self.last = 0

    def next(self, position_m: Vector, orientation: Vector | None) -> stream_pb2.ToolPose:
        """The message of the next pose, stamped with the monotonic clock."""
        position, rotation = vector3(position_m, "position"), quaternion(orientation, "orientation")
        self.last += 1
        return stream_pb2.ToolPose(
            sequence=self.last,
            client_time_ns=time.monotonic_ns(),
            client_id=self.client_id,
            position_m=position,
            orientation=rotation,
        )


#: How long closing waits for the last pose to leave [s].
_LAST_POSE_S = 1.0
#: How often a thread that waits for a socket looks whether it is still needed [s].
_LOOK_S = 0.1


class _ZeroMqPoses:
    """Poses on a socket that holds one of them. While it does, the newest waits here, in place of those before it."""

    def __init__(self, socket: zmq.Socket[bytes], key: str) -> None:
        self._socket = socket
        self._prefix = key.encode() + b"\0"
        self._waiting: bytes | None = None
        self._sends_later = False
        # Guards all of them: a socket is not for two threads at a time.
        self._changed = threading.Condition()

    def put(self, payload: bytes) -> None:
        with self._changed:
            self._waiting = self._prefix + payload
            if not self._send_waiting() and not self._sends_later:
                # The next call would send it or a newer one, but this may have been the last.
                self._sends_later = True
                threading.Thread(target=self._send_later, args=(self._socket.fileno(),), daemon=True).start()

    def close(self) -> None:
        """Returns when the newest pose has left, or nobody took it in _LAST_POSE_S."""
        deadline = time.monotonic() + _LAST_POSE_S
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is None, _LAST_POSE_S)
            self._waiting = None
            # There is room when the one that the socket held has left.
            self._socket.poll(max(0, round((deadline - time.monotonic()) * 1000)), zmq.POLLOUT)
            self._socket.close()

    def _send_later(self, descriptor: int) -> None:
        news = select.poll()
        news.register(descriptor, select.POLLIN)
        while True:
            news.poll(_LOOK_S * 1000)
            with self._changed:
                if self._socket.closed or self._waiting is None or self._send_waiting():
                    self._sends_later = False
                    return

    def _send_waiting(self) -> bool:
        assert self._waiting is not None
        # Asked first, because it makes the socket see at once that it has room; sending does so only now and then.
        if not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLOUT:
            return False
        self._socket.send(self._waiting, zmq.DONTWAIT)
        self._waiting = None
        self._changed.notify_all()
        return True


class PoseSender(_Stream):
    """Sends a tool's poses over the bus, at any rate; each step uses the newest. Not to be shared between threads.

    Close it, or use it as a context manager: that waits, a second at most, until the newest pose has left.
    """

    def __init__(self, plane: DataPlane, put: Callable[[bytes], object], end: Callable[[], object], key: str) -> None:
        super().__init__(plane, key, end)
        self._put = put
        self._sequence = PoseSequence()

    @property
    def client_id(self) -> int:
        """Random for each sender; comes back as `Feedback.client_id` of the steps that used its poses."""
        return self._sequence.client_id

    @property
    def last_sequence(self) -> int:
        """Of the last pose sent; comes back as `Feedback.pose_sequence`."""
        return self._sequence.last

    def send(self, position_m: Vector, orientation: Vector | None = None) -> int:
        """Sends a pose ([3] m; w, x, y, z or None for the identity) and returns its sequence.

        Raises:
            InvalidArgumentError: not finite, or no numbers.
            UnavailableError: the sender or its connection was closed.
        """
        self._check_open()
        self._put(self._sequence.next(position_m, orientation).SerializeToString())
        return self._sequence.last


def _array(vector: scene_pb2.Vector3) -> npt.NDArray[np.float64]:
    return np.array([vector.x, vector.y, vector.z])
