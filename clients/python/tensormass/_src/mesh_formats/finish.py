"""Makes a volume or a surface of a file's content. Each cell and set is used, or named with its count in a note."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._shared.names import as_name
from tensormass._src.mesh_formats.kinds import ELEMENT_FIELDS, FIELD_ALIASES, KINDS, SET_PREFIX, VOLUMES, plain
from tensormass._src.mesh_formats.raw import Block, Floats, FormatError, Ints, Raw

_FILL = "if it is a closed surface, fill it with `tensormass mesh --edge LENGTH`"
# VTK's voxel counts x fastest; a hexahedron goes around each face.
_VOXEL_ORDER = [0, 1, 3, 2, 4, 5, 7, 6]
_PIXEL_ORDER = [0, 1, 3, 2]
_WEDGE_MIRRORED = [0, 2, 1, 3, 5, 4]


@dataclass
class Volume:
    """Elements that are simulated, by their shapes."""

    points: npt.NDArray[np.float64]
    #: Name of a shape and its elements, indices from 0.
    blocks: list[tuple[str, Ints]]
    sets: dict[str, Ints]
    fields: dict[str, Floats]
    notes: list[str] = field(default_factory=list)


@dataclass
class Surface:
    """Triangles without repeated vertices."""

    points: npt.NDArray[np.float64]
    triangles: Ints
    texture: Floats | None
    notes: list[str] = field(default_factory=list)


def volume(raw: Raw, where: str, *, drop_unused: bool = True) -> Volume:
    """Makes a volume of the cells of known shapes.

    Args:
        drop_unused: leaves out nodes that belong to no element, such as reference points.

    Raises:
        FormatError: no volume, or cells of a shape that is not simulated.
    """
    _check_indices(raw, where)
    _refuse_others(raw, where)
    kept = [block for block in raw.blocks if KINDS[block.kind].shape and len(block.nodes)]
    if not kept:
        found = _counted([block for block in raw.blocks if len(block.nodes)])
        raise FormatError(f"{where}: has no elements with a volume{f' ({found})' if found else ''}; {_FILL}")
    notes = list(raw.notes)
    sets = _sets(raw, where, notes)
    in_sets = _cells_in_sets(raw)
    if left := _left_over(raw, in_sets):
        notes.append(f"{left} have no volume, belong to no set, and are skipped")
    _check_data(raw, where)
    blocks, rows = [], []
    for block in kept:
        nodes = block.nodes
        if block.kind == "voxel":
            nodes = nodes[:, _VOXEL_ORDER]
        blocks.append((KINDS[block.kind].shape, nodes))
        rows.append(block.rows)
    fields = {
        name: np.concatenate([np.asarray(values[of], np.float64) for of in rows])
        for name, values in _element_fields(raw).items()
    }
    if raw.repeats_elements:
        blocks, fields = _once(blocks, fields)
    points = np.ascontiguousarray(raw.points, np.float64)
    del raw
    blocks = [(name, _wound(points, nodes) if name == "wedge" else nodes) for name, nodes in blocks]
    if drop_unused:
        points, blocks, sets = _without_unused(points, blocks, sets, notes)
    return Volume(points, blocks, {name: nodes for name, nodes in sets.items() if len(nodes)}, fields, notes)


def surface(raw: Raw, where: str) -> Surface:
    """Makes a surface of triangles, quadrilaterals, polygons and strips. Equal vertices are merged.

    Raises:
        FormatError: nothing of them.
    """
    _check_indices(raw, where)
    triangles: list[Ints] = []
    skipped = []
    for block in raw.blocks:
        if block.kind in ("triangle", "quad", "polygon", "pixel"):
            nodes = block.nodes[:, _PIXEL_ORDER] if block.kind == "pixel" else block.nodes
            triangles += (
                [nodes] if nodes.shape[1] == 3 else [nodes[:, [0, k, k + 1]] for k in range(1, nodes.shape[1] - 1)]
            )
        elif len(block.nodes):
            skipped.append(block)
    notes = list(raw.notes)
    found = _counted(skipped)
    if not triangles or not sum(map(len, triangles)):
        raise FormatError(
            f"{where}: has no triangles{f' ({found})' if found else ''}; a skin and a surface to be meshed need them"
        )
    if found:
        notes.append(f"{found} do not belong to a surface and are skipped")
    points = np.ascontiguousarray(raw.points, np.float64)
    corners = triangles[0] if len(triangles) == 1 else np.concatenate(triangles)
    # STL repeats each vertex in each triangle, and Wavefront those on a seam of a picture.
    points, corners = _merged(points, corners)
    return Surface(points, corners, raw.texture, notes)


def _merged(points: npt.NDArray[np.float64], corners: Ints) -> tuple[npt.NDArray[np.float64], Ints]:
    """Merges equal points, which come in the order of x, y and z then. Without any, nothing changes."""
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    is_new = np.ones(len(points), bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    if is_new.all():
        return points, corners
    index_of = np.empty(len(points), np.int32)
    index_of[order] = np.cumsum(is_new, dtype=np.int32) - 1
    return ordered[is_new], index_of[corners]


def _check_indices(raw: Raw, where: str) -> None:
    if raw.points.ndim != 2 or raw.points.shape[1:] != (3,) or not len(raw.points):
        raise FormatError(f"{where}: has no points in three dimensions")
    bad = np.flatnonzero(~np.isfinite(raw.points).all(axis=1))
    if bad.size:
        raise FormatError(f"{where}: nodes: row {bad[0]} is not finite: {np.asarray(raw.points[bad[0]]).tolist()}")
    for block in raw.blocks:
        if not len(block.nodes):
            continue
        if block.nodes.min() < 0 or block.nodes.max() >= len(raw.points):
            row = int(np.flatnonzero(((block.nodes < 0) | (block.nodes >= len(raw.points))).any(axis=1))[0])
            wrong = block.nodes[row]
            node = int(wrong[(wrong < 0) | (wrong >= len(raw.points))][0])
            raise FormatError(
                f"{_place(raw, block, row, where)} uses node {node} (counted from 0), but there are {len(raw.points)}"
            )


def _place(raw: Raw, block: Block, row: int, where: str) -> str:
    number = (block.rows.start or 0) + row if isinstance(block.rows, slice) else int(block.rows[row])
    return raw.place(number) if raw.place else f"{where}: cell {number}"


def _refuse_others(raw: Raw, where: str) -> None:
    """Refuses volumes of shapes that are not simulated. Dropping them would leave a hole."""
    for block in raw.blocks:
        kind = KINDS[block.kind]
        if kind.dimension == 3 and not kind.shape and len(block.nodes):
            same = sum(len(other.nodes) for other in raw.blocks if other.kind == block.kind)
            raise FormatError(
                f"{_place(raw, block, 0, where)} is one of {same} elements of type {block.kind}; known are "
                f"{', '.join(VOLUMES)}: mesh it with those"
            )


def _check_data(raw: Raw, where: str) -> None:
    for name, values in _element_fields(raw).items():
        width = ELEMENT_FIELDS[name]
        if values.shape[1:] not in ((), (1,)) if width == 1 else values.shape[1:] != (width,):
            raise FormatError(
                f"{where}: data {name!r} of cells: expected {width} numbers a cell, got {values.shape[1:]}"
            )


def _element_fields(raw: Raw) -> dict[str, npt.NDArray[Any]]:
    named = {FIELD_ALIASES.get(name, name): values for name, values in raw.cell_data.items()}
    return {
        name: values.reshape(-1) if ELEMENT_FIELDS[name] == 1 and values[0:1].size == len(values[0:1]) else values
        for name, values in named.items()
        if name in ELEMENT_FIELDS
    }


def _rows(block: Block) -> Ints:
    if isinstance(block.rows, slice):
        return np.arange(block.rows.start or 0, (block.rows.start or 0) + len(block.nodes))
    return block.rows


def _sets(raw: Raw, where: str, notes: list[str]) -> dict[str, Ints]:
    """Returns all sets as sets of nodes, by names in the protocol's letters."""
    cells = _nodes_of_cells(raw)
    found = [(name, np.unique(nodes), "") for name, nodes in raw.node_sets.items()]
    found += [(name, nodes, "_elements") for name, nodes in cells.items()]
    sets: dict[str, Ints] = {}
    empty = []
    for name, nodes, ending in found:
        key = as_name(name)
        if not len(nodes):
            empty.append(name)
            continue
        if key in sets and np.array_equal(sets[key], nodes):
            continue  # a set of nodes and one of elements that mean the same
        if key in sets and ending:
            key = as_name(name)[: 64 - len(ending)] + ending
            notes.append(f"{name!r} names a set of nodes and one of elements; the latter is called {key!r}")
        if key in sets:
            raise FormatError(f"{where}: two of its sets are called {key!r}; rename one")
        sets[key] = nodes
    if empty:
        notes.append(f"{len(empty)} sets are empty and are skipped: {', '.join(map(repr, empty[:5]))}")
    return sets


def _nodes_of_cells(raw: Raw) -> dict[str, Ints]:
    if not raw.cell_sets:
        return {}
    nodes: dict[str, list[Ints]] = {name: [] for name in raw.cell_sets}
    for block in raw.blocks:
        if not len(block.nodes):
            continue
        rows = _rows(block)
        mask = np.zeros(int(rows.max()) + 1, bool)
        for name, chosen in raw.cell_sets.items():
            inside = chosen[chosen < len(mask)]
            mask[inside] = True
            nodes[name].append(np.unique(block.nodes[mask[rows]]))
            mask[inside] = False
    return {name: np.unique(np.concatenate(parts)) if parts else np.empty(0, np.int64) for name, parts in nodes.items()}


def _cells_in_sets(raw: Raw) -> Ints:
    return np.unique(np.concatenate([np.empty(0, np.int64), *raw.cell_sets.values()]))


def _left_over(raw: Raw, used: Ints) -> str:
    left = []
    for block in raw.blocks:
        if KINDS[block.kind].dimension < 3 and len(block.nodes):
            free = ~np.isin(_rows(block), used)
            left.append(Block(block.kind, block.nodes[free], slice(0), block.label))
    return _counted(left)


def _counted(blocks: list[Block]) -> str:
    """Returns `3 triangles, 2 lines`."""
    counts: dict[str, int] = {}
    for block in blocks:
        name = block.label or plain(block.kind)
        counts[name] = counts.get(name, 0) + len(block.nodes)
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def _once(
    blocks: list[tuple[str, Ints]], fields: dict[str, Floats]
) -> tuple[list[tuple[str, Ints]], dict[str, Floats]]:
    """Keeps the first of elements that have the same nodes in the same order."""
    kept: list[npt.NDArray[np.bool_]] = []
    for name in {name: None for name, _ in blocks}:
        same = [nodes for other, nodes in blocks if other == name]
        mask = _first_ones(same[0] if len(same) == 1 else np.concatenate(same))
        parts = iter(np.split(mask, np.cumsum([len(nodes) for nodes in same])[:-1]))
        for index, (other, _) in enumerate(blocks):
            if other == name:
                kept += [np.empty(0, bool)] * (index + 1 - len(kept))
                kept[index] = next(parts)
    out = [(name, nodes[mask]) for (name, nodes), mask in zip(blocks, kept, strict=True) if mask.any()]
    every = np.concatenate(kept)
    return out, {name: values[every] for name, values in fields.items()}


def _first_ones(rows: Ints) -> npt.NDArray[np.bool_]:
    """Marks the first of equal rows. Rows are compared by a hash first, which needs less memory."""
    hashes = np.zeros(len(rows), np.uint64)
    for column in range(rows.shape[1]):
        hashes += rows[:, column].astype(np.uint64)
        hashes *= np.uint64(0x9E3779B97F4A7C15)
        hashes ^= hashes >> np.uint64(29)
    order = np.argsort(hashes, kind="stable")
    hashes = hashes[order]
    again = np.flatnonzero(hashes[1:] == hashes[:-1])
    mask = np.ones(len(rows), bool)
    if again.size:
        suspects = np.sort(order[np.union1d(again, again + 1)])
        _, first = np.unique(rows[suspects], axis=0, return_index=True)
        mask[suspects] = False
        mask[suspects[first]] = True
    return mask


def _wound(points: npt.NDArray[np.float64], wedges: Ints) -> Ints:
    """Gives each wedge a positive volume. VTK's documentation and its programs differ in the order, and so do files."""
    a, b, c = (points[wedges[:, k]] for k in range(3))
    top = points[wedges[:, 3:6]].mean(axis=1) - points[wedges[:, :3]].mean(axis=1)
    wrong = np.einsum("ei,ei->e", np.cross(b - a, c - a), top) < 0
    if not wrong.any():
        return wedges
    out = wedges.copy()
    out[wrong] = out[wrong][:, _WEDGE_MIRRORED]
    return out


def _without_unused(
    points: npt.NDArray[np.float64], blocks: list[tuple[str, Ints]], sets: dict[str, Ints], notes: list[str]
) -> tuple[npt.NDArray[np.float64], list[tuple[str, Ints]], dict[str, Ints]]:
    used = np.zeros(len(points), bool)
    for _, nodes in blocks:
        used[nodes] = True
    if used.all():
        return points, blocks, sets
    count = int((~used).sum())
    notes.append(
        "1 node belongs to no element and is left out"
        if count == 1
        else f"{count} nodes belong to no element and are left out"
    )
    index_of = np.cumsum(used, dtype=np.int32) - 1
    kept: dict[str, Ints] = {}
    for name, nodes in sets.items():
        inside = nodes[used[nodes]]
        if len(inside) == 0:
            notes.append(f"the set {name!r} has {len(nodes)} nodes, none of an element, and is skipped")
        else:
            kept[name] = index_of[inside]
    renumbered: list[tuple[str, Ints]] = [(name, index_of[nodes]) for name, nodes in blocks]
    return points[used], renumbered, kept


def sets_from_data(raw: Raw, point_data: dict[str, npt.NDArray[Any]]) -> None:
    """Adds the sets that are written as data `set:NAME`, of nodes or of cells, where they are not zero."""
    for name, values in point_data.items():
        if name.startswith(SET_PREFIX) and values.ndim == 1:
            raw.node_sets[name.removeprefix(SET_PREFIX)] = np.flatnonzero(values)
    for name, values in raw.cell_data.items():
        if name.startswith(SET_PREFIX) and values.ndim == 1:
            raw.cell_sets[name.removeprefix(SET_PREFIX)] = np.flatnonzero(values)
