"""A scene in a PyVista plotter: bodies coloured by displacement, attachments, tools, and the forces on them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyvista as pv

from tensormass import Feedback, Frame
from tensormass.v1 import changes_pb2, stream_pb2
from tensormass_gateway.normals import Triangles
from tensormass_tools.desktop.shapes import pose_matrix, surface_mesh, tool_mesh

_COLORS = "viridis"
_STEEL = "#d5dce2"
_OBSTACLE = "#5d6a75"
_AMBER = "#ffb000"
# Faces that were made while the scene stepped.
_COAGULATED = 255  # beside the numbers of BodyChanges.Face
_FACE_COLORS = {
    changes_pb2.BodyChanges.FACE_CUT: "#a8433b",
    changes_pb2.BodyChanges.FACE_BURNT: "#2b1c16",
    _COAGULATED: "#b3947f",
}
# Coagulation of all three corners from which on a triangle is pale.
_PALE = 128
_RETIRED_OPACITY = 0.25
_LIGAMENT = "#e3bfa0"
_STRAND_WIDTH = 4  # pixels
# Smallest upper end of the colours [mm], so that rounding is not shown as colours.
_LEAST_RANGE_MM = 0.1
# Smallest force with an arrow [N]. Its length is nearly proportional for small forces, and bounded [scene radii].
_LEAST_FORCE_N = 0.005
_ARROW_LIMIT = 0.75
_HALF_FORCE_N = 1.5


class Picture:
    """Draws the frames of one topology.

    Args:
        rest_m: positions of all visible vertices at rest, [vertex_count, 3] m; None: displacement counts from the first
            frame, and after a reset from the frame that follows it.
    """

    def __init__(self, plotter: pv.Plotter, first: Frame, rest_m: npt.NDArray[np.float32] | None) -> None:
        self._plotter = plotter
        self._topology = first.topology
        self._is_rest_known = rest_m is not None
        self._rest_m = first.positions[: first.surface.base_count] if rest_m is None else rest_m
        self._step = first.step
        self._range_mm = _LEAST_RANGE_MM
        corner = self._rest_m.max(axis=0) - self._rest_m.min(axis=0) if len(self._rest_m) else np.ones(3)
        self._radius_m = max(0.5 * float(np.linalg.norm(corner)), 1e-6)
        self._bodies = [self._add_body(body, first) for body in first.topology.bodies]
        self._faces: dict[tuple[int, int], pv.PolyData] = {}
        self._triangles = Triangles(first.topology)
        # What the meshes show: triangles change seldom, positions with each frame.
        self._shown = _Shown(0, first.surface.base_count)
        self._tools = {shape.name: _Tool(plotter, shape, self._radius_m) for shape in first.topology.tools}
        self._strands = _Strands(plotter, first) if len(first.broken_springs) else None
        self._text = plotter.add_text("", position="upper_left", font_size=10, color="black", name="state")
        self._look()
        self.update(first)

    @property
    def largest_displacement_m(self) -> float:
        """Returns the largest displacement of a visible vertex in the last frame [m]."""
        return 1e-3 * max((float(body["displacement"].max(initial=0)) for body, _ in self._bodies), default=0.0)

    def update(self, frame: Frame) -> None:
        """Shows a frame of the same topology."""
        if frame.step < self._step and not self._is_rest_known:
            self._rest_m = frame.positions[: len(self._rest_m)]
        self._step = frame.step
        surface, count = frame.surface, len(frame.positions)
        shown = _Shown(surface.revision, count)
        anew, self._shown = shown != self._shown, shown
        if anew:
            self._triangles = Triangles(self._topology, surface, count)
        # Nobody knows where appended vertices were at rest.
        distances_mm = np.zeros(count, np.float64)
        base = surface.base_count
        distances_mm[:base] = 1e3 * np.linalg.norm(frame.positions[:base].astype(np.float64) - self._rest_m, axis=1)
        normals = self._triangles.directions(np.ascontiguousarray(frame.positions.T))
        for i, (mesh, _) in enumerate(self._bodies):
            points = surface.vertices(i, frame.positions)
            if anew:
                triangles, faces = surface.triangles(i, count)
                faces = _with_pale(triangles, faces, surface.parts[i].coagulation)
                self._show_faces(i, points, triangles, faces)
                mesh.copy_from(_mesh_of(points, triangles[~np.isin(faces, list(_FACE_COLORS))]))
            mesh.points = points
            mesh["displacement"] = surface.vertices(i, distances_mm)
            mesh.point_data.active_normals = surface.vertices(i, normals)
        for (i, _), made in self._faces.items():
            made.points = surface.vertices(i, frame.positions)
        self._range_mm = max(self._range_mm, float(distances_mm.max(initial=0)))
        for _, actor in self._bodies:
            actor.mapper.scalar_range = (0.0, self._range_mm)
        if self._strands is not None:
            self._strands.update(frame)
        for name, feedback in frame.tools.items():
            if name in self._tools:
                self._tools[name].update(feedback)
        lines = [f"{self._topology.scene}  step {frame.step}  {frame.simulated_time_s:.2f} s"]
        lines += [f"{name}  {np.linalg.norm(feedback.force_n):.2f} N" for name, feedback in frame.tools.items()]
        self._text.set_text("upper_left", "\n".join(lines))

    def _add_body(self, body: stream_pb2.BodySurface, frame: Frame) -> tuple[pv.PolyData, pv.Actor]:
        points = frame.vertices(body.name)
        mesh = surface_mesh(points, body.triangles, f"body {body.name!r}")
        mesh["displacement"] = np.zeros(len(points))
        since = "rest" if self._is_rest_known else "the first frame"
        actor = self._plotter.add_mesh(
            mesh,
            scalars="displacement",
            clim=(0.0, _LEAST_RANGE_MM),
            cmap=_COLORS,
            specular=0.3,
            specular_power=20,
            scalar_bar_args={"title": f"displacement from {since} [mm]\n", "color": "black", "fmt": "%.3g"},
            reset_camera=False,
        )
        actor.prop.interpolation = "phong"
        return mesh, actor

    def _show_faces(
        self,
        body: int,
        points: npt.NDArray[np.float32],
        triangles: npt.NDArray[np.uint32],
        faces: npt.NDArray[np.uint8],
    ) -> None:
        """Shows the cut, burnt and coagulated faces of a body in their colours."""
        for face, color in _FACE_COLORS.items():
            mesh = _mesh_of(points, triangles[faces == face])
            made = self._faces.get((body, face))
            if made is not None:
                made.copy_from(mesh)
            elif mesh.n_cells:
                self._faces[body, face] = mesh
                self._plotter.add_mesh(mesh, color=color, reset_camera=False)

    def _look(self) -> None:
        """Looks at the bodies from obliquely above. Tools do not count, because a plane has no end."""
        gravity = self._topology.gravity_m_per_s2
        against = -np.array([gravity.x, gravity.y, gravity.z])
        up = against / np.linalg.norm(against) if np.any(against) else np.array([0.0, 0.0, 1.0])
        side = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        view = 0.55 * side + 0.65 * np.cross(side, up) + 0.5 * up
        self._plotter.set_background("white")
        middle = 0.5 * (self._rest_m.max(axis=0) + self._rest_m.min(axis=0)) if len(self._rest_m) else np.zeros(3)
        self._plotter.camera.focal_point = middle
        self._plotter.camera.position = middle + 4.2 * self._radius_m * view / np.linalg.norm(view)
        self._plotter.camera.up = up


class _Shown(NamedTuple):
    """What tells apart the triangles of two frames."""

    revision: int
    vertex_count: int


def _with_pale(
    triangles: npt.NDArray[np.uint32], faces: npt.NDArray[np.uint8], coagulation: npt.NDArray[np.uint8]
) -> npt.NDArray[np.uint8]:
    """Returns the faces, with those of coagulated tissue as `_COAGULATED`. Burnt ones stay dark."""
    if not coagulation.any() or not len(triangles):
        return faces
    pale = (coagulation[triangles].min(axis=1) >= _PALE) & (faces != changes_pb2.BodyChanges.FACE_BURNT)
    return np.where(pale, np.uint8(_COAGULATED), faces)


def _mesh_of(points: npt.NDArray[np.float32], triangles: npt.NDArray[np.uint32]) -> pv.PolyData:
    # An empty mesh would end its actor, so that a triangle without an area stays.
    corners = triangles if len(triangles) else np.zeros((min(1, len(points)), 3), np.uint32)
    return pv.PolyData.from_regular_faces(points, corners.astype(np.int64))


class _Strands:
    """The springs of all attachments: a line each, until it breaks."""

    def __init__(self, plotter: pv.Plotter, first: Frame) -> None:
        self._mesh = pv.PolyData()
        self.update(first)
        self._actor = plotter.add_mesh(
            self._mesh, color=_LIGAMENT, line_width=_STRAND_WIDTH, render_lines_as_tubes=True, reset_camera=False
        )

    def update(self, frame: Frame) -> None:
        attachments = [frame.springs(attachment.name) for attachment in frame.topology.attachments]
        ends_m = np.concatenate([springs.ends_m[~springs.broken] for springs in attachments])
        # An empty mesh would end its actor, so that one spring without a length stays.
        points = ends_m.reshape(-1, 3) if len(ends_m) else np.repeat(frame.attachment_points[:1], 2, axis=0)
        self._mesh.copy_from(pv.line_segments_from_points(points))


class _Tool:
    """A tool and the force on it."""

    def __init__(self, plotter: pv.Plotter, shape: stream_pb2.ToolShape, radius_m: float) -> None:
        self._shape = shape
        self._radius_m = radius_m
        self._joints: list[float] = []
        self._mesh = tool_mesh(shape, [], radius_m)
        looks: dict[str, Any] = {"color": _OBSTACLE if shape.tool.fixed else _STEEL, "specular": 0.5}
        if shape.tool.WhichOneof("kind") == "plane":
            looks["culling"] = "back"  # from below it would hide the tissue
        self._actor = plotter.add_mesh(self._mesh, reset_camera=False, **looks)
        arrow = pv.Arrow(tip_length=0.2, tip_radius=0.06, shaft_radius=0.02)  # from the origin along x, 1 m long
        self._arrow = plotter.add_mesh(arrow, color=_AMBER, ambient=0.5, reset_camera=False)
        self._arrow.visibility = False

    def update(self, feedback: Feedback) -> None:
        joints = feedback.joint_values.tolist()
        if joints != self._joints:
            self._joints = joints
            self._mesh.copy_from(tool_mesh(self._shape, joints, self._radius_m))
        matrix = pose_matrix(feedback.position_m, feedback.orientation)
        self._actor.user_matrix = matrix
        self._actor.prop.opacity = _RETIRED_OPACITY if feedback.retired else 1.0
        size_n = float(np.linalg.norm(feedback.force_n))
        # A table carries tissue at many points, and an arrow at its origin would mean nothing.
        self._arrow.visibility = size_n >= _LEAST_FORCE_N and not self._shape.tool.fixed
        if self._arrow.visibility:
            offset = self._shape.tip_offset_m
            tip = (matrix @ [offset.x, offset.y, offset.z, 1.0])[:3]
            length_m = self._radius_m * _ARROW_LIMIT / (1 + _HALF_FORCE_N / size_n)
            self._arrow.user_matrix = _arrow_matrix(tip, feedback.force_n / size_n, length_m)


def _arrow_matrix(start_m: npt.NDArray[Any], direction: npt.NDArray[Any], length_m: float) -> npt.NDArray[np.float64]:
    """Returns the transformation [4, 4] of an arrow along x of length 1."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    across /= np.linalg.norm(across)
    matrix = np.eye(4)
    matrix[:3, :3] = length_m * np.column_stack([direction, across, np.cross(direction, across)])
    matrix[:3, 3] = start_m
    return matrix
