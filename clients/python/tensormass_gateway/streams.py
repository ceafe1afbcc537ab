"""The newest messages of one scene, for all browsers that watch it.

Every frame stays behind its topology: a browser never gets positions that do not fit what it draws.
"""

from __future__ import annotations

import asyncio
import logging

from google.protobuf.message import Message

from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.normals import Triangles
from tensormass_gateway.outbox import Message as Outgoing
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.surface import MismatchError, rest_positions
from tensormass_gateway.tasks import background

log = logging.getLogger(__name__)

ENCODED_FRAME = "encoded_frame"
"""Name in the key of a frame that is not the bus's own. In the outbox it is a frame like others."""


class SceneStreams:
    """The newest messages of one scene, for all browsers that watch it."""

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.watchers: set[Watcher] = set()
        self.topology: stream_pb2.Topology | None = None
        self._latest: dict[Stream, Outgoing] = {}
        self._triangles: Triangles | None = None
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def server(self) -> str:
        """Returns the name of the server in the keys."""
        raise NotImplementedError

    @property
    def known(self) -> scene_pb2.Scene | None:
        """Returns the scene's message; None if it is unknown."""
        raise NotImplementedError

    def close(self) -> None:
        """Ends the tasks and forgets what was received."""
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        self._latest.clear()
        self.topology = None

    def add(self, watcher: Watcher) -> None:
        """Sends the newest messages to a watcher at once, and every new one from now on."""
        self.watchers.add(watcher)
        for stream in Stream:
            if stream in self._latest:
                watcher.outbox.offer(stream, self._latest[stream])

    def learn(self) -> None:
        """Computes what the scene's message tells, which has become known."""
        if self.topology is not None and self.known is not None:
            self._tasks.append(background(self._publish_rest(self.topology, self.known)))

    async def _publish_rest(self, topology: stream_pb2.Topology, scene: scene_pb2.Scene) -> None:
        try:
            positions = await asyncio.to_thread(rest_positions, scene, topology)
        except MismatchError as error:
            log.info("scene %s: no rest positions: %s", self.scene, error)
            return
        if self.topology is topology and len(positions):
            rest = stream_pb2.Frame(topology_version=topology.version, positions=positions.tobytes())
            self.publish(Stream.REST, self.message(Stream.REST, rest))

    def set_topology(self, topology: stream_pb2.Topology) -> None:
        """Takes a topology, which ends the frames of the one before."""
        if topology != self.topology:
            self.topology = topology
            self._triangles = self._read_triangles(topology)
            self._latest.pop(Stream.FRAME, None)
            self._latest.pop(Stream.REST, None)
            self.publish(Stream.TOPOLOGY, self.message(Stream.TOPOLOGY, topology))
            self.learn()

    def _read_triangles(self, topology: stream_pb2.Topology) -> Triangles | None:
        try:
            return Triangles(topology)
        except ValueError as error:
            log.warning("scene %s: its frames get no normals: %s", self.scene, error)
            return None

    def shared(self, message: bytes, frame: stream_pb2.Frame) -> SharedFrame:
        """Makes a frame that each browser gets in its own codec. Takes `frame` over."""
        return SharedFrame(message, self.key(ENCODED_FRAME), frame, self._triangles)

    def publish(self, stream: Stream, message: Outgoing) -> None:
        """Gives a message to all watchers, and to those that come before the next one."""
        self._latest[stream] = message
        for watcher in self.watchers:
            watcher.outbox.offer(stream, message)

    def key(self, stream: str) -> bytes:
        """Returns the key of a stream, with its zero byte."""
        return f"tensormass/{self.server}/{self.scene}/{stream}\0".encode()

    def message(self, stream: Stream, message: Message) -> bytes:
        """Returns a message with its key."""
        return self.key(stream) + message.SerializeToString()
