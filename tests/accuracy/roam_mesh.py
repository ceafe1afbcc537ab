"""A mesh of the demo organ that is fine along a path: the reference of roam.py.

Edges near the path are halved with all tetrahedra around them, longest first, until none is longer than wanted (M. C.
Rivara, "Algorithms for refining triangular grids suitable for adaptive and multigrid techniques", IJNME 20, 1984). If
an edge of a tetrahedron is halved, so is its longest one, which bounds how flat it can become. New nodes of the
boundary move onto the organ's surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tensormass._src.interface import halve, qualities
from tensormass._src.isosurface import Implicit, Indices, pair_keys, project, unique_edges
from tensormass._src.mesh_geometry import boundary_triangles
from tensormass._src.meshes import BoolArray, FloatArray, VolumeMesh
from tensormass._src.shapes import SHAPES

_EDGES = np.array(SHAPES["tetrahedron"].edges)
# Points whose distances to the path are computed at a time.
_CHUNK = 4096
_GRADIENT_STEP_M = 1e-5


def refine(
    mesh: VolumeMesh, inside: Implicit, path_m: FloatArray, bands_m: Sequence[tuple[float, float]]
) -> VolumeMesh:
    """Returns linear tetrahedra that are fine along a path.

    Args:
        inside: the organ's implicit function, onto whose zero new nodes of the boundary move.
        path_m: [n, 3].
        bands_m: distances from the path, and the longest edge within each.
    """
    (name,) = mesh.sets
    is_held = np.zeros(len(mesh.nodes), bool)
    is_held[mesh.sets[name]] = True
    nodes, tetrahedra = mesh.nodes, mesh.elements("tetrahedron").astype(np.int64)
    for distance_m, edge_m in bands_m:
        while len(edges := _too_long(nodes, tetrahedra, path_m, distance_m, edge_m)):
            middle = nodes[edges].mean(axis=1)
            outer = boundary_triangles(VolumeMesh.from_tetrahedra(nodes, tetrahedra)).astype(np.int64)
            of_boundary = pair_keys(outer, np.roll(outer, 1, axis=1), len(nodes))
            is_outer = np.isin(pair_keys(edges[:, 0], edges[:, 1], len(nodes)), of_boundary)
            middle[is_outer] = project(inside, middle[is_outer], _GRADIENT_STEP_M)
            tetrahedra = halve(tetrahedra, edges, first=len(nodes))
            nodes = np.concatenate([nodes, middle])
            is_held = np.concatenate([is_held, is_held[edges].all(axis=1)])
    if not qualities(nodes, tetrahedra).min() > 0:
        raise ValueError("a tetrahedron of the refined mesh is inverted")
    refined = VolumeMesh.from_tetrahedra(nodes, tetrahedra)
    return replace(refined, sets={name: np.flatnonzero(is_held).astype(np.uint32)})


def _too_long(nodes: FloatArray, tetrahedra: Indices, path_m: FloatArray, distance_m: float, edge_m: float) -> Indices:
    """Returns the edges to halve, the longest first, [n, 2]: those near the path, and the longest edge of each
    tetrahedron that would be cut. Empty if none near the path is too long."""
    edges, _ = unique_edges(tetrahedra, len(nodes))
    lengths = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    marked = lengths > edge_m
    marked[marked] = distances(nodes[edges[marked]].mean(axis=1), path_m) < distance_m
    if not marked.any():
        return edges[:0]
    keys = pair_keys(edges[:, 0], edges[:, 1], len(nodes))
    of_element = np.searchsorted(keys, pair_keys(tetrahedra[:, _EDGES[:, 0]], tetrahedra[:, _EDGES[:, 1]], len(nodes)))
    longest = of_element[np.arange(len(of_element)), lengths[of_element].argmax(axis=1)]
    while True:
        wanted: BoolArray = marked.copy()
        wanted[longest[marked[of_element].any(axis=1)]] = True
        if (wanted == marked).all():
            break
        marked = wanted
    chosen = np.flatnonzero(marked)
    return edges[chosen[np.argsort(-lengths[chosen], kind="stable")]]


def distances(points_m: FloatArray, path_m: FloatArray) -> FloatArray:
    """Returns the distance of each point to the nearest point of the path, [n] m."""
    if not len(points_m):
        return np.empty(0)
    parts = [
        np.sqrt(((points_m[i : i + _CHUNK, None] - path_m[None]) ** 2).sum(axis=2).min(axis=1))
        for i in range(0, len(points_m), _CHUNK)
    ]
    return np.concatenate(parts)
