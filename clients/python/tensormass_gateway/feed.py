"""The streams of one scene on the bus, received once for all browsers that watch it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

import grpc
import zmq
import zmq.asyncio
from google.protobuf.message import DecodeError

from tensormass._shared.client_keys import ClientKeys, guard_socket
from tensormass.v1 import changes_pb2, control_pb2, control_pb2_grpc, event_pb2, scene_pb2, stream_pb2
from tensormass_gateway.fields import FieldPoll
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.streams import SceneStreams
from tensormass_gateway.tasks import background

log = logging.getLogger(__name__)

MAX_BUS_MESSAGE_BYTES = 512 << 20
"""ZeroMQ drops a larger message from the daemon."""


RPC_TIMEOUT_S = 5.0

BUS_STREAMS = (Stream.TOPOLOGY, Stream.CHANGES, Stream.STATUS, Stream.EVENTS, Stream.FRAME)
"""Streams that come from the bus. The gateway makes the others."""


class Bus(Protocol):
    """The parts of `daemon.Daemon` that a feed needs."""

    zeromq: zmq.asyncio.Context
    version: control_pb2.GetVersionResponse
    control: control_pb2_grpc.ControlStub
    malformed: int
    known: dict[str, scene_pb2.Scene]
    keys: ClientKeys | None


class Feed(SceneStreams):
    """The streams of one scene on the bus, received once for all browsers that watch it."""

    def __init__(self, scene: str, daemon: Bus) -> None:
        super().__init__(scene)
        self.step: int | None = None
        """Step of the newest frame or status; None before the first."""
        self._daemon = daemon
        self._last_sequence = 0
        #: Tools that a client of the bus claims, by the newest frame.
        self.claimed: set[str] = set()
        self._fields = FieldPoll(self)

    def open(self) -> None:
        """Subscribes again and forgets what was received, which may come from a daemon that has ended."""
        self.close()
        receivers = {
            Stream.TOPOLOGY: self._on_topology,
            Stream.CHANGES: self._on_changes,
            Stream.STATUS: self._on_status,
            Stream.EVENTS: self._on_events,
            Stream.FRAME: self._on_frame,
        }
        self._tasks = [background(self._receive(stream, handler)) for stream, handler in receivers.items()]
        self._tasks.append(background(self._fetch_first()))
        self._tasks.append(background(self._fields.run()))

    def close(self) -> None:
        super().close()
        self.step = None
        self._last_sequence = 0
        self.claimed = set()

    def add(self, watcher: Watcher) -> None:
        """Sends the newest messages to a watcher at once, and every new one from now on."""
        super().add(watcher)
        self._fields.forget(watcher)

    def show_detail(self, watcher: Watcher) -> None:
        super().show_detail(watcher)
        self._fields.forget(watcher)

    def show_field(self, watcher: Watcher, name: str) -> None:
        """Sends `watcher` the element field `name` from now on; empty: none."""
        watcher.field = name
        self._fields.wake()

    @property
    def control(self) -> control_pb2_grpc.ControlStub:
        return self._daemon.control

    @property
    def server(self) -> str:
        return self._daemon.version.server

    @property
    def known(self) -> scene_pb2.Scene | None:
        """Returns the scene's message, if this gateway or its program loaded it."""
        return self._daemon.known.get(self.scene)

    def learn(self) -> None:
        super().learn()
        self._fields.wake()

    async def _receive(self, stream: Stream, handler: Callable[[bytes], Coroutine[Any, Any, None]]) -> None:
        prefix = self.key(stream)
        with self._daemon.zeromq.socket(zmq.SUB) as socket:
            # CONFLATE keeps one message for each socket, so every stream has its own socket.
            guard_socket(self._daemon.keys, socket)
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
                if reply.HasField("changes"):
                    self._take_changes(reply.changes)
                if Stream.FRAME not in self._latest and reply.frame.positions:
                    self.publish(Stream.FRAME, self.shared(self.message(Stream.FRAME, reply.frame), reply.frame))
        except grpc.aio.AioRpcError as error:
            # Scene or daemon ended meanwhile; the next poll finds out.
            log.info("scene %s: %s", self.scene, error.details())

    async def _fetch_topology(self) -> None:
        reply = await self._daemon.control.GetTopology(
            control_pb2.GetTopologyRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
        )
        self.set_topology(reply.topology)

    async def _on_topology(self, payload: bytes) -> None:
        self.set_topology(stream_pb2.Topology.FromString(payload))

    async def _on_changes(self, payload: bytes) -> None:
        changes = changes_pb2.SurfaceChanges.FromString(payload)
        # Changes may overtake their topology, like a frame.
        if self.topology is None or self.topology.version < changes.topology_version:
            await self._fetch_topology()
        self._take_changes(changes)

    def _take_changes(self, changes: changes_pb2.SurfaceChanges) -> None:
        try:
            self.set_changes(changes)
        except ValueError as error:
            self._daemon.malformed += 1
            log.warning("scene %s: its surface stays as it was: %s", self.scene, error)

    async def _on_events(self, payload: bytes) -> None:
        event_pb2.SceneEvents.FromString(payload)
        self.publish(Stream.EVENTS, self.key(Stream.EVENTS) + payload)

    async def _on_status(self, payload: bytes) -> None:
        self.step = stream_pb2.SceneStatus.FromString(payload).step
        self.publish(Stream.STATUS, self.key(Stream.STATUS) + payload)

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
        self.claimed = {tool.tool for tool in frame.tools if tool.claimed}
        self.publish(Stream.FRAME, self.shared(self.key(Stream.FRAME) + payload, frame))
