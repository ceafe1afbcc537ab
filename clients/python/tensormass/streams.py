"""The data plane: newest-wins subscriptions and tool poses, over ZeroMQ or zenoh, with the same keys and bytes.

A reader that is slower than the stream skips to the newest message; it never makes the server wait. ZeroMQ's CONFLATE
keeps one message for each socket, so every stream has a socket of its own.
"""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
import zenoh
import zmq
from google.protobuf.message import DecodeError, Message

from tensormass.errors import DeadlineExceededError, InternalError, InvalidArgumentError, UnavailableError
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
    #: Sequence of the newest pose that the step used; 0 before the first.
    pose_sequence: int
    #: The client's own clock, as sent with that pose.
    client_time_ns: int
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
            pose_sequence=message.pose_sequence,
            client_time_ns=message.client_time_ns,
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
    for surface in topology.bodies:
        if surface.name == body:
            return surface
    known = ", ".join(surface.name for surface in topology.bodies)
    raise InvalidArgumentError(f"scene {topology.scene!r} has no body {body!r}; it has: {known}")


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
        self._zeromq: zmq.Context[zmq.Socket[bytes]] | None = None
        self._lock = threading.Lock()

    def close(self) -> None:
        with self._lock:
            if self._zenoh is not None:
                self._zenoh.close()
                self._zenoh = None
            if self._zeromq is not None:
                self._zeromq.destroy(linger=100)
                self._zeromq = None

    def subscribe(self, scene: str, stream: str, kind: type[MessageType], transport: Transport) -> Subscription[Any]:
        """Subscribes to the newest message of `stream`, parsed as `kind`."""
        key = stream_key(self.server, scene, stream)
        source = _ZenohSource(self.zenoh(), key) if transport == "zenoh" else _ZeroMqSource(self._subscriber(key))
        return Subscription(source, key, kind)

    def pose_sender(self, scene: str, tool: str, transport: Transport) -> PoseSender:
        """Opens the stream of a tool's poses."""
        key = stream_key(self.server, scene, f"tool/{tool}/pose")
        if transport == "zenoh":
            publisher = self.zenoh().declare_publisher(
                key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME, express=True
            )
            return PoseSender(publisher.put, publisher.undeclare)
        socket = self._socket(zmq.PUSH, self._version.zeromq_pose_endpoint)
        socket.setsockopt(zmq.LINGER, 100)  # a client that ends right after its last pose still delivers it
        socket.connect(self._version.zeromq_pose_endpoint)
        prefix = key.encode() + b"\0"
        return PoseSender(lambda payload: socket.send(prefix + payload), socket.close)

    def zenoh(self) -> zenoh.Session:
        """The session, a client of the daemon's own peer."""
        with self._lock:
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
            return self._zenoh

    def _subscriber(self, key: str) -> zmq.Socket[bytes]:
        socket = self._socket(zmq.SUB, self._version.zeromq_publish_endpoint)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.MAXMSGSIZE, _MAX_MESSAGE_BYTES)
        socket.subscribe(key.encode() + b"\0")
        socket.connect(self._version.zeromq_publish_endpoint)
        return socket

    def _socket(self, kind: int, endpoint: str) -> zmq.Socket[bytes]:
        if not endpoint:
            raise UnavailableError("ZeroMQ is off in this daemon; use zenoh")
        with self._lock:
            if self._zeromq is None:
                self._zeromq = zmq.Context()
            socket = self._zeromq.socket(kind)
        socket.setsockopt(zmq.CONFLATE, 1)
        return socket


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
        self._subscriber = session.declare_subscriber(key, self._put)
        # What the daemon retains (topology, status) comes by query; a stream that retains nothing does not answer.
        session.get(key, handler=self._reply)

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


#: The longest single wait of a subscription [s].
_WAIT_S = 1.0


class Subscription(Closing, Generic[MessageType]):
    """The newest message of one stream. Not to be shared between threads."""

    def __init__(self, source: _Source, key: str, kind: type[MessageType]) -> None:
        self._source = source
        self._key = key
        self._kind = kind
        #: Messages that were not protobuf of this kind.
        self.malformed_count = 0

    def receive(self, timeout_s: float = 5.0) -> MessageType:
        """The newest message that was not yet taken; waits for one.

        Raises:
            DeadlineExceededError: none came in `timeout_s`.
        """
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

    def close(self) -> None:
        self._source.close()


class PoseSequence:
    """Numbers the poses of one client: a random id, then sequences from 1 on."""

    def __init__(self) -> None:
        self._client_id = secrets.randbits(63) | 1
        self.last = 0

    def next(self, position_m: Vector, orientation: Vector | None) -> stream_pb2.ToolPose:
        """The message of the next pose, stamped with the monotonic clock."""
        position = vector3(position_m, "position")
        rotation = quaternion(orientation, "orientation")
        self.last += 1
        return stream_pb2.ToolPose(
            sequence=self.last,
            client_time_ns=time.monotonic_ns(),
            client_id=self._client_id,
            position_m=position,
            orientation=rotation,
        )


class PoseSender(Closing):
    """Sends a tool's poses over the bus, at any rate; each step uses the newest. Not to be shared between threads."""

    def __init__(self, put: Any, close: Any) -> None:  # noqa: ANN401  (of two libraries without common types)
        self._put = put
        self._close = close
        self._sequence = PoseSequence()

    @property
    def last_sequence(self) -> int:
        """Of the last pose sent; comes back as `Feedback.pose_sequence`."""
        return self._sequence.last

    def send(self, position_m: Vector, orientation: Vector | None = None) -> int:
        """Sends a pose ([3] m; w, x, y, z or None for the identity) and returns its sequence."""
        self._put(self._sequence.next(position_m, orientation).SerializeToString())
        return self._sequence.last

    def close(self) -> None:
        self._close()


def _array(vector: scene_pb2.Vector3) -> npt.NDArray[np.float64]:
    return np.array([vector.x, vector.y, vector.z])
