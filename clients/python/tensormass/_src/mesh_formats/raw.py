"""The content of a mesh file before it becomes a volume or a surface."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.kinds import KINDS

Ints = npt.NDArray[np.integer]
Floats = npt.NDArray[np.floating]
# More changes of kind along a file's cells than this, and cells are grouped by kind.
_MAX_RUNS = 1000


class FormatError(ValueError):
    """A file cannot be read as it is. The message says place, value and remedy."""


@dataclass
class Block:
    """Cells of one kind."""

    kind: str
    #: Indices of nodes from 0, [n, nodes of the kind].
    nodes: Ints
    #: Numbers of these cells in the order of the file, for data and places.
    rows: Ints | slice
    #: Name of the kind in the file's own words, for messages; empty: that of `kind`.
    label: str = ""


@dataclass
class Raw:
    """The content of a mesh file, with cells of every kind in the file's order."""

    #: [n, 3]
    points: Floats
    blocks: list[Block]
    #: Sets of nodes, by the file's names.
    node_sets: dict[str, Ints] = field(default_factory=dict)
    #: Sets of cells by their numbers in the order of the file.
    cell_sets: dict[str, Ints] = field(default_factory=dict)
    #: Data of cells, one row a cell of the file.
    cell_data: dict[str, npt.NDArray[Any]] = field(default_factory=dict)
    #: Statements about parts of the file that are not used.
    notes: list[str] = field(default_factory=list)
    #: Returns the place of a cell, by its number in the order of the file: `FILE:LINE: element 7`.
    place: Callable[[int], str] | None = None
    #: Equal elements that follow each other are one element of several groups.
    repeats_elements: bool = False
    #: Places (u, v) of the triangles' corners in a picture, [n, 3, 2].
    texture: Floats | None = None


def runs(kinds: Ints) -> Iterator[tuple[int, Ints | slice]]:
    """Yields the cells of one kind after another: runs in the file's order, or all of one kind if the runs are many."""
    ends = np.flatnonzero(np.diff(kinds)) + 1
    if len(ends) < _MAX_RUNS:
        edges = [0, *ends.tolist(), len(kinds)]
        for first, last in itertools.pairwise(edges):
            if last > first:
                yield int(kinds[first]), slice(first, last)
        return
    for kind in np.unique(kinds):
        yield int(kind), np.flatnonzero(kinds == kind)


def gathered(flat: Ints, first: Ints, count: int) -> Ints:
    """Returns `count` numbers from each place of `first` on, [n, count]. Works column by column to save memory."""
    out = np.empty((len(first), count), flat.dtype)
    for column in range(count):
        out[:, column] = flat[first + column]
    return out


def cell_nodes(connectivity: Ints, offsets: Ints, kind: str, rows: Ints | slice, where: Callable[[int], str]) -> Ints:
    """Returns the nodes of cells [n, nodes of the kind]. `offsets` has one entry more than there are cells.

    Raises:
        FormatError: a cell of another number of nodes; `where` names the place of the cell with a number.
    """
    count = KINDS[kind].node_count
    first = offsets[:-1][rows]
    sizes = offsets[1:][rows] - first
    wrong = np.flatnonzero(sizes != count)
    if wrong.size:
        cell = int(wrong[0])
        number = (rows.start or 0) + cell if isinstance(rows, slice) else int(rows[cell])
        raise FormatError(f"{where(number)} is a {kind} and has {sizes[cell]} nodes, not {count}; write the file again")
    if isinstance(rows, slice):
        return connectivity[first[0] : first[0] + len(first) * count].reshape(-1, count)
    return gathered(connectivity, first, count)
