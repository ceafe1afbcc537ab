"""Shapes of tools as triangles, in the tool's own frame. The web viewer draws the same ones (view/instruments.ts).

sphere   a ball                        retractor  a blade along x, then a shaft along z
capsule  a bar along z                 grasper    two jaws from a hinge on z, open by its joint in the plane of x, z
                                       scissors   two blades, the same way
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pyvista as pv

from tensormass import FloatArray, InternalError
from tensormass.v1 import scene_pb2, stream_pb2

# Edge of the square that stands for a plane, and length of the shaft that is only drawn [scene radii].
_PLANE_SIZE = 5.0
_SHAFT_LENGTH = 1.1
# Radius of the shaft behind a sphere, as a share of the sphere's.
_SHAFT_SHARE = 0.26
_SIDES = 32


def tool_mesh(shape: stream_pb2.ToolShape, joint_values: Sequence[float], scene_radius_m: float) -> pv.PolyData:
    """Returns the surface of a tool. The rounded edges of a box are left out.

    Args:
        joint_values: joints of the tool [rad or m].
        scene_radius_m: half the diagonal of the scene, for what has no size of its own.
    """
    kind = shape.tool.WhichOneof("kind")
    if kind == "box":
        box = shape.tool.box
        mesh = pv.Cube(x_length=box.size_x_m, y_length=box.size_y_m, z_length=box.size_z_m)
    elif kind == "plane":
        size = _PLANE_SIZE * scene_radius_m
        mesh = pv.Plane(i_size=size, j_size=size, i_resolution=1, j_resolution=1)
    elif kind == "mesh":
        mesh = _solid(shape.name, shape.tool.mesh)
    else:
        mesh = _bars(_corners(shape.tool, joint_values), shape.radius_m)
        if kind in (None, "spherical_probe", "grasper", "scissors"):
            mesh += _shaft(shape, scene_radius_m)
    offset = shape.tip_offset_m
    return mesh.translate((offset.x, offset.y, offset.z), inplace=False)


def _corners(tool: scene_pb2.Tool, joint_values: Sequence[float]) -> list[tuple[float, float, float]]:
    """Returns the corners of the line through a tool, from its tip on. A sphere and unknown kinds have one."""
    kind = tool.WhichOneof("kind")
    if kind == "capsule":
        return [(0, 0, 0), (0, 0, tool.capsule.length_m)]
    if kind == "retractor":
        blade = tool.retractor.blade_length_m
        return [(0, 0, 0), (blade, 0, 0), (blade, 0, tool.retractor.shaft_length_m)]
    jaw = _jaw_length_m(tool)
    if jaw > 0:
        half = (joint_values[0] if joint_values else 0.0) / 2
        x, z = jaw * math.sin(half), jaw * (1 - math.cos(half))
        return [(-x, 0, z), (0, 0, jaw), (x, 0, z)]
    return [(0, 0, 0)]


def _jaw_length_m(tool: scene_pb2.Tool) -> float:
    """Returns the length of the jaws of a grasper and of the blades of scissors; 0 for all others."""
    if tool.WhichOneof("kind") == "scissors":
        return tool.scissors.blade_length_m
    return tool.grasper.jaw_length_m


def _bars(corners: Sequence[tuple[float, float, float]], radius_m: float) -> pv.PolyData:
    """Returns round bars along a line, or a ball if the line is a point."""
    mesh = pv.Sphere(radius=radius_m, center=corners[0], theta_resolution=_SIDES, phi_resolution=_SIDES)
    for start, end in pairwise(np.array(corners)):
        if np.any(end != start):
            tube = pv.Line(start, end).tube(radius=radius_m, n_sides=_SIDES)
            mesh += tube + pv.Sphere(radius=radius_m, center=end, theta_resolution=_SIDES, phi_resolution=_SIDES)
    return mesh


def _shaft(shape: stream_pb2.ToolShape, scene_radius_m: float) -> pv.PolyData:
    """Returns a shaft along z that is not simulated: it shows how the tool is turned."""
    start = _jaw_length_m(shape.tool)
    radius_m = shape.radius_m if start > 0 else _SHAFT_SHARE * shape.radius_m
    line = pv.Line((0, 0, start), (0, 0, start + _SHAFT_LENGTH * scene_radius_m))
    return line.tube(radius=radius_m, n_sides=_SIDES)


def _solid(name: str, solid: scene_pb2.MeshSolid) -> pv.PolyData:
    packed = solid.surface.packed
    points = np.frombuffer(packed.vertex_positions, "<f8").reshape(-1, 3)
    scale = solid.scale if solid.HasField("scale") else 1.0
    return surface_mesh(scale * points, packed.triangles, f"tool {name!r}")


def surface_mesh(points: npt.NDArray[np.floating], triangles: bytes, where: str) -> pv.PolyData:
    """Returns a surface.

    Args:
        points: [vertex_count, 3] m.
        triangles: uint32 little-endian [triangle_count, 3].

    Raises:
        InternalError: a triangle without a vertex, which would crash the renderer.
    """
    faces = np.frombuffer(triangles, "<u4").reshape(-1, 3)
    if faces.size and int(faces.max()) >= len(points):
        raise InternalError(f"{where}: a triangle names vertex {faces.max()}, but there are {len(points)}")
    return pv.PolyData.from_regular_faces(points, faces.astype(np.int64))


def pose_matrix(feedback_position_m: FloatArray, orientation: FloatArray) -> FloatArray:
    """Returns the transformation [4, 4] from a tool's own frame, of its position [3] m and quaternion w, x, y, z."""
    w, x, y, z = orientation / max(float(np.linalg.norm(orientation)), 1e-30)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = feedback_position_m
    return matrix
