"""A half ball of tissue with fine cells under a point of contact: a small block, and layers of cells that grow
outwards."""

from __future__ import annotations

import numpy as np

from .meshes import Floats, Integers, Mesh, cell_grid, from_cells


def half_ball(shape: str, cells: int, layers: int, inner_m: float, outer_m: float) -> Mesh:
    """The half ball z <= 0 of radius outer_m around the origin.

    cells: cells along half a side of the block, which is 2 inner_m wide and inner_m deep. layers: layers around it.
    """
    grid, block = cell_grid((2 * cells, 2 * cells, cells))
    unit = grid * np.array([2, 2, 1]) - 1
    on_rim = np.flatnonzero((np.abs(unit[:, :2]).max(axis=1) > 1 - 1e-9) | (unit[:, 2] < -1 + 1e-9))
    rim = unit[on_rim]
    direction = np.tan(np.pi / 4 * rim)
    far = outer_m * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    out = growing(layers, inner_m / cells / (outer_m - inner_m))
    shells = [inner_m * rim + share * (far - inner_m * rim) for share in out[1:]]
    place = np.full(len(unit), -1)
    place[on_rim] = np.arange(len(rim))
    quads = _smallest_first(place[_rim_faces(block, unit)])
    before = on_rim[quads]
    cells_of = [block]
    for layer in range(layers):
        after = len(unit) + layer * len(rim) + quads
        cells_of.append(np.hstack([before, after]))
        before = after
    return from_cells(shape, np.vstack([inner_m * unit, *shells]), np.vstack(cells_of))


def _rim_faces(block: Integers, unit: Floats) -> Integers:
    """Faces of the block that tissue surrounds, counter-clockwise seen from outside, [face, 4]."""
    local = ((0, 3, 2, 1), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
    sides = ((2, -1), (1, -1), (0, 1), (1, 1), (0, -1))
    found = []
    for corners, (axis, sign) in zip(local, sides, strict=True):
        faces = block[:, list(corners)]
        found.append(faces[(np.abs(unit[faces, axis] - sign) < 1e-9).all(axis=1)])
    return np.vstack(found)


def _smallest_first(quads: Integers) -> Integers:
    """Turns each quadrilateral so that shapes that cut it take the diagonal that its other neighbour takes."""
    first = quads.argmin(axis=1)
    return np.take_along_axis(quads, (first[:, None] + np.arange(4)) % 4, axis=1)


def growing(count: int, first: float) -> Floats:
    """Numbers from 0 to 1, [count + 1], whose differences grow evenly from about `first`."""
    low, high = 1.0, 100.0
    for _ in range(100):
        ratio = (low + high) / 2
        low, high = (ratio, high) if first * (ratio ** np.arange(count)).sum() < 1 else (low, ratio)
    steps = low ** np.arange(count)
    return np.concatenate([[0], np.cumsum(steps) / steps.sum()])
