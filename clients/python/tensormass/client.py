"""Control of a daemon: `connect` and `launch` give a `Server`, its `load` gives a `SceneHandle`."""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import numpy.typing as npt

from tensormass import errors, scene_report
from tensormass.fields import FieldName, Fields, field_numbers
from tensormass.processes import ChildProcess, find_program
from tensormass.scene import Scene, Vector
from tensormass.streams import (
    Closing,
    DataPlane,
    Feedback,
    Frame,
    PoseSender,
    PoseSequence,
    Subscription,
    Transport,
    find_body,
    find_tool,
    frame_size_bytes,
    reached_endpoints,
)
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

DEFAULT_ADDRESS = "127.0.0.1:50051"
# The daemon's own limit (server/core/limits.h).
_MAX_MESSAGE_BYTES = 512 << 20
_CALL_TIMEOUT_S = 30.0
_LOAD_TIMEOUT_S = 300.0

SceneSource = str | Path | Scene | scene_pb2.Scene


def connect(address: str = DEFAULT_ADDRESS, *, timeout_s: float = 5.0) -> Server:
    """Joins the daemon whose control plane listens on `address` (host:port).

    Raises:
        UnavailableError: nobody answers there within `timeout_s`.
    """
    return Server(address, timeout_s=timeout_s)


def launch(
    *,
    backend: str = "auto",
    cpu_threads: int | None = None,
    gpu_scenes: int | None = None,
    control: str = "127.0.0.1:0",
    zenoh: bool = True,
    options: Sequence[str] = (),
    timeout_s: float = 20.0,
) -> Server:
    """Starts a daemon of your own on free loopback ports; it ends with the `Server`, or with this process.

    Args:
        backend: "auto", "cpu" or "cuda".
        cpu_threads: threads of each scene that does not say; None leaves it to the daemon.
        gpu_scenes: scenes that are to keep their rates on one GPU at the same time; None: each is to be as fast as it
            can be alone.
        control: host:port to be controlled on; port 0: a free one. A named one lets clients find a daemon again.
        zenoh: whether the streams are offered over zenoh too.
        options: further flags of `tensormassd`.

    Raises:
        NotFoundError: `tensormassd` is not built (looked up in $TENSORMASSD, the checkout's build/bin, PATH).
        UnavailableError: it ended or was not ready in time; the message holds the end of its log.
    """
    program = find_program("tensormassd", "TENSORMASSD")
    with contextlib.ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="tensormass-")))
        ready_file, log_file = folder / "ready.json", folder / "tensormassd.log"
        args: list[str | Path] = [program, "--backend", backend, "--control", control]
        args += ["--zeromq-publish", "tcp://127.0.0.1:*", "--zeromq-pose", "tcp://127.0.0.1:*"]
        args += ["--zenoh-listen", "tcp/127.0.0.1:0" if zenoh else "off", "--ready-file", ready_file]
        if cpu_threads is not None:
            args += ["--cpu-threads", str(cpu_threads)]
        if gpu_scenes is not None:
            args += ["--gpu-scenes", str(gpu_scenes)]
        with log_file.open("wb") as log:
            process = ChildProcess([*args, *options], output=log)
        undo.callback(process.stop)
        address = _wait_until_ready(process, ready_file, log_file, timeout_s)
        server = Server(address, timeout_s=timeout_s, process=process, log_file=log_file)
        server._cleanup.push(undo.pop_all())
        return server


def _wait_until_ready(process: ChildProcess, ready_file: Path, log_file: Path, timeout_s: float) -> str:
    deadline = time.monotonic() + timeout_s
    while True:
        with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):  # not there, or half written
            return str(json.loads(ready_file.read_text())["control"])
        ended = not process.running
        if ended or time.monotonic() > deadline:
            tail = "\n".join(log_file.read_text(errors="replace").splitlines()[-15:])
            what = f"ended with status {process.process.poll()}" if ended else f"was not ready in {timeout_s:g} s"
            raise errors.UnavailableError(f"tensormassd {what}; its log ends:\n{tail}")
        time.sleep(0.005)


class Server(Closing):
    """A daemon. Close it, or use it as a context manager; a daemon that `launch` started ends then."""

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        process: ChildProcess | None = None,
        log_file: Path | None = None,
    ) -> None:
        self.address = address
        #: The daemon's process, if `launch` started it.
        self.process = process
        #: Its log, if `launch` started it.
        self.log_file = log_file
        self._cleanup = contextlib.ExitStack()
        self._closed = False
        self._channel = grpc.insecure_channel(
            address,
            options=[
                ("grpc.max_send_message_length", _MAX_MESSAGE_BYTES),
                ("grpc.max_receive_message_length", _MAX_MESSAGE_BYTES),
                ("grpc.enable_http_proxy", 0),  # the data plane would not go through it either
            ],
        )
        self._stub = control_pb2_grpc.ControlStub(self._channel)
        try:
            grpc.channel_ready_future(self._channel).result(timeout_s)
            self._data_plane = DataPlane(self.version())
        except grpc.FutureTimeoutError:
            self._channel.close()
            raise errors.UnavailableError(
                f"no daemon answers on {address}; start one with `tensormassd` or tm.launch()"
            ) from None
        except BaseException:
            self._channel.close()
            raise

    def __repr__(self) -> str:
        return f"Server({self.address!r})"

    def close(self) -> None:
        """Closes the connection and ends the daemon if `launch` started it. May be called again."""
        self._closed = True
        self._data_plane.close()
        self._channel.close()
        self._cleanup.close()

    @property
    def data_plane(self) -> DataPlane:
        """The streams, for clients that want more than `SceneHandle` offers."""
        return self._data_plane

    def version(self) -> control_pb2.GetVersionResponse:
        """Version, backend, device, data endpoints as they are reached from here, and counters of malformed input."""
        return reached_endpoints(self._call("GetVersion", control_pb2.GetVersionRequest()), self.address)

    def load(
        self,
        scene: SceneSource,
        *,
        lockstep: bool | None = None,
        name: str | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> SceneHandle:
        """Loads a scene and starts it.

        Args:
            scene: a `Scene`, the protobuf message, the name of a scene or mesh file, or of a built-in scene
                (`builtin_scenes`).
            lockstep: True steps only on `SceneHandle.step`; None leaves it as the scene says.
            name: instead of the scene's own.
            progress: called with what the daemon does now, for people, and how much of the time has gone, 0 to 1. What
                it raises ends the load and comes out here.

        Raises:
            InvalidArgumentError: the scene is refused; the message names the body, the element and the remedy.
            AlreadyExistsError: a scene of this name is loaded.
        """
        request = control_pb2.LoadSceneRequest(scene=_message_of(scene, lockstep, name))
        if progress is None:
            report = self._call("LoadScene", request, timeout_s=_LOAD_TIMEOUT_S).report
        else:
            report = self._load_with_progress(request, progress)
        return SceneHandle(self, request.scene.name, report, request.scene)

    def _load_with_progress(
        self, request: control_pb2.LoadSceneRequest, progress: Callable[[str, float], None]
    ) -> control_pb2.SceneReport:
        messages = self._call("LoadSceneWithProgress", request, timeout_s=_LOAD_TIMEOUT_S)
        report = control_pb2.SceneReport()
        try:
            for message in messages:
                progress(message.part, message.fraction)
                report = message.report
        except grpc.RpcError as error:
            raise errors.from_rpc_error(error) from error
        finally:
            messages.cancel()  # nothing, if it has ended
        return report

    def inspect(self, scene: SceneSource) -> control_pb2.SceneReport:
        """Checks and compiles a scene without running it. Raises as `load`."""
        request = control_pb2.InspectSceneRequest(scene=_message_of(scene, None, None))
        return self._call("InspectScene", request, timeout_s=_LOAD_TIMEOUT_S).report

    def scene(self, name: str) -> SceneHandle:
        """A handle on a scene that is loaded already.

        Raises:
            NotFoundError: it is not.
        """
        handle = SceneHandle(self, name, None)
        handle.status()
        return handle

    def scenes(self) -> list[stream_pb2.SceneStatus]:
        """The status of every loaded scene."""
        return list(self._call("ListScenes", control_pb2.ListScenesRequest()).scenes)

    def _call(self, method: str, request: Any, timeout_s: float | None = _CALL_TIMEOUT_S) -> Any:  # noqa: ANN401
        """One unary call; a failed one becomes an exception of `tensormass.errors`."""
        if self._closed:
            raise errors.UnavailableError(f"this connection to {self.address} is closed; connect again")
        try:
            return getattr(self._stub, method)(request, timeout=timeout_s)
        except grpc.RpcError as error:
            raise errors.from_rpc_error(error) from error


class SceneHandle:
    """A loaded scene. The scene outlives the handle; `unload` ends it."""

    def __init__(
        self,
        server: Server,
        name: str,
        report: control_pb2.SceneReport | None,
        message: scene_pb2.Scene | None = None,
    ) -> None:
        self.name = name
        #: What was admitted and what a step costs; None for a scene that another client loaded.
        self.report = report
        #: What was loaded, with its meshes; None for a scene that another client loaded.
        self.message = message
        self._server = server
        self._topology: stream_pb2.Topology | None = None
        self._poses: dict[str, PoseSequence] = {}

    def __repr__(self) -> str:
        return f"SceneHandle({self.name!r} on {self._server.address})"

    # --- time ---------------------------------------------------------------------------------------------------------

    def step(self, count: int = 1) -> stream_pb2.SceneStatus:
        """Makes `count` steps and returns when they are done.

        Raises:
            FailedPreconditionError: the scene is not in lockstep, or a guard stopped it.
        """
        request = control_pb2.StepSceneRequest(scene=self.name, count=count)
        return self._server._call("StepScene", request, timeout_s=None).status

    def pause(self) -> stream_pb2.SceneStatus:
        """Stands still between two steps."""
        return self._server._call("PauseScene", control_pb2.PauseSceneRequest(scene=self.name)).status

    def resume(self) -> stream_pb2.SceneStatus:
        """Goes on after `pause`."""
        return self._server._call("ResumeScene", control_pb2.ResumeSceneRequest(scene=self.name)).status

    def reset(self) -> stream_pb2.SceneStatus:
        """Back to the start: positions, velocities, time and tools; clears a fault."""
        return self._server._call("ResetScene", control_pb2.ResetSceneRequest(scene=self.name)).status

    def unload(self) -> None:
        """Ends the scene."""
        self._server._call("UnloadScene", control_pb2.UnloadSceneRequest(scene=self.name))

    # --- state --------------------------------------------------------------------------------------------------------

    def status(self) -> stream_pb2.SceneStatus:
        """Rates, deadlines, solver and counters; see `SceneStatus` in stream.proto."""
        return self._server._call("GetStatus", control_pb2.GetStatusRequest(scene=self.name)).status

    def positions(self, body: str) -> npt.NDArray[np.float64]:
        """All nodes of a body in the order of its mesh, float64 [node_count, 3] m."""
        request = control_pb2.GetPositionsRequest(scene=self.name, body=body)
        reply = self._server._call("GetPositions", request)
        return np.frombuffer(reply.positions, dtype="<f8").reshape(-1, 3).copy()

    def fields(self, body: str, names: Sequence[FieldName] = ()) -> Fields:
        """Fields of a body after the last step, measured for this call; its energies come along without a name.

        Raises:
            NotFoundError: no such body.
            InvalidArgumentError: an unknown name.
        """
        request = control_pb2.GetFieldsRequest(scene=self.name, body=body, fields=field_numbers(names))
        return Fields.from_message(self._server._call("GetFields", request, timeout_s=_LOAD_TIMEOUT_S))

    def write_report(self, path: str | Path) -> Path:
        """Writes status, state and what was loaded to an .npz file; see `tensormass.scene_report`."""
        return scene_report.write_report(self, path)

    def surface(self, body: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint32]]:
        """What a viewer sees of a body now: vertices float64 [vertex_count, 3] m, triangles uint32 [n, 3].

        Raises:
            NotFoundError: no such body.
        """
        frame = self.frame()
        triangles = np.frombuffer(find_body(frame.topology, body).triangles, dtype="<u4").reshape(-1, 3)
        return frame.vertices(body).astype(np.float64), triangles.copy()

    def topology(self) -> stream_pb2.Topology:
        """What does not change from frame to frame."""
        reply = self._server._call("GetTopology", control_pb2.GetTopologyRequest(scene=self.name))
        self._topology = reply.topology
        return reply.topology

    def frame(self) -> Frame:
        """The surfaces after the last step."""
        while True:
            reply = self._server._call("GetFrame", control_pb2.GetFrameRequest(scene=self.name))
            frame = self._decode(reply.frame)
            if frame is not None:
                return frame

    def frames(self, transport: Transport = "zeromq", *, timeout_s: float = 5.0) -> FrameStream:
        """Subscribes to the frames: `for frame in scene.frames(): ...`.

        The first item is the scene as it stands, also when it is paused; then come the newest frames, the ones between
        are skipped. Waits for each at most `timeout_s`.
        """
        subscription = self._server.data_plane.subscribe(self.name, "frame", stream_pb2.Frame, transport)
        return FrameStream(self, subscription, timeout_s)

    def statuses(self, transport: Transport = "zeromq") -> Subscription[stream_pb2.SceneStatus]:
        """Subscribes to the status."""
        return self._server.data_plane.subscribe(self.name, "status", stream_pb2.SceneStatus, transport)

    # --- tools --------------------------------------------------------------------------------------------------------

    def move_tool(self, name: str, position_m: Vector, orientation: Vector | None = None) -> None:
        """Where the tool shall be from the next step on: [3] m and w, x, y, z (None: the identity).

        The tool gets there at its maximum speed at most.

        Raises:
            NotFoundError: no such tool.
            InvalidArgumentError: not finite, or no numbers.
        """
        pose = self._poses.setdefault(name, PoseSequence()).next(position_m, orientation)
        self._server._call("MoveTool", control_pb2.MoveToolRequest(scene=self.name, tool=name, pose=pose))

    def feedback(self, name: str) -> Feedback:
        """Force, torque and local model of a tool after the last step."""
        request = control_pb2.GetFeedbackRequest(scene=self.name, tool=name)
        return Feedback.from_message(self._server._call("GetFeedback", request).feedback)

    def tool_stream(self, name: str, transport: Transport = "zeromq") -> PoseSender:
        """Opens a stream for a tool's poses, for clients that move faster than a call for each pose allows.

        Raises:
            NotFoundError: no such tool, which the stream itself would never tell.
        """
        find_tool(self.topology(), name)
        return self._server.data_plane.pose_sender(self.name, name, transport)

    def feedbacks(self, name: str, transport: Transport = "zeromq") -> Subscription[stream_pb2.ToolFeedback]:
        """Subscribes to a tool's feedback: the newest after each step.

        Raises:
            NotFoundError: no such tool, on whose stream nothing would ever come.
        """
        find_tool(self.topology(), name)
        stream = f"tool/{name}/feedback"
        return self._server.data_plane.subscribe(self.name, stream, stream_pb2.ToolFeedback, transport)

    def _decode(self, frame: stream_pb2.Frame) -> Frame | None:
        """None for a frame of a topology that has been replaced since."""
        topology = self._topology
        # The size differs where a scene was unloaded and another one loaded under its name.
        if (
            topology is None
            or topology.version != frame.topology_version
            or len(frame.positions) != frame_size_bytes(topology)
        ):
            topology = self.topology()
        return Frame.from_message(frame, topology) if topology.version <= frame.topology_version else None


class FrameStream(Closing, Iterator[Frame]):
    """Iterates over frames; see `SceneHandle.frames`."""

    def __init__(self, scene: SceneHandle, subscription: Subscription[stream_pb2.Frame], timeout_s: float) -> None:
        #: Frames that were skipped because newer ones came before they were taken.
        self.dropped_count = 0
        self._scene = scene
        self._subscription = subscription
        self._timeout_s = timeout_s
        # What the call at the start brought, and the newest that came, whether it was handed out or not.
        self._first: Frame | None = None
        self._last: Frame | None = None

    def __next__(self) -> Frame:
        if self._first is None or self._last is None:
            self._first = self._last = self._scene.frame()
            return self._first
        while True:
            frame = self._scene._decode(self._subscription.receive(self._timeout_s))
            if frame is None:
                continue
            if frame.topology.version == self._last.topology.version:
                self.dropped_count += max(0, frame.sequence - self._last.sequence - 1)
            self._last = frame
            # The first may come again. Of later frames none does, though a reset or a pause leaves one with a step that
            # was there before.
            if (
                frame.topology.version > self._first.topology.version
                or frame.server_time_ns > self._first.server_time_ns
            ):
                return frame

    def close(self) -> None:
        """Ends the subscription."""
        self._subscription.close()


def _message_of(source: SceneSource, lockstep: bool | None, name: str | None) -> scene_pb2.Scene:
    scene = Scene.from_file(source) if isinstance(source, str | Path) else source
    message = scene.message if isinstance(scene, Scene) else scene
    if lockstep is None and name is None:
        return message
    changed = scene_pb2.Scene()
    changed.CopyFrom(message)
    if lockstep is not None:
        changed.stepping.lockstep = lockstep
    if name is not None:
        changed.name = name
    return changed
