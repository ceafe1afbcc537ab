"""The streams of one scene, received once for all browsers that watch it.

Every frame stays behind its topology: a browser never gets positions that do not fit what it draws.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

import grpc
import zmq
import zmq.asyncio
from google.protobuf.message import DecodeError, Message

from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.fields import FieldPoll
from tensormass_gateway.normals import Triangles
from tensormass_gateway.outbox import Message as Outgoing
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.surface import MismatchError, rest_positions
from tensormass_gateway.tasks import background

log = logging.getLogger(__name__)

MAX_BUS_MESSAGE_BYTES = 512 << 20
"""ZeroMQ drops a larger message from the daemon."""


RPC_TIMEOUT_S = 5.0

BUS_STREAMS = (Stream.TOPOLOGY, Stream.STATUS, Stream.FRAME)
"""Streams that come from the bus. The gateway makes the others."""

ENCODED_FRAME = "encoded_frame"
"""Name in the key of a frame that is not the bus's own. In the outbox it is a frame like others."""


class Bus(Protocol):
    """The parts of `daemon.Daemon` that a feed needs."""

    zeromq: zmq.asyncio.Context
    version: control_pb2.GetVersionResponse
    control: control_pb2_grpc.ControlStub
    malformed: int
    known: dict[str, scene_pb2.Scene]


class Feed:
    """The streams of one scene, received once for all browsers that watch it."""

    def __init__(self, scene: str, daemon: Bus) -> None:
        self.scene = scene
        self.watchers: set[Watcher] = set()
        self.topology: stream_pb2.Topology | None = None
        self.step: int | None = None
        """Step of the newest frame or status; None before the first."""
        self._daemon = daemon
        self._latest: dict[Stream, Outgoing] = {}
        self._triangles: Triangles | None = None
        self._last_sequence = 0
        self._tasks: list[asyncio.Task[None]] = []
        self._fields = FieldPoll(self)

    def open(self) -> None:
        """Subscribes again and forgets what was received, which may come from a daemon that has ended."""
        self.close()
        receivers = {
            Stream.TOPOLOGY: self._on_topology,
            Stream.STATUS: self._on_status,
            Stream.FRAME: self._on_frame,
        }
        self._tasks = [background(self._receive(stream, handler)) for stream, handler in receivers.items()]
        self._tasks.append(background(self._fetch_first()))
        self._tasks.append(background(self._fields.run()))

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        self._latest.clear()
        self.topology = None
        self.step = None
        self._last_sequence = 0

    def add(self, watcher: Watcher) -> None:
        """Sends the newest messages to a watcher at once, and every new one from now on."""
        self.watchers.add(watcher)
        for stream in Stream:
            if stream in self._latest:
                watcher.outbox.offer(stream, self._latest[stream])
        self._fields.wake()

    def show_field(self, watcher: Watcher, name: str) -> None:
        """Sends `watcher` the element field `name` from now on; empty: none."""
        watcher.field = name
        self._fields.wake()

    @property
    def control(self) -> control_pb2_grpc.ControlStub:
        return self._daemon.control

    @property
    def known(self) -> scene_pb2.Scene | None:
        """Returns the scene's message, if this gateway or its program loaded it."""
        return self._daemon.known.get(self.scene)

    def learn(self) -> None:
        """Computes what the scene's message tells, which has become known."""
        if self.topology is not None and self.known is not None:
            self._tasks.append(background(self._publish_rest(self.topology, self.known)))
        self._fields.wake()

    async def _publish_rest(self, topology: stream_pb2.Topology, scene: scene_pb2.Scene) -> None:
        try:
            positions = await asyncio.to_thread(rest_positions, scene, topology)
        except MismatchError as error:
            log.info("scene %s: no rest positions: %s", self.scene, error)
            return
        if self.topology is topology and len(positions):
            rest = stream_pb2.Frame(topology_version=topology.version, positions=positions.tobytes())
            self._publish(Stream.REST, self._message(Stream.REST, rest))

    async def _receive(self, stream: Stream, handler: Callable[[bytes], Coroutine[Any, Any, None]]) -> None:
        prefix = self.key(stream)
        with self._daemon.zeromq.socket(zmq.SUB) as socket:
            # CONFLATE keeps one message for each socket, so every stream has its own socket.
            socket.setsockopt(zmq.CONFLATE, 1)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.MAXMSGSIZE, MAX_BUS_MESSAGE_BYTES)
            socket.subscribe(prefix)
            socket.connect(self._daemon.version.zeromq_publish_endpoint)
            while True:
                message: bytes = await socket.recv()
                try:
                    await handler(message[len(prefix) :])
                except DecodeError:
                    self._daemon.malformed += 1
                    log.warning("scene %s: a %s message of %d bytes is not protobuf", self.scene, stream, len(message))
                except grpc.aio.AioRpcError as error:
                    log.warning("scene %s: no topology for its frames: %s", self.scene, error.details())

    async def _fetch_first(self) -> None:
        """Asks for the topology, which the bus sends late, and the frame of a paused scene, which it never sends."""
        try:
            await self._fetch_topology()
            if Stream.FRAME not in self._latest:
                reply = await self._daemon.control.GetFrame(
                    control_pb2.GetFrameRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
                )
                if Stream.FRAME not in self._latest and reply.frame.positions:
                    self._publish(Stream.FRAME, self._shared(self._message(Stream.FRAME, reply.frame), reply.frame))
        except grpc.aio.AioRpcError as error:
            # Scene or daemon ended meanwhile; the next poll finds out.
            log.info("scene %s: %s", self.scene, error.details())

    async def _fetch_topology(self) -> None:
        reply = await self._daemon.control.GetTopology(
            control_pb2.GetTopologyRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
        )
        self._set_topology(reply.topology)

    def _set_topology(self, topology: stream_pb2.Topology) -> None:
        if topology != self.topology:
            self.topology = topology
            self._triangles = self._read_triangles(topology)
            self._latest.pop(Stream.FRAME, None)
            self._latest.pop(Stream.REST, None)
            self._publish(Stream.TOPOLOGY, self._message(Stream.TOPOLOGY, topology))
            self.learn()

    async def _on_topology(self, payload: bytes) -> None:
        self._set_topology(stream_pb2.Topology.FromString(payload))

    async def _on_status(self, payload: bytes) -> None:
        self.step = stream_pb2.SceneStatus.FromString(payload).step
        self._publish(Stream.STATUS, self.key(Stream.STATUS) + payload)

    async def _on_frame(self, payload: bytes) -> None:
        frame = stream_pb2.Frame.FromString(payload)
        # A frame may overtake its topology, because each stream has its own socket. Every load has a new topology
        # version. If the sequence does not rise under the same version, the scene started again and its topology may
        # differ.
        known = self.topology is not None and self.topology.version == frame.topology_version
        if not known or frame.sequence <= self._last_sequence:
            await self._fetch_topology()
        self._last_sequence = frame.sequence
        self.step = frame.step
        self._publish(Stream.FRAME, self._shared(self.key(Stream.FRAME) + payload, frame))

    def _shared(self, message: bytes, frame: stream_pb2.Frame) -> SharedFrame:
        return SharedFrame(message, self.key(ENCODED_FRAME), frame, self._triangles)

    def _read_triangles(self, topology: stream_pb2.Topology) -> Triangles | None:
        try:
            return Triangles(topology)
        except ValueError as error:
            log.warning("scene %s: its frames get no normals: %s", self.scene, error)
            return None

    def _publish(self, stream: Stream, message: Outgoing) -> None:
        self._latest[stream] = message
        for watcher in self.watchers:
            watcher.outbox.offer(stream, message)

    def key(self, stream: str) -> bytes:
        """Returns the key of a stream, with its zero byte."""
        return f"tensormass/{self._daemon.version.server}/{self.scene}/{stream}\0".encode()

    def _message(self, stream: Stream, message: Message) -> bytes:
        return self.key(stream) + message.SerializeToString()
