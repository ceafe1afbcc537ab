"""What an input file of Abaqus or CalculiX says: elements, spaces of numbers, and instances at their places."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.abaqus_deck import Keyword
from tensormass._src.mesh_formats.abaqus_sets import Sets
from tensormass._src.mesh_formats.kinds import KINDS
from tensormass._src.mesh_formats.numbering import Numbering
from tensormass._src.mesh_formats.raw import Block, FormatError, Ints, Raw


@dataclass
class Elements:
    """Elements of one keyword."""

    type: str
    kind: str
    numbers: Ints
    nodes: Ints
    keyword: Keyword
    #: Data line of each element.
    lines: Ints


@dataclass
class Space:
    """Nodes, elements and sets of one part, of the assembly, or of a file without parts."""

    name: str
    nodes: list[tuple[Ints, npt.NDArray[np.float64], Keyword]] = field(default_factory=list)
    elements: list[Elements] = field(default_factory=list)
    sets: Sets = field(default_factory=Sets)


@dataclass
class Instance:
    """A part at a place."""

    name: str
    part: Space
    #: Nodes, elements and sets of this instance alone.
    own: Space
    translation: npt.NDArray[np.float64]
    #: Axis from a to b and an angle in degrees, or None.
    rotation: npt.NDArray[np.float64] | None

    def placed(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Moves points of the part, then turns them around the axis."""
        points = points + self.translation
        if self.rotation is None:
            return points
        start, axis = self.rotation[:3], self.rotation[3:6] - self.rotation[:3]
        axis = axis / np.linalg.norm(axis)
        angle = np.radians(self.rotation[6])
        offset = points - start
        along = (offset @ axis)[:, None] * axis
        across = offset - along
        return start + along + np.cos(angle) * across + np.sin(angle) * np.cross(axis, offset)


@dataclass
class Scope:
    """A space in which numbers of nodes and elements are unique, where it stands in the result."""

    space: Space
    #: The part and what an instance adds.
    parts: list[Space]
    instance: Instance | None
    first_node: int = 0
    node_numbering: Numbering | None = None
    node_numbers: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    element_numbers: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    first_element: int = 0

    @property
    def name(self) -> str:
        return self.space.name

    def place(
        self,
        raw: Raw,
        points: list[npt.NDArray[np.float64]],
        places: list[tuple[int, Elements]],
        first_node: int,
        first_element: int,
    ) -> tuple[int, int]:
        """Adds nodes and elements to the result, and returns where the next ones begin."""
        self.first_node, self.first_element = first_node, first_element
        rows = [row for space in self.parts for row in space.nodes]
        numbers = np.concatenate([np.empty(0, np.int64), *(row[0] for row in rows)])
        positions = np.concatenate([np.empty((0, 3)), *(row[1] for row in rows)])
        numbers, positions = _without_repeats(numbers, positions, rows)
        if self.instance is not None:
            positions = self.instance.placed(positions)
        self.node_numbers = numbers
        self.node_numbering = Numbering(numbers, lambda node: f"node {node}")
        points.append(positions)
        found = [elements for space in self.parts for elements in space.elements]
        for elements in found:
            keyword, lines, own = elements.keyword, elements.lines, elements.numbers

            def where(row: int, keyword: Keyword = keyword, lines: Ints = lines, own: Ints = own) -> str:
                return f"{keyword.row_place(int(lines[row]))}: element {own[row]}"

            if not len(own):
                continue
            is_flat = KINDS[elements.kind].dimension < 3
            nodes = self._known_nodes(elements.nodes) if is_flat else elements.nodes
            index = self.node_numbering.indices(nodes, where)
            label = "" if KINDS[elements.kind].dimension == 3 else f"elements of type {elements.type}"
            raw.blocks.append(
                Block(elements.kind, index + first_node, slice(first_element, first_element + len(own)), label)
            )
            places.append((first_element, elements))
            first_element += len(own)
        self.element_numbers = np.concatenate([np.empty(0, np.int64), *(elements.numbers for elements in found)])
        _check_elements(self.element_numbers, found)
        return first_node + len(numbers), first_element

    def _known_nodes(self, nodes: Ints) -> Ints:
        """Replaces nodes that do not exist by one of the same element, or by any. Networks of CalculiX have nodes 0."""
        known = np.isin(nodes, self.node_numbers)
        if known.all() or not len(self.node_numbers):
            return nodes
        column: Ints = np.argmax(known, axis=1)
        first = np.take_along_axis(nodes, column.reshape(-1, 1), axis=1)
        first = np.where(np.any(known, axis=1, keepdims=True), first, self.node_numbers[0])
        return np.where(known, nodes, first)


def _without_repeats(
    numbers: Ints, positions: npt.NDArray[np.float64], rows: list[tuple[Ints, npt.NDArray[np.float64], Keyword]]
) -> tuple[Ints, npt.NDArray[np.float64]]:
    """Drops nodes that are defined again at the same place."""
    unique, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
    if len(unique) == len(numbers):
        return numbers, positions
    moved = np.flatnonzero((positions != positions[first[inverse.reshape(-1)]]).any(axis=1))
    if moved.size:
        row = int(moved[0])
        for found, _, keyword in rows:
            if row < len(found):
                raise FormatError(
                    f"{keyword.row_place(row)}: node {numbers[moved[0]]} is defined a second time, at another place; "
                    "number nodes anew"
                )
            row -= len(found)
    kept = np.sort(first)
    return numbers[kept], positions[kept]


def _check_elements(numbers: Ints, found: list[Elements]) -> None:
    order = np.argsort(numbers, kind="stable")
    twice = np.flatnonzero(np.diff(numbers[order]) == 0)
    if not twice.size:
        return
    row = int(order[twice + 1].min())
    number = numbers[row]
    for elements in found:
        if row < len(elements.numbers):
            raise FormatError(
                f"{elements.keyword.row_place(int(elements.lines[row]))}: element {number} is defined a second time; "
                "number elements anew"
            )
        row -= len(elements.numbers)
