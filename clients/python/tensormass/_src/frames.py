"""Frames and feedback as the SDK hands them out, decoded from the protocol's messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import (
    InternalError,
    NotFoundError,
)
from tensormass._shared.surfaces import Surface
from tensormass._src import notebook
from tensormass._src.springs import Springs, broken_flags, spring_count
from tensormass.v1 import scene_pb2, stream_pb2


@dataclass(frozen=True)
class YieldingSpring:
    """What holds a scalpel along the direction in which it cuts. See `YieldingSpring` in stream.proto."""

    #: Unit vector [3] in which the edge cuts.
    direction: npt.NDArray[np.float64]
    #: Spring and tissue in series, an estimate [N/m].
    stiffness_n_per_m: float
    #: Force at which the tissue parts [N].
    limit_n: float


@dataclass(frozen=True)
class Feedback:
    """Force on a tool after a step. See `ToolFeedback` in stream.proto."""

    #: Name of the tool.
    tool: str
    #: Number of the step.
    step: int
    #: End of the step on the server's clock, nanoseconds since the Unix epoch.
    server_time_ns: int
    #: Sequence of the newest pose that the step used; 0 before the first.
    pose_sequence: int
    #: Time on the client's own clock, as sent with that pose.
    client_time_ns: int
    #: Client that sent the pose. A device renders only feedback with its own `PoseSender.client_id`.
    client_id: int
    #: Position of the tool in the simulation, [3] m.
    position_m: npt.NDArray[np.float64]
    #: Quaternion [4] w, x, y, z.
    orientation: npt.NDArray[np.float64]
    #: Force on the tool, [3] N.
    force_n: npt.NDArray[np.float64]
    #: Torque on the tool about its position, [3] N m.
    torque_n_m: npt.NDArray[np.float64]
    #: The part of force_n that is friction, [3] N.
    friction_n: npt.NDArray[np.float64]
    #: Local model [3, 3] N/m: force(p) = force_n - stiffness_n_per_m (p - anchor_m), for `valid_for_s` after arrival.
    stiffness_n_per_m: npt.NDArray[np.float64]
    #: How long the local model may be used after its arrival [s].
    valid_for_s: float
    #: Place of the hand for which force_n holds, [3] m: position_m, unless the tool has a mass or gives way.
    anchor_m: npt.NDArray[np.float64]
    #: The force along the direction of a scalpel that holds tissue; else None.
    yielding: YieldingSpring | None
    #: Joints of the tool [rad or m].
    joint_values: npt.NDArray[np.float64]
    #: Load of tissue on each joint [N m or N]; positive pushes to larger values.
    joint_loads: npt.NDArray[np.float64]
    #: The tool touched tissue in this step.
    touching: bool
    #: The tool touches nothing, because its newest pose was valid for a time that has passed.
    retired: bool
    #: The client of the newest pose claims the tool: poses of other clients are refused. `move_tool` takes it over.
    claimed: bool
    #: The tool stays behind the hand, because the load would exceed its largest or because it backs off.
    gives_way: bool
    #: The step could not be made as planned. A device fades to force_n, which may have jumped.
    recovering: bool

    def _repr_html_(self) -> str:
        size = notebook.quantity(float(np.linalg.norm(self.force_n)), "N")
        rows = [
            ["step", f"{self.step:,}"],
            ["position", notebook.vector(self.position_m, "m")],
            ["orientation w, x, y, z", notebook.vector(self.orientation)],
            ["force", f"{notebook.vector(self.force_n, 'N')}, {size}"],
            ["torque", notebook.vector(self.torque_n_m, "N m")],
        ]
        if self.joint_values.size:
            rows.append(["joints", notebook.vector(self.joint_values, "rad or m")])
        if self.retired:
            rows.append(["retired", "it touches nothing"])
        if self.gives_way:
            rows.append(["gives way", f"the hand is at {notebook.vector(self.anchor_m, 'm')}"])
        if self.recovering:
            rows.append(["recovering", "the step could not be made as planned"])
        return notebook.table(f"tool {self.tool}", rows)

    @staticmethod
    def from_message(message: stream_pb2.ToolFeedback) -> Feedback:
        """Decodes a message."""
        local = message.local_model
        stiffness = np.array(local.stiffness_n_per_m, dtype=np.float64)
        orientation = message.orientation
        return Feedback(
            tool=message.tool,
            step=message.step,
            server_time_ns=message.server_time_ns,
            pose_sequence=message.pose_sequence,
            client_time_ns=message.client_time_ns,
            client_id=message.client_id,
            position_m=_array(message.position_m),
            orientation=np.array([orientation.w, orientation.x, orientation.y, orientation.z]),
            force_n=_array(message.force_n),
            torque_n_m=_array(message.torque_n_m),
            friction_n=_array(message.friction_n),
            stiffness_n_per_m=stiffness.reshape(3, 3) if stiffness.size == 9 else np.zeros((3, 3)),
            valid_for_s=local.valid_for_s,
            anchor_m=_array(local.anchor_m if local.HasField("anchor_m") else message.position_m),
            yielding=_yielding(local.yielding) if local.HasField("yielding") else None,
            joint_values=np.array(message.joint_values, dtype=np.float64),
            joint_loads=np.array(message.joint_loads, dtype=np.float64),
            touching=message.touching,
            retired=message.retired,
            claimed=message.claimed,
            gives_way=message.gives_way,
            recovering=message.recovering,
        )


@dataclass(frozen=True)
class Frame:
    """Surfaces of all bodies at one moment. See `Frame` in stream.proto."""

    #: What does not change between frames: bodies, tools and triangles.
    topology: stream_pb2.Topology
    #: Number of the frame; a gap is a dropped frame.
    sequence: int
    #: Number of the step after which the frame was made.
    step: int
    #: Simulated time at the end of that step [s].
    simulated_time_s: float
    #: End of that step on the server's clock, nanoseconds since the Unix epoch.
    server_time_ns: int
    #: Vertices of all bodies, one after the other, then those that changes appended, float32 [vertex_count, 3] m
    #: (read-only). `vertices` and `triangles` sort them by body.
    positions: npt.NDArray[np.float32]
    #: Feedback of each tool, by name.
    tools: dict[str, Feedback]
    #: Nodes at the ends of springs, float32 [point_count, 3] m (read-only). `springs` sorts them by attachment.
    attachment_points: npt.NDArray[np.float32]
    #: Whether each spring is broken, one attachment after the other, bool [spring_count].
    broken_springs: npt.NDArray[np.bool_]
    #: Revision of the surface: 0 as in the topology, and one more with each change.
    revision: int
    #: The topology with the newest changes that are known. They may be newer or older than the frame.
    surface: Surface

    def _repr_html_(self) -> str:
        rows = [["step", f"{self.step:,} at {notebook.quantity(self.simulated_time_s, 's')}"]]
        rows += [
            [
                f"body {body.name}",
                f"{len(self.vertices(body.name)):,} vertices, {len(self.triangles(body.name)):,} triangles",
            ]
            for body in self.topology.bodies
        ]
        first = 0
        for attachment in self.topology.attachments:
            count = spring_count(attachment)
            broken = np.count_nonzero(self.broken_springs[first : first + count])
            rows.append([f"attachment {attachment.name}", f"{count:,} springs, {broken:,} broken"])
            first += count
        rows += [[f"force on {name}", notebook.vector(tool.force_n, "N")] for name, tool in self.tools.items()]
        return notebook.table(f"frame {self.sequence} of {self.topology.scene}", rows)

    def vertices(self, body: str) -> npt.NDArray[np.float32]:
        """Returns the vertices of a body, those that changes appended last, [vertex_count, 3] m."""
        return self.surface.vertices(self._place(body), self.positions)

    def triangles(self, body: str) -> npt.NDArray[np.uint32]:
        """Returns the visible triangles of a body, [triangle_count, 3] places in `vertices`.

        Those that were burnt or cut away are left out, and the faces behind them are there.
        """
        return self.surface.triangles(self._place(body), len(self.positions))[0]

    def faces(self, body: str) -> npt.NDArray[np.uint8]:
        """Returns what each of the `triangles` shows, [triangle_count]: 0 outer surface, 1 cut face, 2 burnt face."""
        return self.surface.triangles(self._place(body), len(self.positions))[1]

    def coagulation(self, body: str) -> npt.NDArray[np.float64]:
        """Returns how far the tissue at each of the `vertices` is coagulated, [vertex_count], 0 (raw) to 1.

        Cautery coagulates tissue before it burns it away. It steps by thirds.
        """
        return self.surface.parts[self._place(body)].coagulation / 255

    def _place(self, body: str) -> int:
        names = [surface.name for surface in self.topology.bodies]
        return names.index(find_body(self.topology, body).name)

    def springs(self, attachment: str) -> Springs:
        """Returns the springs of an attachment: their ends, tensions, and which are broken.

        Raises:
            NotFoundError: the scene has no attachment of this name. The message lists its attachments.
        """
        message = _find(self.topology, self.topology.attachments, "attachment", attachment)
        first = 0
        for before in self.topology.attachments:
            if before.name == message.name:
                break
            first += spring_count(before)
        broken = self.broken_springs[first : first + spring_count(message)]
        return Springs.from_message(message, self.attachment_points, broken)

    @staticmethod
    def from_message(message: stream_pb2.Frame, topology: stream_pb2.Topology, surface: Surface | None = None) -> Frame:
        """Decodes a message.

        Args:
            surface: the topology with its changes; None: it has none.

        Raises:
            InternalError: its positions or springs do not fit the topology.
        """
        surface = surface if surface is not None else Surface(topology)
        if not fits(message, surface):
            needs = 12 * surface.base_count
            more = " or more" if message.revision else ""
            raise InternalError(
                f"frame {message.sequence} of {topology.scene!r} has {len(message.positions)} bytes of positions; "
                f"its topology needs {needs}{more}"
            )
        if len(message.attachment_points) != 12 * topology.attachment_point_count:
            raise InternalError(
                f"frame {message.sequence} of {topology.scene!r} has {len(message.attachment_points)} bytes of "
                f"attachment points; its topology needs {12 * topology.attachment_point_count}"
            )
        springs = sum(spring_count(attachment) for attachment in topology.attachments)
        return Frame(
            topology=topology,
            sequence=message.sequence,
            step=message.step,
            simulated_time_s=message.simulated_time_s,
            server_time_ns=message.server_time_ns,
            positions=np.frombuffer(message.positions, dtype="<f4").reshape(-1, 3),
            tools={tool.tool: Feedback.from_message(tool) for tool in message.tools},
            attachment_points=np.frombuffer(message.attachment_points, dtype="<f4").reshape(-1, 3),
            broken_springs=broken_flags(message.broken_springs, springs),
            revision=message.revision,
            surface=surface,
        )


def fits(frame: stream_pb2.Frame, surface: Surface) -> bool:
    """Tells whether a frame has as many positions as its revision has. Of an unknown revision: whether it may."""
    size, base = len(frame.positions), 12 * surface.base_count
    if frame.revision == surface.revision:
        return size == 12 * surface.vertex_count
    return size % 12 == 0 and (size >= base if frame.revision else size == base)


def find_body(topology: stream_pb2.Topology, body: str) -> stream_pb2.BodySurface:
    """Finds the surface of a body. NotFoundError lists the bodies there are."""
    return _find(topology, topology.bodies, "body", body)


def find_tool(topology: stream_pb2.Topology, tool: str) -> stream_pb2.ToolShape:
    """Finds the shape of a tool. NotFoundError lists the tools there are."""
    return _find(topology, topology.tools, "tool", tool)


NamedType = TypeVar("NamedType", stream_pb2.BodySurface, stream_pb2.ToolShape, stream_pb2.AttachmentSprings)


def _find(topology: stream_pb2.Topology, there: Sequence[NamedType], kind: str, name: str) -> NamedType:
    for each in there:
        if each.name == name:
            return each
    known = ", ".join(each.name for each in there) or "none"
    raise NotFoundError(f"scene {topology.scene!r} has no {kind} {name!r}; it has: {known}")


def _yielding(spring: stream_pb2.YieldingSpring) -> YieldingSpring:
    return YieldingSpring(_array(spring.direction), spring.stiffness_n_per_m, spring.limit_n)


def _array(vector: scene_pb2.Vector3) -> npt.NDArray[np.float64]:
    return np.array([vector.x, vector.y, vector.z])
