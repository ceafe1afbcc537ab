"""The order of the nodes in the middle of edges, for formats whose programs differ in it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import FormatError, Ints

# Edges of a tetrahedron in VTK's order of their middles.
_EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


def in_vtk_order(points: npt.NDArray[np.floating], tetrahedra: Ints, where: str) -> Ints:
    """Orders the nodes of quadratic tetrahedra [n, 10] as VTK does: each middle belongs to the nearest edge.

    Raises:
        FormatError: the middles of an element do not belong to six different edges.
    """
    if not len(tetrahedra) or tetrahedra.min() < 0 or tetrahedra.max() >= len(points):
        return tetrahedra  # the indices are refused later
    corners, middles = points[tetrahedra[:, :4]], points[tetrahedra[:, 4:]]
    of_edges = corners[:, _EDGES].mean(axis=2)
    nearest = np.linalg.norm(of_edges[:, :, None] - middles[:, None], axis=3).argmin(axis=2)
    wrong = np.flatnonzero((np.sort(nearest, axis=1) != np.arange(6)).any(axis=1))
    if wrong.size:
        raise FormatError(
            f"{where}: element {wrong[0]} has nodes that are not near the middles of its edges; save linear tetrahedra"
        )
    return np.concatenate([tetrahedra[:, :4], np.take_along_axis(tetrahedra[:, 4:], nearest, axis=1)], axis=1)
