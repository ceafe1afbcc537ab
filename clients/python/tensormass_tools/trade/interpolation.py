"""Interpolation from the nodes of a mesh to given points. Settings differ in their nodes and are compared at common
points.

Elements with straight edges and flat, parallel sides are located and interpolated exactly: all tetrahedra, and the
elements of grids. Others are treated as if they had such sides. A point outside the mesh is extrapolated from the
nearest element, because meshes of one organ with different resolutions differ in their surfaces.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from tensormass import SHAPES, FloatArray, VolumeMesh

_Indices = npt.NDArray[np.int64]
# Tolerance for a point inside an element, for rounding.
_INSIDE = -1e-9
# Number of points that are compared with every element at once.
_CHUNK = 64
# Corners of a hexahedron along the three edges that leave its first node.
_CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


class Interpolation:
    """Interpolates from the nodes of `mesh` to `points` [n, 3] m, both at rest."""

    def __init__(self, mesh: VolumeMesh, points: FloatArray) -> None:
        self._nodes = np.zeros((len(points), max(shape.node_count for shape, _ in mesh.blocks)), np.int64)
        self._weights = np.zeros(self._nodes.shape)
        best = np.full(len(points), -np.inf)
        for shape, elements in mesh.blocks:
            frame, weigh = _SHAPES[shape.name]
            corners = mesh.nodes[elements]
            origin = corners[:, 0]
            inverse = np.linalg.inv(np.stack([corners[:, k] - origin for k in frame], axis=2))
            candidates = _candidates(corners, points)
            missed = np.setdiff1d(np.arange(len(points)), candidates[0])
            for point, element in (candidates, *_nearest(origin, corners.mean(axis=1), points, missed, len(elements))):
                local = np.einsum("nij,nj->ni", inverse[element], points[point] - origin[element])
                depth, weights = weigh(local)
                order = np.lexsort((element, -depth, point))  # the deepest of each point first
                first = order[np.unique(point[order], return_index=True)[1]]
                first = first[depth[first] > best[point[first]]]
                found = point[first]
                best[found] = depth[first]
                self._nodes[found] = 0
                self._weights[found] = 0
                self._nodes[found, : elements.shape[1]] = elements[element[first]]
                self._weights[found, : elements.shape[1]] = weights[first]
        #: Number of points outside the mesh.
        self.outside_count = int((best < _INSIDE).sum())

    def __call__(self, values: FloatArray) -> FloatArray:
        """Interpolates values, [node_count, k] -> [n, k]."""
        taken: FloatArray = np.einsum("pn,pnk->pk", self._weights, values[self._nodes])
        return taken


def _candidates(corners: FloatArray, points: FloatArray) -> tuple[_Indices, _Indices]:
    """Returns pairs (point, element) that share a cell of a lattice about as wide as the elements."""
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    slack = 1e-9 * float(np.ptp(points, axis=0).max() + np.ptp(upper, axis=0).max())
    start = lower.min(axis=0) - slack
    width = float(np.median((upper - lower).max(axis=1)))
    first = ((lower - slack - start) / width).astype(np.int64)
    last = ((upper + slack - start) / width).astype(np.int64)
    counts = last.max(axis=0) + 1
    stride = np.array([1, counts[0], counts[0] * counts[1]])
    spans = last - first + 1
    element = np.repeat(np.arange(len(corners)), spans.prod(axis=1))
    within = _ranges(spans.prod(axis=1))
    span = spans[element]
    offset = np.stack([within % span[:, 0], within // span[:, 0] % span[:, 1], within // (span[:, 0] * span[:, 1])], 1)
    cell = (first[element] + offset) @ stride
    order = np.argsort(cell, kind="stable")
    element, cell = element[order], cell[order]

    place = np.floor((points - start) / width).astype(np.int64)
    inside = np.flatnonzero(((place >= 0) & (place < counts)).all(axis=1))
    wanted = place[inside] @ stride
    begin, end = np.searchsorted(cell, wanted, "left"), np.searchsorted(cell, wanted, "right")
    return np.repeat(inside, end - begin), element[np.repeat(begin, end - begin) + _ranges(end - begin)]


def _ranges(counts: _Indices) -> _Indices:
    """Counts up to each number: [2, 3] -> 0 1 0 1 2."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)


def _nearest(
    origin: FloatArray, centres: FloatArray, points: FloatArray, missed: _Indices, element_count: int
) -> list[tuple[_Indices, _Indices]]:
    """Returns, for points in no element's cell, the few elements with the nearest centres."""
    pairs = []
    few = min(8, element_count)
    for begin in range(0, len(missed), _CHUNK):
        of = missed[begin : begin + _CHUNK]
        distance = ((points[of, None] - centres[None]) ** 2).sum(axis=2)
        near = np.argpartition(distance, few - 1, axis=1)[:, :few]
        pairs.append((np.repeat(of, few), near.reshape(-1)))
    return pairs


# Function of the coordinates of points along the three edges that leave the first node, [n, 3]. Returns how deep each
# point lies inside (negative: outside), [n], and the weights of the element's nodes, [n, nodes].
_Weigh = Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def _barycentric(local: FloatArray) -> FloatArray:
    return np.concatenate([1 - local.sum(axis=1, keepdims=True), local], axis=1)


def _tetrahedron(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    weights = _barycentric(local)
    return weights.min(axis=1), weights


def _quadratic_tetrahedron(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    linear = _barycentric(local)
    middles = [4 * linear[:, a] * linear[:, b] for a, b in SHAPES["quadratic_tetrahedron"].middles]
    return linear.min(axis=1), np.concatenate([linear * (2 * linear - 1), np.stack(middles, axis=1)], axis=1)


def _wedge(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    triangle, height = _barycentric(local[:, :2]), local[:, 2:]
    depth = np.concatenate([triangle, height, 1 - height], axis=1).min(axis=1)
    return depth, np.concatenate([triangle * (1 - height), triangle * height], axis=1)


def _square(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)


def _hexahedron(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    base, height = _square(local[:, 0], local[:, 1]), local[:, 2:]
    return np.minimum(local, 1 - local).min(axis=1), np.concatenate([base * (1 - height), base * height], axis=1)


def _quadratic_hexahedron(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Serendipity functions: an edge's middle takes half of its own weight from each of its ends."""
    depth, corners = _hexahedron(local)
    middles = []
    for a, b in SHAPES["quadratic_hexahedron"].middles:
        # The weights of the two ends are c (1 - x) and c x along their edge; the middle's is 4 c x (1 - x).
        sum_of_ends = corners[:, a] + corners[:, b]
        (axis,) = np.flatnonzero(_CUBE[a] != _CUBE[b])
        middles.append(4 * sum_of_ends * local[:, axis] * (1 - local[:, axis]))
    for (a, b), middle in zip(SHAPES["quadratic_hexahedron"].middles, middles, strict=True):
        corners[:, a] -= middle / 2
        corners[:, b] -= middle / 2
    return depth, np.concatenate([corners, np.stack(middles, axis=1)], axis=1)


def _pyramid(local: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y, height = local.T
    depth = np.stack([x, y, height, 1 - height - x, 1 - height - y]).min(axis=0)
    width = np.where(np.abs(1 - height) > 1e-12, 1 - height, 1.0)  # at the apex the base has no weight
    return depth, np.concatenate([_square(x / width, y / width) * (1 - height)[:, None], height[:, None]], axis=1)


# By shape: the nodes at which those three edges end, and the function.
_SHAPES: dict[str, tuple[tuple[int, int, int], _Weigh]] = {
    "tetrahedron": ((1, 2, 3), _tetrahedron),
    "pyramid": ((1, 3, 4), _pyramid),
    "wedge": ((1, 2, 3), _wedge),
    "hexahedron": ((1, 3, 4), _hexahedron),
    "quadratic_tetrahedron": ((1, 2, 3), _quadratic_tetrahedron),
    "quadratic_hexahedron": ((1, 3, 4), _quadratic_hexahedron),
}
