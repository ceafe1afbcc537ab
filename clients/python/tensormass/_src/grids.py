"""Boxes of cells, cut into elements as the daemon cuts `Mesh.grid`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._src.meshes import ElementBlock, VolumeMesh
from tensormass._src.shapes import SHAPES

# How a cell is cut, its corners counted as x + 2 y + 4 z and its centre as 8; the daemon cuts `Mesh.grid` in this way.
_CELL_CUTS = {
    "tetrahedron": [[0, 1, 3, 7], [0, 5, 1, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 6, 4, 7]],
    "pyramid": [[0, 1, 3, 2, 8], [4, 6, 7, 5, 8], [0, 4, 5, 1, 8], [2, 3, 7, 6, 8], [0, 2, 6, 4, 8], [1, 5, 7, 3, 8]],
    "wedge": [[0, 1, 3, 4, 5, 7], [0, 3, 2, 4, 7, 6]],
    "hexahedron": [[0, 1, 3, 2, 4, 5, 7, 6]],
}
_CELL_CUTS["quadratic_tetrahedron"] = _CELL_CUTS["tetrahedron"]
_CELL_CUTS["quadratic_hexahedron"] = _CELL_CUTS["hexahedron"]


def grid(
    cells: Sequence[int],
    size_m: npt.ArrayLike,
    *,
    shape: str = "tetrahedron",
    origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> VolumeMesh:
    """A box of cells [3], each cut into elements of one shape, with nodes and elements in the order of `Mesh.grid`."""
    if shape not in _CELL_CUTS:
        raise InvalidArgumentError(f"grid: unknown shape {shape!r}; {suggestion(shape, _CELL_CUTS)}")
    counts = np.array(cells, dtype=np.int64)
    size, origin = np.array(size_m, dtype=np.float64), np.array(origin_m, dtype=np.float64)
    if counts.shape != (3,) or (counts < 1).any() or size.shape != (3,) or not (size > 0).all():
        raise InvalidArgumentError(f"grid: expected three counts of cells and three lengths, got {cells!r}, {size_m!r}")
    cuts = np.array(_CELL_CUTS[shape])
    # Points are named by their place in half cells, so that corners, centres and middles are all whole.
    corner_of_cell = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)]) * 2
    local = np.concatenate([corner_of_cell, [[1, 1, 1]]])[cuts]  # [element, node, 3]
    if SHAPES[shape].middles:
        first, second = np.array(SHAPES[shape].middles).T
        local = np.concatenate([local, (local[:, first] + local[:, second]) // 2], axis=1)
    places = (2 * _lattice(counts)[:, None, None, :] + local).reshape(-1, local.shape[1], 3)

    # Behind the corners come the other points that elements have, centres or middles.
    halves = _lattice(2 * counts + 1)
    stride = np.array([1, 2 * counts[0] + 1, (2 * counts[0] + 1) * (2 * counts[1] + 1)])
    used = np.zeros(len(halves), bool)
    used[places @ stride] = True
    nodes = np.concatenate([2 * _lattice(counts + 1), halves[used & (halves % 2).any(axis=1)]])
    node_of = np.empty(len(halves), np.uint32)
    node_of[nodes @ stride] = np.arange(len(nodes))
    block = ElementBlock(SHAPES[shape], node_of[places @ stride])
    return VolumeMesh(origin + size * (nodes / (2.0 * counts)), (block,))


def _lattice(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """[n, 3]: the points of a box, x fastest."""
    z, y, x = np.meshgrid(*(np.arange(count) for count in counts[::-1]), indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)
