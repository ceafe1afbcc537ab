"""Rest positions and element fields on the visible surface of a scene, computed from the scene's message.

The bus carries the moving surface only. The gateway knows more of the scenes that it or its program loaded: their
meshes and skins. An element's value goes to its nodes (mean over the elements around a node), and from there to the
vertices of the surface: unchanged if a vertex is a node, else by the inverse distance to the nearest nodes at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass import VolumeMesh, body_mesh
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

FloatArray = npt.NDArray[np.float64]

NEIGHBOURS = 4
"""Nearest nodes from which a vertex of a skin takes its value."""

MAX_DISTANCES = 4_000_000_000
"""Products of vertices and nodes of a skin. Beyond, finding the nearest nodes takes minutes."""

_CHUNK = 256


class MismatchError(Exception):
    """A message and a topology do not belong together, or the scene is too large. The text says which."""


def rest_positions(scene: scene_pb2.Scene, topology: stream_pb2.Topology) -> npt.NDArray[np.float32]:
    """Returns the positions of all visible vertices at rest, [vertex_count, 3] m.

    Raises:
        MismatchError: the topology is not that of the scene.
    """
    parts = [_rest_of(body, surface, body_mesh(body)) for body, surface in _pairs(scene, topology)]
    return np.concatenate([np.empty((0, 3)), *parts]).astype("<f4")


@dataclass(frozen=True)
class _BodyMap:
    """From the elements of a body to the vertices of its surface."""

    mesh: VolumeMesh
    nodes: npt.NDArray[np.int64]
    """[vertex_count, k]: nodes from which a vertex takes its value."""
    weights: FloatArray
    """[vertex_count, k]; each row sums to 1."""

    def values(self, element_values: FloatArray) -> FloatArray:
        count = len(self.mesh.nodes)
        total, elements = np.zeros(count), np.zeros(count)
        first = 0
        for _, block in self.mesh.blocks:
            of_block = element_values[first : first + len(block)]
            first += len(block)
            flat = block.ravel().astype(np.int64)
            total += np.bincount(flat, np.repeat(of_block, block.shape[1]), count)
            elements += np.bincount(flat, minlength=count)
        nodal = total / np.maximum(elements, 1)
        return np.asarray((nodal[self.nodes] * self.weights).sum(axis=1))


class SurfaceMap:
    """Maps element fields of a scene to its surface. Making one may take seconds.

    Raises:
        MismatchError: the topology is not that of the scene, or the scene is too large.
    """

    def __init__(self, scene: scene_pb2.Scene, topology: stream_pb2.Topology) -> None:
        self.bodies = {body.name: _map_of(body, surface) for body, surface in _pairs(scene, topology)}

    def values(self, name: str, replies: dict[str, control_pb2.GetFieldsResponse]) -> npt.NDArray[np.float32]:
        """Returns the field `name` of FIELDS at all visible vertices. `replies` has the answer for each body."""
        parts = [
            body.values(reduced(name, np.frombuffer(replies[at].fields[0].values, "<f8")))
            for at, body in self.bodies.items()
        ]
        return np.concatenate([np.empty(0), *parts]).astype("<f4")


FIELDS = {
    "von_mises": control_pb2.FIELD_VON_MISES_STRESS,
    "largest_strain": control_pb2.FIELD_LARGEST_STRAIN,
    "pressure": control_pb2.FIELD_CAUCHY_STRESS,
    "volume_ratio": control_pb2.FIELD_DET_F,
}
"""Fields that a browser can ask for, and what the daemon computes for each."""


def reduced(name: str, values: FloatArray) -> FloatArray:
    """Returns one number an element: of stresses the pressure, -tr(σ)/3; other fields unchanged."""
    return -values.reshape(-1, 6)[:, :3].mean(axis=1) if name == "pressure" else values


def _pairs(
    scene: scene_pb2.Scene, topology: stream_pb2.Topology
) -> list[tuple[scene_pb2.Body, stream_pb2.BodySurface]]:
    if [body.name for body in scene.bodies] != [surface.name for surface in topology.bodies]:
        raise MismatchError("another scene of the same name is loaded")
    return list(zip(scene.bodies, topology.bodies, strict=True))


def _rest_of(body: scene_pb2.Body, surface: stream_pb2.BodySurface, mesh: VolumeMesh) -> FloatArray:
    if surface.nodes:
        nodes = np.frombuffer(surface.nodes, "<u4")
        if len(nodes) != surface.vertex_count or nodes.max(initial=0) >= len(mesh.nodes):
            raise MismatchError(f"body {body.name!r} has another mesh")
        return _placed(body, mesh.nodes[nodes])
    if len(body.skin.packed.vertex_positions) != 24 * surface.vertex_count:
        raise MismatchError(f"body {body.name!r} has another skin")
    vertices = np.frombuffer(body.skin.packed.vertex_positions, "<f8").reshape(-1, 3)
    return _placed(body, vertices)


def _placed(body: scene_pb2.Body, nodes: FloatArray) -> FloatArray:
    """Applies the scale and translation of a body's mesh, which hold for its skin as well."""
    scale = body.mesh.scale if body.mesh.HasField("scale") else 1.0
    offset = body.mesh.translation_m
    return np.asarray(scale * nodes + [offset.x, offset.y, offset.z])


def _map_of(body: scene_pb2.Body, surface: stream_pb2.BodySurface) -> _BodyMap:
    mesh = body_mesh(body)
    vertices = _rest_of(body, surface, mesh)
    if surface.nodes:
        nodes = np.frombuffer(surface.nodes, "<u4").astype(np.int64)[:, None]
        return _BodyMap(mesh, nodes, np.ones((len(nodes), 1)))
    if len(vertices) * len(mesh.nodes) > MAX_DISTANCES:
        raise MismatchError(f"body {body.name!r} is too large for colours of its skin")
    nodes, distances = _nearest(vertices, _placed(body, mesh.nodes))
    # A vertex at a node takes that node's value.
    weights = 1 / np.maximum(distances, 1e-9 * max(float(distances.max(initial=0)), 1e-30))
    return _BodyMap(mesh, nodes, weights / weights.sum(axis=1, keepdims=True))


def _nearest(points: FloatArray, nodes: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Returns the nearest nodes of each point and their distances, both [point_count, NEIGHBOURS or fewer]."""
    count = min(NEIGHBOURS, len(nodes))
    found = np.empty((len(points), count), np.int64)
    distances = np.empty((len(points), count))
    squares = (nodes**2).sum(axis=1)
    for start in range(0, len(points), _CHUNK):
        chunk = points[start : start + _CHUNK]
        # |p - n|² without |p|², which changes no order.
        order = np.argpartition(squares - 2 * chunk @ nodes.T, count - 1, axis=1)[:, :count]
        found[start : start + len(chunk)] = order
        distances[start : start + len(chunk)] = np.linalg.norm(nodes[order] - chunk[:, None, :], axis=2)
    return found, distances
