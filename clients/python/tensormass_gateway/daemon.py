"""Finds the daemon over gRPC, loses it and finds it again; opens a feed for each scene that is watched.

Daemon --has--> Feed, one a scene (feed.py) --offers to--> Outbox, one a browser (outbox.py)
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence

import grpc
import zmq
import zmq.asyncio

from tensormass._shared.client_keys import ClientKeys, channel_options, guard_socket
from tensormass._shared.endpoints import reached_endpoints
from tensormass.v1 import control_pb2, control_pb2_grpc, gateway_pb2, scene_pb2, stream_pb2
from tensormass_gateway.feed import MAX_BUS_MESSAGE_BYTES, RPC_TIMEOUT_S, Feed
from tensormass_gateway.outbox import Watcher
from tensormass_gateway.requests import ProtocolError, printable
from tensormass_gateway.tasks import background

log = logging.getLogger(__name__)

#: Time for which a pose with power holds. The page repeats it more often [s].
PEDAL_S = 0.5


class Daemon:
    """The connection to a daemon: found over gRPC, followed over ZeroMQ, lost and found again."""

    def __init__(
        self,
        control: str,
        poll_interval_s: float,
        on_change: Callable[[], None],
        known: Mapping[str, scene_pb2.Scene] | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        self.keys = keys
        self.zeromq = zmq.asyncio.Context()
        self.version = control_pb2.GetVersionResponse()
        self.scenes: set[str] = set()
        self.problem = f"no daemon was found on {control} yet"
        """Reason why there are no streams; empty while the daemon answers."""
        self.malformed = 0
        """Number of messages from the bus that were not protobuf."""
        self.known = dict(known or {})
        """Messages of loaded scenes, by name. They have meshes, which the bus does not carry."""
        self._address = control
        self._poll_interval_s = poll_interval_s
        self._on_change = on_change
        options = [
            ("grpc.max_receive_message_length", MAX_BUS_MESSAGE_BYTES),
            ("grpc.enable_http_proxy", 0),
            # Finds a restarted daemon within two polls, not after gRPC's two minutes.
            ("grpc.max_reconnect_backoff_ms", max(100, int(1000 * poll_interval_s))),
        ]
        if keys is None:
            self._channel = grpc.aio.insecure_channel(control, options=options)
        else:
            self._channel = grpc.aio.secure_channel(
                control, keys.channel_credentials(), options=channel_options(keys, options)
            )
        self.control = control_pb2_grpc.ControlStub(self._channel)
        self._feeds: dict[str, Feed] = {}
        # Answers must be taken in the order of their questions: an old list of scenes would hide a new scene.
        self._asking = asyncio.Lock()
        self._pose_socket: zmq.Socket[bytes] | None = None

    async def follow(self) -> None:
        """Keeps `version` and `scenes` up to date until cancelled."""
        while True:
            await self.refresh()
            await asyncio.sleep(self._poll_interval_s)

    async def refresh(self) -> None:
        """Asks the daemon for its version and scenes now."""
        async with self._asking:
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

    async def metrics(self) -> str:
        """Returns what Prometheus scrapes of the daemon; empty if it does not tell."""
        try:
            answer = await self.control.GetMetrics(control_pb2.GetMetricsRequest(), timeout=RPC_TIMEOUT_S)
        except grpc.aio.AioRpcError as error:
            log.info("no metrics of the daemon on %s: %s", self._address, error.details())
            return ""
        return answer.text

    async def close(self) -> None:
        """Closes every feed and connection."""
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()
        await self._channel.close()
        self.zeromq.destroy(linger=0)

    def watch(self, watcher: Watcher, scene: str) -> None:
        """Moves `watcher` to `scene`, which may be loaded later."""
        self.leave(watcher)
        watcher.outbox.clear()
        watcher.scene, watcher.field = scene, ""
        feed = self._feeds.get(scene)
        if feed is None:
            feed = self._feeds[scene] = Feed(scene, self)
            if scene in self.scenes:
                feed.open()
        feed.add(watcher)

    def leave(self, watcher: Watcher) -> None:
        """Removes `watcher`. The last watcher of a scene ends its subscription."""
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        if feed is not None:
            feed.watchers.discard(watcher)
            if not feed.watchers:
                feed.close()
                del self._feeds[feed.scene]

    def show_field(self, watcher: Watcher, name: str) -> None:
        """Sends `watcher` the element field `name` of its scene from now on; empty: none."""
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        if feed is not None:
            feed.show_field(watcher, name)

    def show_detail(self, watcher: Watcher) -> None:
        """Sends `watcher` its scene in the detail that it chose anew."""
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        if feed is not None:
            feed.show_detail(watcher)

    def learn(self, scene: scene_pb2.Scene) -> None:
        """Takes the message of a scene that was loaded."""
        self.known[scene.name] = scene
        if scene.name in self._feeds:
            self._feeds[scene.name].learn()
        self._on_change()

    def move_tool(
        self,
        watcher: Watcher,
        tool: str,
        position_m: Sequence[float],
        orientation_wxyz: Sequence[float] | None,
        level: float = 0.0,
    ) -> None:
        """Sends a pose on behalf of `watcher`; without an orientation the daemon takes the identity.

        With a level above zero the pose holds for PEDAL_S, because a browser that is gone must not burn on.

        A tool that a client of the bus claims is taken over, which only the control plane can do.

        Raises ProtocolError on an unknown tool.
        """
        feed = self._feeds.get(watcher.scene) if watcher.scene is not None else None
        # A browser that has not seen the newest topology may mean a tool of the previous one.
        if feed is None or feed.topology is None or not watcher.outbox.topology_known or self.problem:
            return
        if tool not in {shape.name for shape in feed.topology.tools if not shape.tool.fixed}:
            raise ProtocolError(f"scene {feed.scene!r} has no tool {tool!r} that can be moved")
        watcher.pose_sequence += 1
        pose = stream_pb2.ToolPose(
            sequence=watcher.pose_sequence,
            client_time_ns=time.time_ns(),
            client_id=watcher.client_id,
            session=watcher.session,
            position_m=scene_pb2.Vector3(**dict(zip("xyz", position_m, strict=True))),
            level=level,
            valid_for_s=PEDAL_S if level > 0 else None,
        )
        if orientation_wxyz is not None:
            pose.orientation.CopyFrom(scene_pb2.Quaternion(**dict(zip("wxyz", orientation_wxyz, strict=True))))
        if tool in feed.claimed:
            background(self._take_over(control_pb2.MoveToolRequest(scene=feed.scene, tool=tool, pose=pose)))
            return
        key = f"tensormass/{self.version.server}/{feed.scene}/tool/{tool}/pose\0".encode()
        if self._pose_socket is None:
            # A plain socket of the same context needs no event loop, because it never waits.
            self._pose_socket = zmq.Context.shadow(self.zeromq.underlying).socket(zmq.PUSH)
            guard_socket(self.keys, self._pose_socket)
            self._pose_socket.setsockopt(zmq.LINGER, 0)
            # Few messages, so that a stuck daemon gets no old poses when it wakes. CONFLATE would mix tools.
            self._pose_socket.setsockopt(zmq.SNDHWM, 4)
            self._pose_socket.connect(self.version.zeromq_pose_endpoint)
        # Sends at once or drops the pose, because the next pose is better than a late one.
        with contextlib.suppress(zmq.Again):
            self._pose_socket.send(key + pose.SerializeToString(), flags=zmq.NOBLOCK)

    async def _take_over(self, request: control_pb2.MoveToolRequest) -> None:
        try:
            await self.control.MoveTool(request, timeout=RPC_TIMEOUT_S)
        except grpc.aio.AioRpcError as error:
            log.info("scene %s: %s", request.scene, error.details())

    def state(self) -> gateway_pb2.DaemonState:
        """Returns what all browsers are told about the daemon."""
        return gateway_pb2.DaemonState(
            problem=printable(self.problem),
            server=self.version.server,
            version=self.version.version,
            backend=self.version.backend,
            device=self.version.device,
            scenes=sorted(self.scenes),
            field_scenes=sorted(self.scenes & self.known.keys()),
        )

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
        self.known = {name: scene for name, scene in self.known.items() if name in present}
        if self.state() != before:
            self._on_change()

    def _lose(self, problem: str) -> None:
        if problem != self.problem:
            log.warning("%s", problem)
            self._forget()
            self.problem = problem
            self._on_change()

    def _forget(self) -> None:
        # A daemon that comes back is another one, with other scenes and endpoints, whatever its name.
        self.scenes = set()
        if self.version.server:
            self.known = {}
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()

    def _close_pose_socket(self) -> None:
        if self._pose_socket is not None:
            self._pose_socket.close(linger=0)
            self._pose_socket = None


def _identity(version: control_pb2.GetVersionResponse) -> tuple[str, str, str]:
    return version.server, version.zeromq_publish_endpoint, version.zeromq_pose_endpoint
