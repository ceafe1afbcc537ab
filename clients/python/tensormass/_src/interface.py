"""Fits a tetrahedral mesh to an interface: a surface that runs through the body.

A region of a body, such as the part that its surroundings hold, selects nodes. In a mesh that ignores the region's
surface the selected part ends up to a cell inside it. In a fitted mesh no edge crosses the surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass._src.isosurface import Implicit, Indices, cut_points, nearest_cuts, pair_keys, unique_edges
from tensormass._src.mesh_geometry import boundary_triangles
from tensormass._src.meshes import BoolArray, FloatArray, VolumeMesh
from tensormass._src.shapes import SHAPES

# A node nearer to a cut than this share of the cut edge lies on the interface.
_NEAR = 0.25
# A node is not moved if an element's quality falls below both of these: a value, and a share of what it was.
_LEAST_QUALITY = 0.2
_LEAST_SHARE = 0.8
_EDGES = np.array(SHAPES["tetrahedron"].edges)


def fit(mesh: VolumeMesh, inside: Implicit, name: str) -> VolumeMesh:
    """Returns the linear tetrahedra of a mesh, cut along the surface inside(x) = 0, with a set of nodes.

    First, nodes near the surface move onto it, those of the boundary along its edges. Nodes that cannot move without
    flattening an element stay, and count as lying on it. Then each edge that still crosses the surface is halved at
    the crossing, with all tetrahedra around it, long edges first. Neighbours cut their common face in the same order,
    so the mesh still conforms. Other sets are dropped.

    Args:
        name: of the set: the nodes inside the surface and on it.
    """
    nodes, tetrahedra = mesh.nodes.copy(), mesh.elements("tetrahedron").astype(np.int64)
    on_surface = _move(nodes, tetrahedra, boundary_triangles(mesh).astype(np.int64), inside)
    value = np.where(on_surface, 0.0, inside(nodes))
    edges, cuts = _crossings(nodes, tetrahedra, value, inside)
    for side in (0, 1):
        value[edges[_share(nodes, edges, cuts, side) < _NEAR, side]] = 0.0
    crossed = _crosses(value, edges)
    edges, cuts = edges[crossed], cuts[crossed]
    order = np.argsort(-_lengths(nodes, edges), kind="stable")
    fitted = VolumeMesh.from_tetrahedra(
        np.concatenate([nodes, cuts[order]]), halve(tetrahedra, edges[order], first=len(nodes))
    )
    selected = np.flatnonzero(np.concatenate([value >= 0, np.ones(len(cuts), bool)]))
    return replace(fitted, sets={name: selected.astype(np.uint32)})


def qualities(nodes: FloatArray, tetrahedra: Indices) -> FloatArray:
    """Returns the volume of each tetrahedron relative to that of a regular one whose edges have the same mean square:
    1 at best, 0 if flat, negative if inverted."""
    a, b, c, d = (nodes[tetrahedra[:, corner]] for corner in range(4))
    volume = np.einsum("ei,ei->e", b - a, np.cross(c - a, d - a)) / 6
    squares = np.stack([_lengths(nodes, tetrahedra[:, pair]) ** 2 for pair in _EDGES])
    ratio: FloatArray = volume * 6 * np.sqrt(2) / squares.mean(axis=0) ** 1.5
    return ratio


def _move(nodes: FloatArray, tetrahedra: Indices, outer: Indices, inside: Implicit) -> BoolArray:
    """Moves nodes to the nearest cut of their edges; those of the triangles `outer`, of the edges of these. Returns
    which were moved, [node_count]."""
    edges, cuts = _crossings(nodes, tetrahedra, inside(nodes), inside)
    outer_edges = pair_keys(outer, np.roll(outer, 1, axis=1), len(nodes))
    slides = np.isin(pair_keys(edges[:, 0], edges[:, 1], len(nodes)), outer_edges)
    is_outer = np.zeros(len(nodes), bool)
    is_outer[outer] = True

    is_free = ~is_outer[edges.T] | slides
    moved, cut = nearest_cuts(nodes, edges, cuts, np.where(is_free, _NEAR * _lengths(nodes, edges), 0.0))

    before = nodes[moved].copy()
    least = np.minimum(_LEAST_QUALITY, _LEAST_SHARE * qualities(nodes, tetrahedra))
    nodes[moved] = cuts[cut]
    is_moved = np.zeros(len(nodes), bool)
    is_moved[moved] = True
    while True:
        back = np.unique(tetrahedra[qualities(nodes, tetrahedra) < least])
        back = back[is_moved[back]]
        if not len(back):
            return is_moved
        nodes[back] = before[np.searchsorted(moved, back)]
        is_moved[back] = False


def _crossings(
    nodes: FloatArray, tetrahedra: Indices, value: FloatArray, inside: Implicit
) -> tuple[Indices, FloatArray]:
    """Returns the edges that cross the surface, [n, 2], and where they do, [n, 3]."""
    edges, _ = unique_edges(tetrahedra, len(nodes))
    edges = edges[_crosses(value, edges)]
    return edges, cut_points(inside, nodes[edges[:, 0]], nodes[edges[:, 1]], value[edges[:, 0]])


def _crosses(value: FloatArray, edges: Indices) -> BoolArray:
    crossed: BoolArray = value[edges[:, 0]] * value[edges[:, 1]] < 0
    return crossed


def _share(nodes: FloatArray, edges: Indices, cuts: FloatArray, side: int) -> FloatArray:
    """Returns the distance of each cut from one end of its edge, as a share of the edge."""
    share: FloatArray = np.linalg.norm(nodes[edges[:, side]] - cuts, axis=1) / _lengths(nodes, edges)
    return share


def _lengths(nodes: FloatArray, edges: Indices) -> FloatArray:
    return np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)


def halve(tetrahedra: Indices, edges: Indices, first: int) -> npt.NDArray[np.int64]:
    """Halves all tetrahedra around each edge, in the order of `edges`; edge i gets the node first + i."""
    if not len(edges):
        return tetrahedra
    node_count = first + len(edges)
    keys = pair_keys(edges[:, 0], edges[:, 1], node_count)
    order = np.argsort(keys)
    done = []
    while len(tetrahedra):
        own = pair_keys(tetrahedra[:, _EDGES[:, 0]], tetrahedra[:, _EDGES[:, 1]], node_count)
        place = order[np.minimum(np.searchsorted(keys, own, sorter=order), len(keys) - 1)]
        rank = np.where(keys[place] == own, place, len(keys))
        least = rank.min(axis=1)
        split = least < len(keys)
        done.append(tetrahedra[~split])
        tetrahedra, ends, new = tetrahedra[split], _EDGES[rank[split].argmin(axis=1)], first + least[split]
        halves = [tetrahedra.copy(), tetrahedra.copy()]
        for half, end in zip(halves, ends.T, strict=True):
            half[np.arange(len(half)), end] = new
        tetrahedra = np.concatenate(halves)
    return np.concatenate(done)
