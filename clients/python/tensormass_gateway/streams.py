"""The newest messages of one scene, for all browsers that watch it.

Every frame stays behind its topology: a browser never gets positions that do not fit what it draws. A browser that asks
for less detail gets neither topology nor frames until its level (detail.py) is made. While a surface has changes it is
not simplified, and every browser gets the whole.
"""

from __future__ import annotations

import asyncio
import logging

import numpy as np
import numpy.typing as npt
from google.protobuf.message import Message

from tensormass._shared.surfaces import Surface
from tensormass.v1 import changes_pb2, scene_pb2, stream_pb2
from tensormass_gateway.choice import MAX_DETAIL
from tensormass_gateway.detail import MAX_LEVELS, SIMPLIFIED_TOPOLOGY, SIMPLIFIER, Level
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.normals import Triangles
from tensormass_gateway.outbox import OF_THE_SCENE, OF_THE_TOPOLOGY, Stream, Watcher
from tensormass_gateway.outbox import Message as Outgoing
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
        self.surface: Surface | None = None
        """The topology with its changes; None without a topology."""
        self._levels: dict[float, Level | None] = {}
        """Levels of the topology by detail; None: it cannot be simplified, so its viewers get the whole."""
        self._awaited: set[float] = set()
        """Details whose levels are being made for this topology."""
        self._simplifying = asyncio.Lock()
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
        self._forget_levels()
        self.topology = self.surface = None

    def add(self, watcher: Watcher) -> None:
        """Sends the newest messages to a watcher at once, and every new one from now on."""
        self.watchers.add(watcher)
        for stream in Stream:
            self._offer(watcher, stream)

    def show_detail(self, watcher: Watcher) -> None:
        """Sends topology and values in the detail that a watcher chose anew."""
        self._offer(watcher, Stream.TOPOLOGY)
        for stream in Stream:
            if stream in OF_THE_TOPOLOGY:
                self._offer(watcher, stream)

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
            self._forget_levels()
            self.surface = Surface(topology)
            self._triangles = self._read_triangles(self.surface)
            for stream in OF_THE_TOPOLOGY:
                self._latest.pop(stream, None)
            self.publish(Stream.TOPOLOGY, self.message(Stream.TOPOLOGY, topology))
            self.learn()

    def set_changes(self, changes: changes_pb2.SurfaceChanges, *, may_go_back: bool = False) -> None:
        """Takes changes of the topology, unless newer ones are known.

        Args:
            may_go_back: takes older ones, too, because a recording is shown from an earlier time on.

        Raises:
            ValueError: they do not fit the topology; the ones before stay.
        """
        before = self.surface
        if before is None or changes.topology_version != before.topology.version:
            return
        if changes.revision == before.revision or (changes.revision < before.revision and not may_go_back):
            return
        surface = Surface(before.topology, changes)
        self.surface = surface
        self._triangles = self._read_triangles(surface)
        self._latest[Stream.CHANGES] = self.message(Stream.CHANGES, changes)
        for watcher in self.watchers:
            if watcher.detail != MAX_DETAIL and surface.is_changed != before.is_changed:
                self.show_detail(watcher)
            else:
                self._offer(watcher, Stream.CHANGES)

    @property
    def is_changed(self) -> bool:
        """Tells whether the surface differs from its topology."""
        return self.surface is not None and self.surface.is_changed

    def _read_triangles(self, surface: Surface) -> Triangles | None:
        try:
            return Triangles(surface.topology, surface)
        except ValueError as error:
            log.warning("scene %s: its frames get no normals: %s", self.scene, error)
            return None

    def shared(self, message: bytes, frame: stream_pb2.Frame) -> SharedFrame:
        """Makes a frame that each browser gets in its own codec. Takes `frame` over."""
        # Changes and frames may overtake each other. The page then computes the normals.
        fits = self.surface is not None and self.surface.revision == frame.revision
        return SharedFrame(message, self.key(ENCODED_FRAME), frame, self._triangles if fits else None)

    def publish(self, stream: Stream, message: Outgoing) -> None:
        """Gives a message to all watchers, and to those that come before the next one."""
        self._latest[stream] = message
        for watcher in self.watchers:
            self._offer(watcher, stream)

    def key(self, stream: str) -> bytes:
        """Returns the key of a stream, with its zero byte."""
        return f"tensormass/{self.server}/{self.scene}/{stream}\0".encode()

    def message(self, stream: Stream, message: Message) -> bytes:
        """Returns a message with its key."""
        return self.key(stream) + message.SerializeToString()

    # --- levels of detail

    def shown_version(self, watcher: Watcher) -> int | None:
        """Returns the version of the topology that a watcher shows; None while it is not made."""
        waits = watcher.detail != MAX_DETAIL and not self.is_changed and watcher.detail not in self._levels
        if self.topology is None or waits:
            return None
        level = self._level_of(watcher)
        return self.topology.version if level is None else level.version

    def at_shown_vertices(self, watcher: Watcher, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Returns values of all vertices, [vertex_count], at those that a watcher shows."""
        level = self._level_of(watcher)
        return values if level is None else values[level.vertices]

    def _level_of(self, watcher: Watcher) -> Level | None:
        whole = watcher.detail == MAX_DETAIL or self.is_changed
        return None if whole else self._levels.get(watcher.detail)

    def _offer(self, watcher: Watcher, stream: Stream) -> None:
        """Puts the newest message of a stream into a watcher's outbox, in its detail."""
        message = self._latest.get(stream)
        if message is None:
            return
        if stream not in OF_THE_SCENE and watcher.detail != MAX_DETAIL and not self.is_changed:
            if watcher.detail not in self._levels:
                self._await_level(watcher.detail)
                return
            level = self._levels[watcher.detail]
            message = message if level is None else self._simplified(stream, message, level)
        if message is not None:
            watcher.outbox.offer(stream, message)

    def _simplified(self, stream: Stream, message: Outgoing, level: Level) -> Outgoing | None:
        """Returns a message in less detail; None: it is not of this topology."""
        if isinstance(message, SharedFrame):
            return level.frame(message, self.key(stream)) if level.fits(message) else None
        if stream is Stream.CHANGES:
            return None  # they are empty
        if stream is Stream.TOPOLOGY:
            return self.key(SIMPLIFIED_TOPOLOGY) + level.message().SerializeToString()
        assert stream is Stream.REST
        whole = stream_pb2.Frame.FromString(message[len(self.key(stream)) :])
        return self.message(stream, level.rest(whole))

    def _await_level(self, detail: float) -> None:
        """Starts to make a level, if there is a frame to make it from and nobody else has started."""
        frame, topology = self._latest.get(Stream.FRAME), self.topology
        if topology is None or not isinstance(frame, SharedFrame) or detail in self._awaited:
            return
        vertex_count = sum(body.vertex_count for body in topology.bodies)
        fits = (frame.head.topology_version, frame.vertex_count) == (topology.version, vertex_count)
        if fits and frame.is_encodable:
            self._awaited.add(detail)
            self._tasks = [task for task in self._tasks if not task.done()]
            self._tasks.append(background(self._make_level(topology, frame, detail)))

    async def _make_level(self, topology: stream_pb2.Topology, frame: SharedFrame, detail: float) -> None:
        level = None
        async with self._simplifying:
            # A viewer may have asked for many details one after the other. Those that nobody shows cost nothing.
            wanted = self.topology is topology and any(watcher.detail == detail for watcher in self.watchers)
            if wanted:
                loop = asyncio.get_running_loop()
                try:
                    level = await loop.run_in_executor(SIMPLIFIER, Level, topology, frame, detail)
                except ValueError as error:
                    log.warning("scene %s: it is shown in full detail: %s", self.scene, error)
        if self.topology is not topology:
            return
        self._awaited.discard(detail)
        if wanted:
            self._levels[detail] = level
            self._drop_levels(detail)
            if self.is_changed:
                return
            for watcher in self.watchers:
                if watcher.detail == detail:
                    self.show_detail(watcher)

    def _drop_levels(self, newest: float) -> None:
        """Drops the oldest levels that nobody shows, down to MAX_LEVELS."""
        shown = {watcher.detail for watcher in self.watchers} | {newest}
        unseen = [detail for detail in self._levels if detail not in shown]
        for detail in unseen[: max(0, len(self._levels) - MAX_LEVELS)]:
            del self._levels[detail]

    def _forget_levels(self) -> None:
        self._levels = {}
        self._awaited = set()
