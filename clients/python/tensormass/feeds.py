"""A daemon's streams as browsers get them: the newest message of each, one at a time, found again after any loss.

Daemon   finds the daemon over gRPC, loses it and finds it again; opens a feed for each scene that is watched
Feed     receives the streams of one scene, once for all who watch it, and keeps each frame behind its topology
Outbox   what waits for one watcher, and what is on its way
"""

from __future__ import annotations

import asyncio
import contextlib
import enum
import logging
import secrets
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

import grpc
import zmq
import zmq.asyncio
from google.protobuf.message import DecodeError, Message

from tensormass.streams import reached_endpoints
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

log = logging.getLogger(__name__)

MAX_BUS_MESSAGE_BYTES = 512 << 20
"""A larger message from the daemon is dropped by ZeroMQ."""
RPC_TIMEOUT_S = 5.0


class Stream(enum.StrEnum):
    """The streams that a browser gets, in the order in which they leave: a frame needs its topology."""

    TOPOLOGY = "topology"
    STATUS = "status"
    FRAME = "frame"


class ProtocolError(Exception):
    """A browser sent what it must not; the message goes back as the reason for closing."""


class Outbox:
    """What waits for one browser: the newest message of each stream, and at most one of each on its way."""

    def __init__(self) -> None:
        self.replaced = 0
        """Frames of this scene that a newer one replaced between two that left: those that the browser misses too."""
        self._replaced_since_frame = 0
        self._frame_left = False
        self._waiting: dict[Stream, bytes] = {}
        self._on_the_way: set[Stream] = set()
        self._changed = asyncio.Event()

    @property
    def topology_known(self) -> bool:
        """Whether the browser has acknowledged the newest topology."""
        return Stream.TOPOLOGY not in self._waiting and Stream.TOPOLOGY not in self._on_the_way

    def offer(self, stream: Stream, message: bytes) -> None:
        """Puts `message` into its slot; what waited there is replaced."""
        if stream is Stream.TOPOLOGY:
            self._drop_frame()
        if stream is Stream.FRAME and stream in self._waiting:
            self._replaced_since_frame += 1
        self._waiting[stream] = message
        self._changed.set()

    def clear(self) -> None:
        """Forgets what waits and what was counted, when the browser turns to another scene."""
        self._waiting.clear()
        self._drop_frame()
        self.replaced = 0

    def acknowledge(self, stream: Stream) -> None:
        """Lets the next message of `stream` leave. Raises ProtocolError if none is on its way."""
        if stream not in self._on_the_way:
            raise ProtocolError(f"acknowledged a {stream} message, but none is on its way")
        self._on_the_way.remove(stream)
        self._changed.set()

    async def take(self) -> bytes:
        """Waits for a message that may leave."""
        while True:
            for stream in Stream:
                if self._may_leave(stream):
                    self._on_the_way.add(stream)
                    if stream is Stream.FRAME:
                        self._count_frame()
                    return self._waiting.pop(stream)
            self._changed.clear()
            await self._changed.wait()

    def _may_leave(self, stream: Stream) -> bool:
        # While a topology waits for an acknowledgement, the frames behind it wait too.
        held_back = stream is Stream.FRAME and Stream.TOPOLOGY in self._waiting
        return stream in self._waiting and stream not in self._on_the_way and not held_back

    def _count_frame(self) -> None:
        if self._frame_left:
            self.replaced += self._replaced_since_frame
        self._replaced_since_frame = 0
        self._frame_left = True

    def _drop_frame(self) -> None:
        """A frame that waits belongs to the topology before, and so does the count of those before it."""
        self._waiting.pop(Stream.FRAME, None)
        self._replaced_since_frame = 0
        self._frame_left = False


class Watcher:
    """A browser as the feeds see it: it gets the streams of one scene at a time."""

    def __init__(self) -> None:
        self.outbox = Outbox()
        self.scene: str | None = None
        self.client_id = secrets.randbits(63) | 1
        self.pose_sequence = 0


class Feed:
    """The streams of one scene, received once for all browsers that watch it."""

    def __init__(self, scene: str, daemon: Daemon) -> None:
        self.scene = scene
        self.watchers: set[Watcher] = set()
        self.topology: stream_pb2.Topology | None = None
        self._daemon = daemon
        self._latest: dict[Stream, bytes] = {}
        self._last_sequence = 0
        self._tasks: list[asyncio.Task[None]] = []

    def open(self) -> None:
        """Subscribes anew. What was known is forgotten: it may come from a daemon that is no more."""
        self.close()
        receivers = {
            Stream.TOPOLOGY: self._on_topology,
            Stream.STATUS: self._on_status,
            Stream.FRAME: self._on_frame,
        }
        self._tasks = [background(self._receive(stream, handler)) for stream, handler in receivers.items()]
        self._tasks.append(background(self._fetch_first()))

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        self._latest.clear()
        self.topology = None
        self._last_sequence = 0

    def add(self, watcher: Watcher) -> None:
        """The watcher gets what is known at once and everything new from now on."""
        self.watchers.add(watcher)
        for stream in Stream:
            if stream in self._latest:
                watcher.outbox.offer(stream, self._latest[stream])

    async def _receive(self, stream: Stream, handler: Callable[[bytes], Coroutine[Any, Any, None]]) -> None:
        prefix = self._key(stream)
        with self._daemon.zeromq.socket(zmq.SUB) as socket:
            # CONFLATE keeps one message of the socket, so every stream has a socket of its own.
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
        """Asks for what the bus would bring late (the topology) or never (the frame of a scene that stands still)."""
        try:
            await self._fetch_topology()
            if Stream.FRAME not in self._latest:
                reply = await self._daemon.control.GetFrame(
                    control_pb2.GetFrameRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
                )
                if Stream.FRAME not in self._latest and reply.frame.positions:
                    self._publish(Stream.FRAME, self._message(Stream.FRAME, reply.frame))
        except grpc.aio.AioRpcError as error:
            # The scene went away meanwhile, or the daemon did; the next poll will tell.
            log.info("scene %s: %s", self.scene, error.details())

    async def _fetch_topology(self) -> None:
        reply = await self._daemon.control.GetTopology(
            control_pb2.GetTopologyRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
        )
        self._set_topology(reply.topology)

    def _set_topology(self, topology: stream_pb2.Topology) -> None:
        if topology != self.topology:
            self.topology = topology
            self._latest.pop(Stream.FRAME, None)
            self._publish(Stream.TOPOLOGY, self._message(Stream.TOPOLOGY, topology))

    async def _on_topology(self, payload: bytes) -> None:
        self._set_topology(stream_pb2.Topology.FromString(payload))

    async def _on_status(self, payload: bytes) -> None:
        stream_pb2.SceneStatus.FromString(payload)
        self._publish(Stream.STATUS, self._key(Stream.STATUS) + payload)

    async def _on_frame(self, payload: bytes) -> None:
        frame = stream_pb2.Frame.FromString(payload)
        # Each stream has a socket of its own, so a frame may overtake its topology. Every load has a new version; if a
        # sequence does not rise under the same one, something began anew all the same and may look different.
        known = self.topology is not None and self.topology.version == frame.topology_version
        if not known or frame.sequence <= self._last_sequence:
            await self._fetch_topology()
        self._last_sequence = frame.sequence
        self._publish(Stream.FRAME, self._key(Stream.FRAME) + payload)

    def _publish(self, stream: Stream, message: bytes) -> None:
        self._latest[stream] = message
        for watcher in self.watchers:
            watcher.outbox.offer(stream, message)

    def _key(self, stream: Stream) -> bytes:
        return f"tensormass/{self._daemon.version.server}/{self.scene}/{stream}\0".encode()

    def _message(self, stream: Stream, message: Message) -> bytes:
        return self._key(stream) + message.SerializeToString()


class Daemon:
    """The daemon as seen from here: found over gRPC, followed over ZeroMQ, lost and found again."""

    def __init__(self, control: str, poll_interval_s: float, on_change: Callable[[], None]) -> None:
        self.zeromq = zmq.asyncio.Context()
        self.version = control_pb2.GetVersionResponse()
        self.scenes: set[str] = set()
        self.problem = f"no daemon was found on {control} yet"
        """Why there are no streams; empty while the daemon is there."""
        self.malformed = 0
        """Messages of the bus that were no protobuf."""
        self._address = control
        self._poll_interval_s = poll_interval_s
        self._on_change = on_change
        self._channel = grpc.aio.insecure_channel(
            control,
            options=[
                ("grpc.max_receive_message_length", MAX_BUS_MESSAGE_BYTES),
                ("grpc.enable_http_proxy", 0),
                # A daemon that comes back is found within a poll or two, not after gRPC's two minutes.
                ("grpc.max_reconnect_backoff_ms", max(100, int(1000 * poll_interval_s))),
            ],
        )
        self.control = control_pb2_grpc.ControlStub(self._channel)
        self._feeds: dict[str, Feed] = {}
        self._pose_socket: zmq.Socket[bytes] | None = None

    async def follow(self) -> None:
        """Keeps `version` and `scenes` true until cancelled."""
        while True:
            try:
                answer = await self.control.GetVersion(control_pb2.GetVersionRequest(), timeout=RPC_TIMEOUT_S)
                version = reached_endpoints(answer, self._address)
                reply = await self.control.ListScenes(control_pb2.ListScenesRequest(), timeout=RPC_TIMEOUT_S)
            except grpc.aio.AioRpcError as error:
                self._lose(f"no daemon answers on {self._address}: {error.details()}")
            else:
                if version.zeromq_publish_endpoint:
                    self._find(version, {status.scene for status in reply.scenes})
                else:
                    self._lose(f"the daemon on {self._address} publishes nothing over ZeroMQ (--zeromq-publish)")
            await asyncio.sleep(self._poll_interval_s)

    async def close(self) -> None:
        """Ends every feed and connection."""
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()
        await self._channel.close()
        self.zeromq.destroy(linger=0)

    def watch(self, watcher: Watcher, scene: str) -> None:
        """Moves `watcher` to `scene`, which need not be loaded yet."""
        self.leave(watcher)
        watcher.outbox.clear()
        watcher.scene = scene
        feed = self._feeds.get(scene)
        if feed is None:
            feed = self._feeds[scene] = Feed(scene, self)
            if scene in self.scenes:
                feed.open()
        feed.add(watcher)

    def leave(self, watcher: Watcher) -> None:
        """Ends the subscription of a scene with its last watcher."""
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        if feed is not None:
            feed.watchers.discard(watcher)
            if not feed.watchers:
                feed.close()
                del self._feeds[feed.scene]

    def move_tool(
        self, watcher: Watcher, tool: str, position_m: Sequence[float], orientation_wxyz: Sequence[float] | None
    ) -> None:
        """Sends a pose on behalf of `watcher`; without an orientation the daemon takes the identity.

        Raises ProtocolError on an unknown tool.
        """
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        # Before it has the newest topology, a browser may mean a tool of the one before.
        if feed is None or feed.topology is None or not watcher.outbox.topology_known or self.problem:
            return
        if tool not in {shape.name for shape in feed.topology.tools}:
            raise ProtocolError(f"scene {feed.scene!r} has no tool {tool!r}")
        watcher.pose_sequence += 1
        pose = stream_pb2.ToolPose(
            sequence=watcher.pose_sequence,
            client_time_ns=time.time_ns(),
            client_id=watcher.client_id,
            position_m=scene_pb2.Vector3(**dict(zip("xyz", position_m, strict=True))),
        )
        if orientation_wxyz is not None:
            pose.orientation.CopyFrom(scene_pb2.Quaternion(**dict(zip("wxyz", orientation_wxyz, strict=True))))
        key = f"tensormass/{self.version.server}/{feed.scene}/tool/{tool}/pose\0".encode()
        if self._pose_socket is None:
            # A plain socket of the same context: it never waits, so it needs no event loop.
            self._pose_socket = zmq.Context.shadow(self.zeromq.underlying).socket(zmq.PUSH)
            self._pose_socket.setsockopt(zmq.LINGER, 0)
            # Few, so that a stuck daemon gets no old poses when it wakes; not CONFLATE, which would mix tools.
            self._pose_socket.setsockopt(zmq.SNDHWM, 4)
            self._pose_socket.connect(self.version.zeromq_pose_endpoint)
        # Taken at once or dropped: the next pose is better than this one late.
        with contextlib.suppress(zmq.Again):
            self._pose_socket.send(key + pose.SerializeToString(), flags=zmq.NOBLOCK)

    def state(self) -> dict[str, Any]:
        """What a browser is told about the daemon."""
        return {
            "problem": self.problem,
            "server": self.version.server,
            "version": self.version.version,
            "backend": self.version.backend,
            "device": self.version.device,
            "scenes": sorted(self.scenes),
        }

    def _find(self, version: control_pb2.GetVersionResponse, present: set[str]) -> None:
        before = self.state()
        if self.problem or _identity(version) != _identity(self.version):
            self._forget()
            self.problem, self.version = "", version
        for feed in self._feeds.values():
            if feed.scene in present - self.scenes:
                feed.open()
            elif feed.scene in self.scenes - present:
                feed.close()
        self.scenes = present
        if self.state() != before:
            self._on_change()

    def _lose(self, problem: str) -> None:
        if problem != self.problem:
            log.warning("%s", problem)
            self._forget()
            self.problem = problem
            self._on_change()

    def _forget(self) -> None:
        # What comes back, under whatever name, is another daemon with other scenes and endpoints.
        self.scenes = set()
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()

    def _close_pose_socket(self) -> None:
        if self._pose_socket is not None:
            self._pose_socket.close(linger=0)
            self._pose_socket = None


def background(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """A task whose failure is logged; a lost connection is no failure."""

    def report(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            if isinstance(error, ConnectionError):
                log.info("a browser went away: %s", error)
            else:
                log.error("a task failed", exc_info=error)

    task = asyncio.get_running_loop().create_task(work)
    task.add_done_callback(report)
    return task


def _identity(version: control_pb2.GetVersionResponse) -> tuple[str, str, str]:
    return version.server, version.zeromq_publish_endpoint, version.zeromq_pose_endpoint
