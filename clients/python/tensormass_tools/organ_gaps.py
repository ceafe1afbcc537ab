"""Takes bodies apart that overlap at rest by a little, because each was smoothed and meshed for itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass import BoolArray, FloatArray, VolumeMesh, boundary_triangles, signed_volumes
from tensormass_tools import segment_surface
from tensormass_tools.organ_bodies import Body

#: Distance of two bodies that touch, in edges. Their contact starts at half of it.
GAP = 0.05
_ROUNDS = 40
# Share of a missing distance that each side moves in a round.
_STEP = 0.4
# Nodes farther from the other surface than this, in edges, are not inside it.
_REACH = 1.5
# A distance that is short by less than this share of the gap is kept.
_ENOUGH = 0.02
# An element may lose this share of its volume, or its nodes stay.
_MAX_LOSS = 0.7


def separate(bodies: Sequence[Body]) -> None:
    """Moves nodes of bodies that touch out of each other. Volumes stay."""
    pairs = [
        (body, other)
        for body in bodies
        for other in bodies
        if other.name in body.touches and body.name in other.touches
    ]
    before = {body.name: signed_volumes(body.mesh) for body in bodies}
    start = {body.name: body.mesh_volume_m3 for body in bodies}
    for _ in range(_ROUNDS):
        moved = [_move_out(body, other, before) for body, other in pairs]
        if not any(moved):
            break
    for body in bodies:
        if body.mesh_volume_m3 != start[body.name]:
            _restore_volume(body, start[body.name], before[body.name])


def _restore_volume(body: Body, volume_m3: float, volumes: FloatArray) -> None:
    """Moves the rest of the boundary out by as much as the body has lost, unless that spoils an element."""
    triangles = boundary_triangles(body.mesh).astype(np.int64)
    free = ~np.logical_or.reduce(list(body.touches.values()))
    if not free[triangles].any():
        return
    nodes = segment_surface.with_volume(body.mesh.nodes, triangles, volume_m3, free)
    mesh = replace(body.mesh, nodes=nodes)
    if (signed_volumes(mesh) >= (1 - _MAX_LOSS) * volumes).all():
        body.mesh = mesh


def _move_out(body: Body, other: Body, volumes: Mapping[str, FloatArray]) -> bool:
    """Moves nodes of one body out of the other, and the triangles there away from them. Returns whether any moved."""
    from scipy.spatial import KDTree

    triangles, places, normals = _samples(other.mesh, other.touches[body.name])
    own_triangles = boundary_triangles(body.mesh)
    outer = np.unique(own_triangles[body.touches[other.name][own_triangles].any(axis=1)])
    edge_m = min(body.edge_m, other.edge_m)
    nodes = body.mesh.nodes
    distance, nearest = KDTree(places).query(nodes[outer], distance_upper_bound=_REACH * edge_m)
    near = np.isfinite(distance)
    outer, nearest = outer[near], nearest[near]
    height = np.einsum("ni,ni->n", nodes[outer] - places[nearest], normals[nearest])
    missing = GAP * edge_m - height
    # A height below all lengths here is that of a node beyond a thin part.
    wanted = (missing > _ENOUGH * GAP * edge_m) & (height > -_REACH * edge_m)
    step_m = _STEP * missing[wanted, np.newaxis] * normals[nearest[wanted]]
    own = np.zeros_like(nodes)
    own[outer[wanted]] = step_m
    others = np.zeros_like(other.mesh.nodes)
    for corner in range(3):
        others[triangles[nearest[wanted] // _SAMPLES, corner]] = -step_m
    return _move(body, own, volumes) | _move(other, others, volumes)


def _move(body: Body, step_m: FloatArray, volumes: Mapping[str, FloatArray]) -> bool:
    """Moves nodes, but for those that would spoil an element. Returns whether any moved."""
    for _ in range(4):
        if not step_m.any():
            return False
        mesh = replace(body.mesh, nodes=body.mesh.nodes + step_m)
        spoilt = signed_volumes(mesh) < (1 - _MAX_LOSS) * volumes[body.name]
        if not spoilt.any():
            body.mesh = mesh
            return True
        step_m[_nodes_of(mesh, spoilt)] = 0
    return False


def _nodes_of(mesh: VolumeMesh, elements: npt.NDArray[np.bool_]) -> npt.NDArray[np.integer]:
    return np.unique(np.concatenate([block.nodes for block in mesh.blocks])[elements])


# Points on a triangle as weights of its corners, drawn in a little, so that each has its own triangle's normal.
_WEIGHTS = 0.98 * np.array([[i, j, 6 - i - j] for i in range(7) for j in range(7 - i)]) / 6 + 0.02 / 3
_SAMPLES = len(_WEIGHTS)


def _samples(mesh: VolumeMesh, nodes: BoolArray) -> tuple[npt.NDArray[np.integer], FloatArray, FloatArray]:
    """Returns the triangles of the boundary at some nodes, `_SAMPLES` points on each, and the normals there."""
    triangles = boundary_triangles(mesh)
    near = nodes[triangles].any(axis=1)
    # One ring of triangles more, because the nearest one of a node may lie there.
    around = np.zeros(len(mesh.nodes), bool)
    around[triangles[near]] = True
    triangles = triangles[around[triangles].any(axis=1)]
    corner = mesh.nodes[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    places = np.einsum("wk,tki->twi", _WEIGHTS, corner).reshape(-1, 3)
    return triangles, places, np.repeat(normal, _SAMPLES, axis=0)
