"""A loaded scene: its time, state, frames and tools."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from tensormass._shared import defaults
from tensormass._shared.errors import (
    FailedPreconditionError,
    InternalError,
    InvalidArgumentError,
    NotFoundError,
    TensormassError,
)
from tensormass._shared.findings import key_of, of_results
from tensormass._shared.surfaces import Surface
from tensormass._shared.vectors import Vector, vector3
from tensormass._src import findings, following, notebook
from tensormass._src.connection import LOAD_TIMEOUT_S, Connection
from tensormass._src.durations import DurationHistogram
from tensormass._src.events import EventStream
from tensormass._src.fields import FieldName, Fields, field_numbers
from tensormass._src.frame_stream import FrameStream
from tensormass._src.frames import Feedback, Frame, find_tool, fits
from tensormass._src.links import Nodes, RestLength, new_attachment
from tensormass._src.poses import PoseSender, PoseSequence
from tensormass._src.scene_edits import attachments_of, cut_of, edit_of, tools_of
from tensormass._src.scene_report import REPORT_FIELDS, report_path, write_report
from tensormass._src.step_record import StepRecord
from tensormass._src.streams import Transport
from tensormass._src.subscriptions import Subscription
from tensormass._src.tools import tool_of
from tensormass.v1 import adjustment_pb2, changes_pb2, control_pb2, event_pb2, finding_pb2, scene_pb2, stream_pb2


class SceneHandle:
    """A loaded scene.

        with server.load("demo", lockstep=True) as scene:
            scene.step(60)

    The scene outlives the handle: `unload` ends it, and so does the end of a `with` block.
    """

    def __init__(
        self,
        connection: Connection,
        name: str,
        report: control_pb2.SceneReport | None,
        message: scene_pb2.Scene | None = None,
    ) -> None:
        #: Name of the scene in the daemon.
        self.name = name
        #: Bodies as admitted, and the cost of a step; None for a scene that another client loaded.
        self.report = report
        #: The loaded scene, with its meshes; None for a scene that another client loaded.
        self.message = message
        self._connection = connection
        self._topology: stream_pb2.Topology | None = None
        #: The newest changes of the surface, of this topology or a newer one.
        self._changes = changes_pb2.SurfaceChanges()
        self._surface: Surface | None = None
        self._poses: dict[str, PoseSequence] = {}
        self._followed: following.Followed | None = None
        self._warned: set[tuple[int, str, str, str]] = set()

    def __repr__(self) -> str:
        return f"SceneHandle({self.name!r} on {self._connection.address})"

    def _repr_html_(self) -> str:
        plan = notebook.report_html(self.report) if self.report is not None else ""
        try:
            return plan + notebook.status_html(self.status())
        except TensormassError as error:
            return plan + notebook.table(repr(self), [["no status", str(error)]])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Unloads the scene. A scene that is gone is not an error, and no failure replaces an error of the block."""
        with contextlib.suppress(NotFoundError if error is None else TensormassError):
            self.unload()

    # --- time ---------------------------------------------------------------------------------------------------------

    def step(self, count: int = 1) -> stream_pb2.SceneStatus:
        """Makes `count` steps and returns after the last one.

        Warns:
            FindingWarning: something is wrong with the results, such as linear solves that end above their tolerance.
                Each once; the status has the findings while they last.

        Raises:
            InvalidArgumentError: `count` is not above 0.
            FailedPreconditionError: the scene is not in lockstep, or a guard stopped it.
        """
        if count < 1:
            raise InvalidArgumentError(f"count: expected 1 or more steps, got {count}")
        request = control_pb2.StepSceneRequest(scene=self.name, count=count)
        status = self._connection.call("StepScene", request, timeout_s=None).status
        new = [one for one in of_results(status) if key_of(one) not in self._warned]
        self._warned.update(key_of(one) for one in new)
        findings.warn_of(new)
        return status

    def follow(self, tool: str, poses: Sequence[following.Pose]) -> stream_pb2.SceneStatus:
        """Makes a step for each pose of a tool, many of them in one call, and returns after the last one.

            scene.follow("probe", [((0, 0, z), None, ()) for z in np.linspace(0.08, 0.05, 60)])

        The steps are those of `move_tool` and `step` in turns, to the last bit (where tangents lag, the first evaluates
        all elements). They cost less: only the last one brings a frame, and elements are checked as by the clock.

        Args:
            poses: position [3] m at the end of each step, orientation w, x, y, z (None is the identity), and a value
                for each joint of the tool [rad or m]; perhaps its level as a fourth.

        Raises:
            NotFoundError: no such tool.
            InvalidArgumentError: no poses, or values that `move_tool` refuses.
            FailedPreconditionError: the scene is not in lockstep, or a guard stopped it.
        """
        if not len(poses):
            raise InvalidArgumentError("poses: expected one or more")
        if following.has_blades(self.topology()):
            for pose in poses:
                self.move_tool(tool, *pose)
                status = self.step()
            return status
        dt_s = defaults.dt_s(self.message if self.message is not None else scene_pb2.Scene())
        if self._followed is None:
            self._followed = following.Followed.of(self.snapshot())
        status = self.status()
        try:
            for request in following.requests(self.name, tool, poses, self._followed, status.step, dt_s):
                status = self._connection.call("ReplayScene", request, timeout_s=None).status
        except FailedPreconditionError:
            self._followed = None  # another client may have adjusted the scene
            raise
        return status

    def steps(self, count: int) -> Iterator[StepRecord]:
        """Makes `count` steps, one call each, and yields what each of them did.

        A step is made when its record is asked for, so the loop may read fields or move tools in between.

            iterations = [record.cg_iterations for record in scene.steps(100)]

        Raises:
            InvalidArgumentError: `count` is negative.
            FailedPreconditionError: the scene is not in lockstep, or a guard stopped it. The error comes from the loop,
                after the records of the steps before.
        """
        if count < 0:
            raise InvalidArgumentError(f"count: expected 0 or more steps, got {count}")
        return self._records(count)

    def _records(self, count: int) -> Iterator[StepRecord]:
        solver = self.message.solver if self.message is not None else None
        for _ in range(count):
            before = self.status()
            yield StepRecord.between(before, self.step(), solver)

    def pause(self) -> stream_pb2.SceneStatus:
        """Pauses the scene between two steps."""
        return self._connection.call("PauseScene", control_pb2.PauseSceneRequest(scene=self.name)).status

    def resume(self) -> stream_pb2.SceneStatus:
        """Continues after `pause`."""
        return self._connection.call("ResumeScene", control_pb2.ResumeSceneRequest(scene=self.name)).status

    def reset(self) -> stream_pb2.SceneStatus:
        """Resets positions, velocities, time and tools to the start, and clears a fault."""
        return self._connection.call("ResetScene", control_pb2.ResetSceneRequest(scene=self.name)).status

    def unload(self) -> None:
        """Unloads the scene."""
        self._connection.call("UnloadScene", control_pb2.UnloadSceneRequest(scene=self.name))

    # --- state --------------------------------------------------------------------------------------------------------

    def status(self) -> stream_pb2.SceneStatus:
        """Returns rates, deadlines, solver figures and counters; see `SceneStatus` in stream.proto."""
        return self._connection.call("GetStatus", control_pb2.GetStatusRequest(scene=self.name)).status

    def step_times(self) -> DurationHistogram:
        """Returns the times of all steps since the load. The difference of two calls has those between them.

        Raises:
            FailedPreconditionError: the daemon is older than this SDK, and does not count them.
        """
        status = self.status()
        times = DurationHistogram.from_message(status.step_times)
        if status.step > 0 and times.count == 0:
            raise FailedPreconditionError("the daemon does not count step times; start one of this version")
        return times

    def positions(self, body: str) -> npt.NDArray[np.float64]:
        """Returns the nodes of a body in the order of its mesh, float64 [node_count, 3] m."""
        request = control_pb2.GetPositionsRequest(scene=self.name, body=body)
        reply = self._connection.call("GetPositions", request)
        return np.frombuffer(reply.positions, dtype="<f8").reshape(-1, 3).copy()

    def fields(self, body: str, names: Sequence[FieldName] = ()) -> Fields:
        """Computes fields of a body after the last step. Its energies are always included.

        Raises:
            NotFoundError: no such body.
            InvalidArgumentError: an unknown name.
        """
        request = control_pb2.GetFieldsRequest(scene=self.name, body=body, fields=field_numbers(names))
        return Fields.from_message(self._connection.call("GetFields", request, timeout_s=LOAD_TIMEOUT_S))

    def write_report(self, path: str | Path) -> Path:
        """Writes status, state and the loaded scene to an .npz file; docs/protocol.md names its arrays.

        Raises:
            InvalidArgumentError: the path does not end in .npz, or cannot be written.
            FailedPreconditionError: the device failed, so its state cannot be trusted.
        """
        file = report_path(path)
        bodies = {body.name: self.fields(body.name, REPORT_FIELDS) for body in self.topology().bodies}
        return write_report(file, self.status(), bodies, self.message)

    def surface(self, body: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.uint32]]:
        """Returns the visible surface of a body: vertices float64 [vertex_count, 3] m, triangles uint32 [n, 3].

        Raises:
            NotFoundError: no such body.
        """
        frame = self.frame()
        return frame.vertices(body).astype(np.float64), frame.triangles(body).copy()

    def topology(self) -> stream_pb2.Topology:
        """Returns what does not change between frames: bodies, tools and triangles."""
        return self._fetch_topology(waits=False)

    def _fetch_topology(self, *, waits: bool) -> stream_pb2.Topology:
        reply = self._connection.call("GetTopology", control_pb2.GetTopologyRequest(scene=self.name), waits=waits)
        self._topology = reply.topology
        return reply.topology

    def frame(self) -> Frame:
        """Returns the surfaces after the last step."""
        while True:
            reply = self._connection.call("GetFrame", control_pb2.GetFrameRequest(scene=self.name))
            if reply.HasField("changes"):
                self._take_changes(reply.changes)
            frame = self._decode(reply.frame)
            if frame is not None:
                return frame

    def frames(self, transport: Transport = "zeromq", *, timeout_s: float = 5.0) -> FrameStream:
        """Subscribes to the frames: `for frame in scene.frames(): ...`.

        The first item is the present state, even of a paused scene. Each later item is the newest frame, and frames in
        between are skipped. Waits at most `timeout_s` for each. If the surface changes while the scene steps,
        `Frame.vertices` and `Frame.triangles` follow.
        """
        plane = self._connection.data_plane
        subscription = plane.subscribe(self.name, "frame", stream_pb2.Frame, transport)
        follow = partial(plane.subscribe, self.name, "changes", changes_pb2.SurfaceChanges, transport)
        return FrameStream(self, subscription, timeout_s, follow)

    def events(self, transport: Transport = "zeromq", *, timeout_s: float | None = None) -> EventStream:
        """Subscribes to what happens in the scene: `for event in scene.events(): ...`.

        Each event comes once, in order. The first ones may be the last 64 of the past. Waits at most `timeout_s` for
        each; None: until one comes.
        """
        subscription = self._connection.data_plane.subscribe(self.name, "events", event_pb2.SceneEvents, transport)
        return EventStream(subscription, timeout_s)

    def statuses(self, transport: Transport = "zeromq") -> Subscription[stream_pb2.SceneStatus]:
        """Subscribes to the status of the scene."""
        return self._connection.data_plane.subscribe(self.name, "status", stream_pb2.SceneStatus, transport)

    def snapshot(self) -> bytes:
        """Returns the whole state between two steps: what `restore` takes, and what a file may keep as it is.

        Raises:
            FailedPreconditionError: the device failed, so its state cannot be trusted.
        """
        request = control_pb2.SnapshotSceneRequest(scene=self.name)
        return bytes(self._connection.call("SnapshotScene", request, timeout_s=LOAD_TIMEOUT_S).snapshot)

    def restore(self, snapshot: bytes | str | Path) -> stream_pb2.SceneStatus:
        """Goes on from a snapshot: state, time and tools. Clears a fault.

        Args:
            snapshot: what `snapshot` returned, or the path of a file with it.

        Raises:
            NotFoundError: no such file.
            InvalidArgumentError: it is not a snapshot, damaged, or of another version.
            FailedPreconditionError: it is of another scene, backend or number of threads, or of other values.
        """
        content = snapshot if isinstance(snapshot, bytes) else _read(Path(snapshot))
        request = control_pb2.RestoreSceneRequest(scene=self.name, snapshot=content)
        return self._connection.call("RestoreScene", request, timeout_s=LOAD_TIMEOUT_S).status

    def edit(
        self,
        *,
        ablate: Mapping[str, Iterable[int]] | None = None,
        kept: float = 0.0,
        sever: Mapping[str, Iterable[int] | None] | None = None,
    ) -> stream_pb2.SceneStatus:
        """Takes material out of elements, and breaks springs of attachments, before the next step.

            scene.edit(ablate={"liver": [17, 18]})

        All of it is done, or nothing. A reset heals everything.

        Args:
            ablate: for each body by name, its elements, numbered from 0. The scene must have `editing`.
            kept: share of their material that is left, 0 to 1, less than now.
            sever: for each attachment by name, its springs, numbered from 0; None: all that are whole.

        Returns:
            The status, with the mass and the volume that edits have removed.

        Raises:
            NotFoundError: no such body, element, attachment or spring.
            InvalidArgumentError: a share outside 0 to 1, or something named twice.
            FailedPreconditionError: an element or a spring that is gone already, the last element of a body, or a scene
                without `editing`.
            ResourceExhaustedError: no room for the surface that would come to light.
        """
        request = control_pb2.EditSceneRequest(scene=self.name, edit=edit_of(ablate or {}, kept, sever or {}))
        return self._connection.call("EditScene", request).status

    def cut(self, body: str, blade: npt.ArrayLike) -> stream_pb2.SceneStatus:
        """Cuts a body along the way of a blade, and goes on from the present state.

            scene.cut("liver", [[[0, 0.1, 0], [0, 0.1, 0.05]],   # a blade of two points above the liver,
                                [[0, 0.0, 0], [0, 0.0, 0.05]]])  # and after it went down

        Takes as long as a load, but the scene stops for the time of a few steps only. A reset heals everything. What is
        not possible yet: docs/decisions/cutting.md.

        Args:
            body: its name. The scene must have `editing.cutting`.
            blade: [position, point, 3] m, two or more of each: a line that cuts, at its positions one after the other,
                where the body's mesh is at rest.

        Returns:
            The status.

        Raises:
            NotFoundError: no such body.
            InvalidArgumentError: a blade that crosses no edge of the body's mesh, or a body that cannot be cut.
            FailedPreconditionError: a scene without `editing.cutting`.
            ResourceExhaustedError: no room for the surface that would come to light.
        """
        request = control_pb2.EditSceneRequest(scene=self.name, edit=cut_of(body, blade))
        return self._connection.call("EditScene", request, timeout_s=LOAD_TIMEOUT_S).status

    def attach(
        self,
        name: str,
        body: str,
        nodes: Nodes,
        other: str,
        other_nodes: Nodes,
        *,
        stiffness_n_per_m: float,
        breaking_force_n: float | None = None,
        rest_length_m: RestLength = None,
    ) -> stream_pb2.SceneStatus:
        """Holds nodes of a body to another body or to itself while the scene goes on, as a clip does, until a reset.

            scene.attach("clip", "liver", left, "liver", right, stiffness_n_per_m=500)

        Args:
            rest_length_m: length at rest of all springs, or of each; None: their present distance, so that they start
                without a force. The other arguments are those of `Scene.attach`.

        Raises:
            AlreadyExistsError, InvalidArgumentError: the scene has one of this name, or could not be loaded with it.
            FailedPreconditionError, ResourceExhaustedError: no `editing`, no material at a node, or too many springs.
        """
        ends, springs = ((body, nodes), (other, other_nodes)), (stiffness_n_per_m, breaking_force_n, rest_length_m)
        return self._change(attachments_of([new_attachment(name, ends, *springs)], [])).status

    def detach(self, *names: str) -> stream_pb2.SceneStatus:
        """Removes attachments that `attach` added, whole or broken. Their names are free then.

        Raises:
            NotFoundError, FailedPreconditionError: one was not added, or was loaded with the scene. Then none goes.
        """
        return self._change(attachments_of([], names)).status

    def adjust(
        self,
        *,
        gravity_m_per_s2: Vector | None = None,
        stiffness_factor: Mapping[str, float] | None = None,
        rayleigh_mass_per_s: Mapping[str, float] | None = None,
        rayleigh_stiffness_s: Mapping[str, float] | None = None,
    ) -> control_pb2.SceneAdjustments:
        """Changes gravity, stiffness or damping, and goes on from the present state.

            scene.adjust(stiffness_factor={"liver": 2.0})

        The scene goes on. Only if gravity is new to it, has a schedule, or changes in a quasi-static scene is it
        compiled again, which takes as long as a load. While a tool touches, a large change of stiffness comes in parts,
        a quarter every 10 ms of simulated time or every step. A reset keeps the changes.

        Args:
            gravity_m_per_s2: [3] m/s².
            stiffness_factor: for each body by name, the factor of every modulus as it was loaded, 0.001 to 1000.
            rayleigh_mass_per_s: for each body, α of its Rayleigh damping [1/s].
            rayleigh_stiffness_s: for each body, β of its Rayleigh damping [s].

        Returns:
            All values after the last part. Without arguments it changes nothing.

        Raises:
            NotFoundError: no such body.
            InvalidArgumentError: a value outside its range.
            ResourceExhaustedError: no memory for the change; the scene is unchanged.
        """
        changes = control_pb2.SceneAdjustments()
        if gravity_m_per_s2 is not None:
            changes.gravity_m_per_s2.CopyFrom(vector3(gravity_m_per_s2, "gravity_m_per_s2"))
        given = {
            "stiffness_factor": stiffness_factor,
            "rayleigh_mass_per_s": rayleigh_mass_per_s,
            "rayleigh_stiffness_s": rayleigh_stiffness_s,
        }
        bodies: dict[str, dict[str, float]] = {}
        for field, values in given.items():
            if values is not None and not isinstance(values, Mapping):
                raise InvalidArgumentError(
                    f"{field}: expected a value for each body by name, as in {{'liver': 2.0}}, got {values!r}"
                )
            for body, value in (values or {}).items():
                bodies.setdefault(body, {})[field] = value
        for body, fields in bodies.items():
            changes.bodies.add(body=body, **fields)
        self._followed = None
        request = control_pb2.AdjustSceneRequest(scene=self.name, changes=changes)
        return self._connection.call("AdjustScene", request, timeout_s=LOAD_TIMEOUT_S).adjustments

    # --- tools --------------------------------------------------------------------------------------------------------

    def add_tool(self, name: str, kind: str, *, position_m: Vector, **fields: Any) -> list[finding_pb2.Finding]:  # noqa: ANN401
        """Adds a tool while the scene goes on. It fades into contact within 0.1 s, so that it does not strike tissue.

            scene.add_tool("hook", "capsule", position_m=(0, 0, 0.1), radius_m=0.002, length_m=0.1)

        Takes as long as a load, but the scene stops for the time of a few steps only. A reset keeps the tool.

        Args:
            position_m: where it is until its first pose, [3] m.
            fields: the other arguments of `Scene.add_tool`.

        Returns:
            Findings that concern it, as at a load.

        Raises:
            AlreadyExistsError: the scene has a tool of this name.
            InvalidArgumentError: the scene could not be loaded with it, too.
            ResourceExhaustedError: it is one tool too many.
        """
        tool = tool_of(name, kind, position_m, fields)
        return list(self._change(tools_of([tool], [])).findings)

    def remove_tool(self, *names: str) -> stream_pb2.SceneStatus:
        """Removes tools while the scene goes on. They let go of the tissue at once, and the names are free again.

        Poses for them are refused from then on. The other tools go on as they were.

        Raises:
            NotFoundError: no such tool; then none is removed.
        """
        return self._change(tools_of([], names)).status

    def _change(self, edit: adjustment_pb2.SceneEdit) -> control_pb2.EditSceneResponse:
        self._followed = None
        for name in edit.remove_tools:
            self._poses.pop(name, None)
        request = control_pb2.EditSceneRequest(scene=self.name, edit=edit)
        return self._connection.call("EditScene", request, timeout_s=LOAD_TIMEOUT_S)

    def move_tool(
        self,
        name: str,
        position_m: Vector,
        orientation: Vector | None = None,
        joint_values: Vector = (),
        level: float = 0.0,
    ) -> None:
        """Moves a tool from the next step on, no faster than its maximum speed.

        It takes the tool over from a client that claims it. That client is refused until it has paused for the time for
        which its poses hold.

        Args:
            position_m: [3] m.
            orientation: quaternion w, x, y, z; None is the identity.
            joint_values: one for each joint of the tool [rad or m]; empty: the joints stay as they are.
            level: share of its power that a tool with `cautery` uses until its next pose, 0 to 1.

        Raises:
            NotFoundError: no such tool.
            InvalidArgumentError: a value that is not a finite number, a joint beyond its range, or a level of a tool
                without power.
        """
        pose = self._poses.setdefault(name, PoseSequence()).next(position_m, orientation, joint_values, level)
        self._connection.call("MoveTool", control_pb2.MoveToolRequest(scene=self.name, tool=name, pose=pose))

    def feedback(self, name: str) -> Feedback:
        """Returns force, torque and local model of a tool after the last step."""
        request = control_pb2.GetFeedbackRequest(scene=self.name, tool=name)
        return Feedback.from_message(self._connection.call("GetFeedback", request).feedback)

    def tool_stream(
        self, name: str, transport: Transport = "zeromq", *, valid_for_s: float | None = None
    ) -> PoseSender:
        """Opens a stream of poses, for clients that move a tool more often than a call per pose allows.

        Args:
            valid_for_s: time for which a pose holds, 0.02 to 3600 s. If no other pose follows, the tool lets go of the
                tissue then. Until then the stream claims the tool: poses of other clients are refused, and if another
                client claims it already, those of this stream; `Feedback.claimed` and `client_id` tell. None: a pose
                holds until the next one, and claims nothing.

        Raises:
            NotFoundError: no such tool. The stream itself would not report it.
        """
        find_tool(self.topology(), name)
        return self._connection.data_plane.pose_sender(self.name, name, transport, valid_for_s)

    def feedbacks(self, name: str, transport: Transport = "zeromq") -> Subscription[stream_pb2.ToolFeedback]:
        """Subscribes to the feedback of a tool: the newest after each step.

        Raises:
            NotFoundError: no such tool. Its stream would stay silent.
        """
        find_tool(self.topology(), name)
        stream = f"tool/{name}/feedback"
        return self._connection.data_plane.subscribe(self.name, stream, stream_pb2.ToolFeedback, transport)

    def _decode(self, frame: stream_pb2.Frame) -> Frame | None:
        """Decodes a frame; None if its topology has been replaced since."""
        topology = self._topology
        # The size differs if a scene was unloaded and another one was loaded under its name.
        if (
            topology is None
            or topology.version != frame.topology_version
            or not fits(frame, self._surface_of(topology))
        ):
            # A daemon that was started again sends frames a moment before it answers calls.
            topology = self._fetch_topology(waits=True)
        if topology.version > frame.topology_version:
            return None
        return Frame.from_message(frame, topology, self._surface_of(topology))

    def _take_changes(self, changes: changes_pb2.SurfaceChanges) -> None:
        """Takes changes of the surface, unless newer ones are known."""
        known = self._changes
        if (changes.topology_version, changes.revision) > (known.topology_version, known.revision):
            self._changes = changes

    def _surface_of(self, topology: stream_pb2.Topology) -> Surface:
        """Returns a topology with the newest changes.

        Raises:
            InternalError: changes do not fit it. They are forgotten.
        """
        newest = self._changes if self._changes.topology_version == topology.version else None
        known = self._surface
        revision = newest.revision if newest is not None else 0
        if known is None or known.topology is not topology or known.revision != revision:
            try:
                known = self._surface = Surface(topology, newest)
            except ValueError as error:
                self._changes = known.changes if known is not None else changes_pb2.SurfaceChanges()
                raise InternalError(f"scene {self.name!r}: {error}") from error
        return known


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise NotFoundError(f"{path}: {error.strerror}") from error
