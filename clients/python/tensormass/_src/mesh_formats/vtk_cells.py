"""Cells of VTK's formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.kinds import KINDS, VTK
from tensormass._src.mesh_formats.raw import Block, FormatError, Ints, cell_nodes, runs

# Kinds of polydata in the order in which VTK counts their cells.
_PARTS = {"VERTICES": "vertex", "LINES": "line", "POLYGONS": "polygon", "TRIANGLE_STRIPS": "triangle_strip"}


def blocks_of(types: Ints, offsets: Ints, connectivity: Ints, where: Callable[[int], str]) -> list[Block]:
    """Returns the cells of an unstructured grid, from VTK's types and offsets [cells + 1].

    Raises:
        FormatError: an unknown type, or arrays that do not match; `where` names a cell by its number.
    """
    if len(offsets) != len(types) + 1:
        raise FormatError(
            f"{where(min(len(offsets) - 1, len(types)))}: there are {len(types)} types for "
            f"{len(offsets) - 1} cells; the file is damaged"
        )
    wrong = np.flatnonzero(np.diff(offsets) < 0)
    if wrong.size or offsets[0] != 0 or offsets[-1] != len(connectivity):
        raise FormatError(
            f"{where(int(wrong[0]) if wrong.size else len(types))}: offsets do not match the "
            "connectivity; the file is damaged"
        )
    blocks: list[Block] = []
    for number, rows in runs(types):
        first = rows.start if isinstance(rows, slice) else int(rows[0])
        if number not in VTK:
            raise FormatError(
                f"{where(first)} has VTK's type {number}, which is not read; save linear or quadratic cells"
            )
        kind = VTK[number]
        if KINDS[kind].node_count:
            blocks.append(Block(kind, cell_nodes(connectivity, offsets, kind, rows, where), rows))
        else:
            blocks += _of_any_size(kind, offsets, connectivity, rows)
    return blocks


def polygons(parts: Mapping[str, tuple[Ints, Ints]], where: Callable[[int], str]) -> list[Block]:
    """Returns the cells of polydata, from offsets [cells + 1] and connectivity of each part."""
    blocks: list[Block] = []
    first = 0
    for part, kind in _PARTS.items():
        if part not in parts:
            continue
        offsets, connectivity = parts[part]
        if offsets[0] != 0 or (np.diff(offsets) < 0).any() or offsets[-1] != len(connectivity):
            raise FormatError(f"{where(first)}: offsets of {part} do not match its connectivity; the file is damaged")
        for block in _of_any_size(kind, offsets, connectivity, slice(0, len(offsets) - 1)):
            rows = block.rows
            assert not isinstance(rows, slice)
            blocks.append(Block(block.kind, block.nodes, rows + first))
        first += len(offsets) - 1
    return blocks


def _of_any_size(kind: str, offsets: Ints, connectivity: Ints, rows: Ints | slice) -> list[Block]:
    """Groups cells of differing numbers of nodes by that number. Strips become triangles."""
    numbers = np.arange(rows.start or 0, rows.stop) if isinstance(rows, slice) else rows
    first = offsets[:-1][numbers]
    sizes = offsets[1:][numbers] - first
    blocks = []
    for size in np.unique(sizes).tolist():
        if not size:
            continue
        chosen = sizes == size
        nodes = connectivity[first[chosen][:, None] + np.arange(size)]
        of = numbers[chosen]
        if kind == "triangle_strip" and size >= 3:
            corners = [nodes[:, [k, k + 1, k + 2] if k % 2 == 0 else [k + 1, k, k + 2]] for k in range(size - 2)]
            blocks.append(Block("triangle", np.concatenate(corners), np.tile(of, size - 2)))
        else:
            name = {("polygon", 3): "triangle", ("polygon", 4): "quad"}.get((kind, size), kind)
            name = {("vertex", True): "poly_vertex", ("line", True): "poly_line"}.get(
                (name, size > max(KINDS[name].node_count, 1)), name
            )
            blocks.append(Block(name, nodes, of))
    return blocks


def grid_hexahedra(dimensions: tuple[int, int, int], where: str) -> Block:
    """Returns the cells of a grid of points, x fastest."""
    if min(dimensions) < 2:
        raise FormatError(f"{where}: a grid of {dimensions} points has no elements with a volume")
    x, y, z = dimensions
    index = np.arange(x * y * z).reshape(z, y, x)
    low, high = index[:-1], index[1:]
    corners = [
        layer[:, rows, columns]
        for layer in (low, high)
        for rows, columns in (
            (slice(None, -1), slice(None, -1)),
            (slice(None, -1), slice(1, None)),
            (slice(1, None), slice(1, None)),
            (slice(1, None), slice(None, -1)),
        )
    ]
    nodes: npt.NDArray[np.int64] = np.stack([corner.reshape(-1) for corner in corners], axis=1)
    return Block("hexahedron", nodes, slice(0, len(nodes)))
