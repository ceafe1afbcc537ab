"""A daemon that simulates nothing: it speaks the protocol and says what a test tells it to.

For faults that a real daemon does not produce on demand: a frame ahead of its topology, garbage on the bus, a restart
between two polls.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import grpc
import numpy as np
import zmq
import zmq.asyncio
from google.protobuf.message import Message

from tensormass.v1 import changes_pb2, control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

Call = grpc.aio.ServicerContext[Any, Any]


@dataclass
class Endpoints:
    """Ports to come back on; 0: a free one."""

    control: int = 0
    publish: int = 0
    pose: int = 0


def triangle_topology(scene: str, version: int = 1, vertex_count: int = 3) -> stream_pb2.Topology:
    """A fan of triangles around its first vertex, and one tool."""
    fan = [(0, k, k + 1) for k in range(1, vertex_count - 1)]
    return stream_pb2.Topology(
        scene=scene,
        version=version,
        bodies=[
            stream_pb2.BodySurface(
                name="fan", first_vertex=0, vertex_count=vertex_count, triangles=np.array(fan, "<u4").tobytes()
            )
        ],
        tools=[stream_pb2.ToolShape(name="probe", radius_m=0.01)],
    )


def frame_of(topology: stream_pb2.Topology, sequence: int) -> stream_pb2.Frame:
    """A frame that fits `topology`; all its coordinates are `sequence` [m], its time in ms."""
    vertex_count = sum(body.vertex_count for body in topology.bodies)
    return stream_pb2.Frame(
        topology_version=topology.version,
        sequence=sequence,
        step=sequence,
        server_time_ns=1_000_000 * sequence,
        positions=np.full((vertex_count, 3), sequence, "<f4").tobytes(),
        tools=[stream_pb2.ToolFeedback(tool=tool.name, force_n=scene_pb2.Vector3(z=1.0)) for tool in topology.tools],
    )


class FakeDaemon(control_pb2_grpc.ControlServicer):
    """Use `fake_daemon()`. Scenes are `topologies` and `frames`; a test changes them as it likes."""

    def __init__(self, endpoints: Endpoints, server: str) -> None:
        self.endpoints = endpoints
        self.server = server
        self.topologies: dict[str, stream_pb2.Topology] = {}
        self.frames: dict[str, stream_pb2.Frame] = {}
        self.changes: dict[str, changes_pb2.SurfaceChanges] = {}
        self.publishes = True
        #: Answer to GetFields, and its requests.
        self.fields = control_pb2.GetFieldsResponse()
        self.asked_fields: list[control_pb2.GetFieldsRequest] = []
        #: Calls that change a scene, in their order.
        self.commands: list[Message] = []
        #: Makes every call that changes a scene fail with this text; empty: they succeed.
        self.refusal = ""
        #: Answer to GetMetrics.
        self.metrics = ""
        #: Holds every call that changes a scene until it is set.
        self.released = asyncio.Event()
        self.released.set()
        self._subscriptions: dict[bytes, int] = {}
        self._changed = asyncio.Condition()
        self._context = zmq.asyncio.Context()
        self._publisher = self._context.socket(zmq.XPUB)
        self._poses = self._context.socket(zmq.PULL)
        self._grpc = grpc.aio.server()
        self._reader: asyncio.Task[None] | None = None

    @property
    def control(self) -> str:
        return f"127.0.0.1:{self.endpoints.control}"

    def key(self, scene: str, stream: str) -> bytes:
        return f"tensormass/{self.server}/{scene}/{stream}\0".encode()

    async def publish(self, scene: str, stream: str, payload: bytes) -> None:
        await self._publisher.send(self.key(scene, stream) + payload)

    async def wait_subscribed(self, scene: str, stream: str, *, count: int = 1, timeout_s: float = 10.0) -> None:
        """Waits until exactly `count` (0 or 1: XPUB reports the first and the last) subscriptions are there."""
        key = self.key(scene, stream)
        async with asyncio.timeout(timeout_s), self._changed:
            await self._changed.wait_for(lambda: self._subscriptions.get(key, 0) == count)

    async def next_pose(self, timeout_s: float = 10.0) -> tuple[str, stream_pb2.ToolPose]:
        async with asyncio.timeout(timeout_s):
            message: bytes = await self._poses.recv()
        key, payload = message.split(b"\0", 1)
        return key.decode(), stream_pb2.ToolPose.FromString(payload)

    async def start(self) -> None:
        control_pb2_grpc.add_ControlServicer_to_server(self, self._grpc)
        self.endpoints.control = self._grpc.add_insecure_port(f"127.0.0.1:{self.endpoints.control}")
        await self._grpc.start()
        self.endpoints.publish = _bind(self._publisher, self.endpoints.publish)
        self.endpoints.pose = _bind(self._poses, self.endpoints.pose)
        self._reader = asyncio.create_task(self._read_subscriptions())

    async def stop(self) -> None:
        if self._reader is not None:
            self._reader.cancel()
        await self._grpc.stop(grace=None)
        self._context.destroy(linger=0)

    async def _read_subscriptions(self) -> None:
        while True:
            event: bytes = await self._publisher.recv()
            async with self._changed:
                self._subscriptions[event[1:]] = event[0]
                self._changed.notify_all()

    async def GetVersion(  # noqa: N802
        self, request: control_pb2.GetVersionRequest, context: Call
    ) -> control_pb2.GetVersionResponse:
        return control_pb2.GetVersionResponse(
            version="0.0.0",
            server=self.server,
            backend="fake",
            zeromq_publish_endpoint=f"tcp://127.0.0.1:{self.endpoints.publish}" if self.publishes else "",
            zeromq_pose_endpoint=f"tcp://127.0.0.1:{self.endpoints.pose}",
        )

    async def GetMetrics(  # noqa: N802
        self, request: control_pb2.GetMetricsRequest, context: Call
    ) -> control_pb2.GetMetricsResponse:
        return control_pb2.GetMetricsResponse(text=self.metrics)

    async def ListScenes(  # noqa: N802
        self, request: control_pb2.ListScenesRequest, context: Call
    ) -> control_pb2.ListScenesResponse:
        return control_pb2.ListScenesResponse(
            scenes=[
                stream_pb2.SceneStatus(scene=name, state=stream_pb2.SceneStatus.STATE_RUNNING)
                for name in self.topologies
            ]
        )

    async def GetTopology(  # noqa: N802
        self, request: control_pb2.GetTopologyRequest, context: Call
    ) -> control_pb2.GetTopologyResponse:
        if request.scene not in self.topologies:
            await context.abort(grpc.StatusCode.NOT_FOUND, f"no scene {request.scene!r}")
        return control_pb2.GetTopologyResponse(topology=self.topologies[request.scene])

    async def GetFrame(  # noqa: N802
        self, request: control_pb2.GetFrameRequest, context: Call
    ) -> control_pb2.GetFrameResponse:
        if request.scene not in self.frames:
            await context.abort(grpc.StatusCode.NOT_FOUND, f"no frame of {request.scene!r}")
        return control_pb2.GetFrameResponse(frame=self.frames[request.scene], changes=self.changes.get(request.scene))

    async def GetFields(  # noqa: N802
        self, request: control_pb2.GetFieldsRequest, context: Call
    ) -> control_pb2.GetFieldsResponse:
        self.asked_fields.append(request)
        return self.fields

    async def _command(self, request: Message, context: Call) -> None:
        self.commands.append(request)
        await self.released.wait()
        if self.refusal:
            await context.abort(grpc.StatusCode.FAILED_PRECONDITION, self.refusal)

    async def PauseScene(  # noqa: N802
        self, request: control_pb2.PauseSceneRequest, context: Call
    ) -> control_pb2.PauseSceneResponse:
        await self._command(request, context)
        return control_pb2.PauseSceneResponse()

    async def MoveTool(  # noqa: N802
        self, request: control_pb2.MoveToolRequest, context: Call
    ) -> control_pb2.MoveToolResponse:
        await self._command(request, context)
        return control_pb2.MoveToolResponse()

    async def ResumeScene(  # noqa: N802
        self, request: control_pb2.ResumeSceneRequest, context: Call
    ) -> control_pb2.ResumeSceneResponse:
        await self._command(request, context)
        return control_pb2.ResumeSceneResponse()

    async def StepScene(  # noqa: N802
        self, request: control_pb2.StepSceneRequest, context: Call
    ) -> control_pb2.StepSceneResponse:
        await self._command(request, context)
        return control_pb2.StepSceneResponse()

    async def ResetScene(  # noqa: N802
        self, request: control_pb2.ResetSceneRequest, context: Call
    ) -> control_pb2.ResetSceneResponse:
        await self._command(request, context)
        return control_pb2.ResetSceneResponse()

    async def AdjustScene(  # noqa: N802
        self, request: control_pb2.AdjustSceneRequest, context: Call
    ) -> control_pb2.AdjustSceneResponse:
        await self._command(request, context)
        return control_pb2.AdjustSceneResponse(adjustments=request.changes)

    async def EditScene(  # noqa: N802
        self, request: control_pb2.EditSceneRequest, context: Call
    ) -> control_pb2.EditSceneResponse:
        await self._command(request, context)
        reply = control_pb2.EditSceneResponse()
        for tool in request.edit.add_tools:
            reply.findings.add(tool=tool.name, message="it is inside tissue")
        return reply

    async def LoadScene(  # noqa: N802
        self, request: control_pb2.LoadSceneRequest, context: Call
    ) -> control_pb2.LoadSceneResponse:
        await self._command(request, context)
        self.topologies[request.scene.name] = triangle_topology(request.scene.name)
        response = control_pb2.LoadSceneResponse()
        response.report.findings.add(code="FINDING_CODE_LOCKING", value=0.495, body="beam", message="it locks")
        return response

    async def UnloadScene(  # noqa: N802
        self, request: control_pb2.UnloadSceneRequest, context: Call
    ) -> control_pb2.UnloadSceneResponse:
        await self._command(request, context)
        del self.topologies[request.scene]
        return control_pb2.UnloadSceneResponse()


def _bind(socket: zmq.asyncio.Socket, port: int) -> int:
    socket.setsockopt(zmq.LINGER, 0)
    socket.bind(f"tcp://127.0.0.1:{port or '*'}")
    return int(socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])


@contextlib.asynccontextmanager
async def fake_daemon(endpoints: Endpoints | None = None, server: str = "fake") -> AsyncIterator[FakeDaemon]:
    daemon = FakeDaemon(endpoints or Endpoints(), server)
    await daemon.start()
    try:
        yield daemon
    finally:
        await daemon.stop()
