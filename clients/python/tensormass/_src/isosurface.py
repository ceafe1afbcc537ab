"""Tetrahedra that fill the inside of an implicit surface, by isosurface stuffing.

Reasons for this method instead of a general mesher: for a smooth function it is deterministic, takes a second, and
bounds the dihedral angles away from 0 and 180 degrees, as an explicit tissue model needs.

F. Labelle, J. R. Shewchuk, "Isosurface stuffing: fast tetrahedral meshes with good dihedral angles", SIGGRAPH 2007.
The lattice is body-centred cubic; its tetrahedra have two long edges (between points of the same cubic lattice) and
four short ones (to the other lattice). Lattice points that lie too near the surface are moved onto it, so that no cut
is small; then each tetrahedron that the surface cuts is replaced by one to three inside it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_repair import compact, rewind
from tensormass._src.meshes import FloatArray, TriangleSurface, VolumeMesh

Implicit = Callable[[FloatArray], FloatArray]
"""Continuous function, [n, 3] m -> [n]: positive inside, zero on the surface."""
Indices = npt.NDArray[np.int64]
# A cut that is nearer to a lattice point than this share of its edge moves the point (the paper's safe choice for both
# kinds of edges).
_WARP_LONG = 0.24999
_WARP_SHORT = 0.41189
_BISECTIONS = 24


def fill(inside: Implicit, lower_m: FloatArray, upper_m: FloatArray, cell_m: float) -> VolumeMesh:
    """Meshes {x : inside(x) > 0} within the box [lower_m, upper_m], which must contain it.

    Args:
        cell_m: edge of the lattice's cubes [m]; the longest edge of the elements. Twelve tetrahedra fill a cube.
    """
    points, tetrahedra = _lattice(lower_m, upper_m, cell_m)
    value = inside(points)
    kept = (value[tetrahedra] > 0).any(axis=1)
    tetrahedra = tetrahedra[kept]
    edges, is_long = unique_edges(tetrahedra, len(points))
    crossed = value[edges[:, 0]] * value[edges[:, 1]] < 0
    edges, is_long = edges[crossed], is_long[crossed]
    cuts = cut_points(inside, points[edges[:, 0]], points[edges[:, 1]], value[edges[:, 0]])
    _warp(points, value, edges, is_long, cuts)

    # Keeps the cuts onto which no point was moved.
    crossed = value[edges[:, 0]] * value[edges[:, 1]] < 0
    edges, cuts = edges[crossed], cuts[crossed]
    cut_of = _PairTable(edges, len(points), first=len(points))
    nodes = np.concatenate([points, cuts])
    tetrahedra = _stencils(tetrahedra, np.sign(value), cut_of)
    return compact(rewind(VolumeMesh.from_tetrahedra(nodes, tetrahedra)))


def project(inside: Implicit, points: FloatArray, step_m: float, iterations: int = 4) -> FloatArray:
    """Moves points near the surface onto it, along the gradient (central differences over `step_m`)."""
    points = points.copy()
    for _ in range(iterations):
        gradient = np.stack(
            [(inside(points + d) - inside(points - d)) / (2 * step_m) for d in np.eye(3) * step_m], axis=1
        )
        square = np.einsum("ij,ij->i", gradient, gradient)
        points -= gradient * (inside(points) / np.maximum(square, 1e-12))[:, None]
    return points


def smooth(surface: TriangleSurface, inside: Implicit, step_m: float, rounds: int = 6) -> TriangleSurface:
    """Evens out triangles: moves each vertex to the mean of its neighbours, then back onto the surface."""
    triangles = surface.triangles.astype(np.int64)
    start, end = (np.concatenate([triangles[:, [k, (k + 1) % 3]][:, side] for k in range(3)]) for side in (0, 1))
    degree = np.bincount(start, minlength=len(surface.vertices))[:, None]
    vertices = surface.vertices
    for _ in range(rounds):
        mean = np.stack(
            [np.bincount(start, weights=vertices[end, k], minlength=len(vertices)) for k in range(3)], axis=1
        )
        vertices = project(inside, 0.5 * vertices + 0.5 * mean / degree, step_m, iterations=2)
    return TriangleSurface(vertices, surface.triangles)


def _lattice(lower_m: FloatArray, upper_m: FloatArray, cell_m: float) -> tuple[FloatArray, Indices]:
    """Makes points and tetrahedra of the lattice. Corners of cubes come first, then the cubes' centres."""
    count = np.ceil((upper_m - lower_m) / cell_m).astype(np.int64) + 1
    corner_shape, centre_shape = count + 1, count
    corners = _grid_points(corner_shape) * cell_m + lower_m - 0.5 * cell_m
    centres = _grid_points(centre_shape) * cell_m + lower_m
    blocks = []
    for axis in range(3):
        # Centres of two neighbouring cubes and the four corners of the face between them: one tetrahedron for each
        # edge.
        u, v = (axis + 1) % 3, (axis + 2) % 3
        left = _grid_indices(centre_shape - np.eye(3, dtype=np.int64)[axis])
        right = left + np.eye(3, dtype=np.int64)[axis]
        ring = [right + np.eye(3, dtype=np.int64)[u] * i + np.eye(3, dtype=np.int64)[v] * j for i, j in _SQUARE]
        a, b = _flat(left, centre_shape) + len(corners), _flat(right, centre_shape) + len(corners)
        corner = [_flat(point, corner_shape) for point in ring]
        blocks += [np.stack([a, b, corner[k], corner[(k + 1) % 4]], axis=1) for k in range(4)]
    return np.concatenate([corners, centres]), np.concatenate(blocks)


_SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))


def _grid_indices(shape: Indices) -> Indices:
    return np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)


def _grid_points(shape: Indices) -> FloatArray:
    return _grid_indices(shape).astype(np.float64)


def _flat(index: Indices, shape: Indices) -> Indices:
    flat: Indices = (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]
    return flat


def unique_edges(tetrahedra: Indices, point_count: int) -> tuple[Indices, npt.NDArray[np.bool_]]:
    """Returns unique edges [n, 2], smaller index first, and whether each is an edge 01 or 23 of a tetrahedron. These
    are the long edges of the lattice."""
    pairs = [(0, 1), (2, 3), (0, 2), (0, 3), (1, 2), (1, 3)]
    keys = np.concatenate([pair_keys(tetrahedra[:, a], tetrahedra[:, b], point_count) for a, b in pairs])
    unique, first = np.unique(keys, return_index=True)
    return np.stack([unique // point_count, unique % point_count], axis=1), first < 2 * len(tetrahedra)


def pair_keys(a: Indices, b: Indices, point_count: int) -> Indices:
    """Returns a number for each pair of points, the same in both orders."""
    keys: Indices = np.minimum(a, b) * point_count + np.maximum(a, b)
    return keys


def cut_points(inside: Implicit, a: FloatArray, b: FloatArray, value_a: FloatArray) -> FloatArray:
    """Finds the zero of the function between `a` and `b`, by bisection."""
    low, high = np.zeros(len(a)), np.ones(len(a))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same = inside(a + middle[:, None] * (b - a)) * value_a > 0
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return a + (0.5 * (low + high))[:, None] * (b - a)


def _warp(
    points: FloatArray, value: FloatArray, edges: Indices, is_long: npt.NDArray[np.bool_], cuts: FloatArray
) -> None:
    """Moves points that are too near to a cut onto the nearest cut, and sets their value to zero."""
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    limit = np.where(is_long, _WARP_LONG, _WARP_SHORT) * length
    moved, cut = nearest_cuts(points, edges, cuts, np.stack([limit, limit]))
    points[moved] = cuts[cut]
    value[moved] = 0.0


def nearest_cuts(points: FloatArray, edges: Indices, cuts: FloatArray, limits: FloatArray) -> tuple[Indices, Indices]:
    """Returns the points with a cut on one of their edges within its limit, and the nearest such cut of each.

    Args:
        cuts: one on each edge, [n, 3].
        limits: distances from the first and from the second end of each edge, [2, n].
    """
    distance = np.concatenate([np.linalg.norm(points[edges[:, side]] - cuts, axis=1) for side in (0, 1)])
    point, cut = edges.T.reshape(-1), np.tile(np.arange(len(edges)), 2)
    near = distance < limits.reshape(-1)
    order = np.lexsort((cut[near], distance[near], point[near]))
    found, first = np.unique(point[near][order], return_index=True)
    return found, cut[near][order][first]


class _PairTable:
    """Looks up the node of the cut on an edge, by the ends of the edge."""

    def __init__(self, edges: Indices, point_count: int, first: int) -> None:
        self._point_count = point_count
        self._keys = pair_keys(edges[:, 0], edges[:, 1], point_count)  # sorted, as `_edges` made them
        self._first = first

    def __call__(self, inner: Indices, outer: Indices, sign: FloatArray) -> Indices:
        """Returns the cut between an inner and an outer point. A point on the surface is its own cut."""
        if not len(self._keys):
            return inner
        place = np.searchsorted(self._keys, pair_keys(inner, outer, self._point_count))
        return np.where(sign[inner] == 0, inner, self._first + np.minimum(place, len(self._keys) - 1))


def _stencils(tetrahedra: Indices, sign: FloatArray, cut_of: _PairTable) -> Indices:
    """Cuts each tetrahedron to the part inside the surface."""
    # Sorts inner corners first. The number of outer corners then decides.
    order = np.argsort(-sign[tetrahedra], axis=1, kind="stable")
    lattice = np.array([0, 0, 1, 1])[order]  # two points of the same one are joined by a long edge
    corner = np.take_along_axis(tetrahedra, order, axis=1)
    outer = (sign[corner] < 0).sum(axis=1)
    solid = sign[corner[:, 0]] > 0

    blocks = [corner[solid & (outer == 0)]]

    three = corner[solid & (outer == 3)]
    blocks.append(np.stack([three[:, 0], *(cut_of(three[:, 0], three[:, k], sign) for k in (1, 2, 3))], axis=1))

    # One corner outside: a prism between the inner face and the cuts of the edges that leave it.
    chosen = solid & (outer == 1)
    one, of = corner[chosen], lattice[chosen]
    top = one[:, :3]
    bottom = np.stack([cut_of(one[:, k], one[:, 3], sign) for k in range(3)], axis=1)
    diagonals = (_before(one, of, p, q, 3) for p, q in ((0, 1), (0, 2), (1, 2)))
    blocks.append(_prism(top, bottom, *diagonals))

    # Two outside: a prism between the triangles at the two inner corners. Its third side lies inside the tetrahedron,
    # so its diagonal is free: chosen against the first, which never closes a circle.
    chosen = solid & (outer == 2)
    two, of = corner[chosen], lattice[chosen]
    sides = [
        np.stack([two[:, k], cut_of(two[:, k], two[:, 2], sign), cut_of(two[:, k], two[:, 3], sign)], axis=1)
        for k in (0, 1)
    ]
    first_face, second_face = (_before(two, of, 0, 1, n) for n in (2, 3))
    blocks.append(_prism(sides[0], sides[1], first_face, second_face, ~first_face))
    return np.concatenate(blocks)


def _before(corner: Indices, lattice: npt.NDArray[np.int64], p: int, q: int, n: int) -> npt.NDArray[np.bool_]:
    """Chooses the diagonal that halves the inner part p q c_q c_p of a face p q n whose corner n is outside.

    True is the diagonal from p to c_q. Neighbours choose alike, because only points of the face matter: the diagonal
    ends at the cut of the face's long edge, or, where both cut edges are short, at the inner point of lower index.
    """
    long_p, long_q = lattice[:, p] == lattice[:, n], lattice[:, q] == lattice[:, n]
    result: npt.NDArray[np.bool_] = np.where(long_p | long_q, long_q, corner[:, p] < corner[:, q])
    return result


def _prism(
    top: Indices,
    bottom: Indices,
    zero_before_one: npt.NDArray[np.bool_],
    zero_before_two: npt.NDArray[np.bool_],
    one_before_two: npt.NDArray[np.bool_],
) -> Indices:
    """Returns three tetrahedra of a prism with columns top[:, k] - bottom[:, k]; `i_before_j` is the diagonal top i -
    bottom j.

    Columns that are a single point make tetrahedra with a repeated corner, which are dropped.
    """
    rank = np.stack(
        [
            (~zero_before_one).astype(np.int64) + ~zero_before_two,
            zero_before_one.astype(np.int64) + ~one_before_two,
            zero_before_two.astype(np.int64) + one_before_two,
        ],
        axis=1,
    )
    assert (np.sort(rank, axis=1) == [0, 1, 2]).all(), "the diagonals of a prism close a circle"
    order = np.argsort(rank, axis=1)
    top, bottom = np.take_along_axis(top, order, axis=1), np.take_along_axis(bottom, order, axis=1)
    columns = np.concatenate([top, bottom], axis=1)
    pieces = columns[:, [[0, 1, 2, 5], [0, 1, 4, 5], [0, 3, 4, 5]]].reshape(-1, 4)
    ordered = np.sort(pieces, axis=1)
    return pieces[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)]
