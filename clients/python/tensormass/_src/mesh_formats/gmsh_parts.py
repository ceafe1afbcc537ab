"""Parts of Gmsh's files: nodes, elements, entities and physical groups, in each version, as text and binary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.kinds import GMSH, GMSH_ORDER, KINDS
from tensormass._src.mesh_formats.numbering import Numbering
from tensormass._src.mesh_formats.raw import Block, Floats, FormatError, Ints, Raw, gathered
from tensormass._src.mesh_formats.text import Text, shown

# Tags of one element: groups, entities and partitions.
_MAX_TAGS = 10_000
_DIMENSIONS = ("point", "curve", "surface", "volume")


@dataclass
class Nodes:
    """Nodes in the file's order."""

    numbers: Ints
    points: Floats
    #: Returns the place of a node with an index.
    place: Callable[[int], str]

    def numbering(self) -> Numbering:
        return Numbering(self.numbers, self.place)


@dataclass
class Cells:
    """Elements in the file's order. `tags` has a row for each: physical group (0: none) and entity."""

    numbers: Ints
    tags: Ints
    dimensions: Ints
    blocks: list[Block]
    #: Returns the place of the element with an index.
    place: Callable[[int], str]

    def rows_of(self, numbers: Ints, values: Floats, where: str) -> Floats:
        """Returns values in the order of the file's elements; elements without a value have none (nan)."""
        order = np.argsort(self.numbers, kind="stable")
        sorted_numbers = self.numbers[order]
        at = np.minimum(np.searchsorted(sorted_numbers, numbers), max(len(order) - 1, 0))
        if not len(order) or (sorted_numbers[at] != numbers).any():
            raise FormatError(f"{where} is given for elements that do not exist; the file is damaged")
        out = np.full((len(order), values.shape[1]), np.nan)
        out[order[at]] = values
        return out


@dataclass
class Groups:
    """Physical groups, by the dimension and the tag of their entities."""

    #: (dimension, tag of a group): its name.
    names: dict[tuple[int, int], str] = field(default_factory=dict)
    #: (dimension, tag of an entity): tags of its groups, in format 4.
    entities: dict[tuple[int, int], list[int]] = field(default_factory=dict)

    def add_sets(self, raw: Raw, cells: Cells) -> None:
        """Adds the named groups as sets, and a note for groups without a name."""
        members: dict[tuple[int, int], list[Ints]] = {}
        if self.entities:
            keys = cells.dimensions.astype(np.int64) * (1 << 40) + cells.tags[:, 1]
            for key in np.unique(keys).tolist():
                dimension, entity = key >> 40, key & ((1 << 40) - 1)
                entity = entity - (1 << 40) if entity >= 1 << 39 else entity
                groups = self.entities.get((dimension, entity), [])
                if groups:
                    rows = np.flatnonzero(keys == key)
                    for tag in groups:
                        members.setdefault((dimension, abs(tag)), []).append(rows)
        else:
            tags = np.abs(cells.tags[:, 0])
            for dimension in range(4):
                of = cells.dimensions == dimension
                for tag in np.unique(tags[of]).tolist():
                    if tag:
                        members[dimension, tag] = [np.flatnonzero(of & (tags == tag))]
        unnamed = []
        for (dimension, tag), parts in sorted(members.items()):
            rows = np.concatenate(parts)
            name = self.names.get((dimension, tag))
            if name is None:
                # One group of all elements tells nothing.
                if dimension < 3 or len(rows) < np.count_nonzero(cells.dimensions == 3):
                    unnamed.append(f"{_DIMENSIONS[dimension]} {tag} of {len(rows)} elements")
            else:
                # One name for groups of two dimensions is one set.
                raw.cell_sets[name] = np.concatenate([raw.cell_sets.get(name, np.empty(0, np.int64)), rows])
        for key, name in self.names.items():
            if key not in members and name not in raw.cell_sets:
                raw.cell_sets.setdefault(name, np.empty(0, np.int64))
        if unnamed:
            shown_groups = ", ".join(unnamed[:5]) + (" ..." if len(unnamed) > 5 else "")
            raw.notes.append(f"physical groups without a name make no sets ({len(unnamed)}: {shown_groups})")


def element_count(kind: int, where: str) -> int:
    """Returns the nodes of an element of Gmsh's type `kind`."""
    if kind not in GMSH:
        raise FormatError(f"{where} has Gmsh's type {kind}, which is not read; mesh with elements of order 1 or 2")
    return KINDS[GMSH[kind]].node_count


class Cursor:
    """Reads sections at the place of a text."""

    def __init__(self, text: Text) -> None:
        self.text = text
        self.binary = False
        self.order = "<"
        #: Bytes of a size_t in binary files.
        self.size = 8

    # --- rows of text: formats 1 and 2.2 ------------------------------------------------------------------------------

    def nodes_of_rows(self, section: str) -> Nodes:
        """Reads `id x y z` a line, until the end of the section."""
        first, end, count = self._span(section)
        flat, starts = self.text.rows(end, np.float64, f"${section}")
        self._check_rows(section, count, len(starts) - 1, first)
        wrong = np.flatnonzero(np.diff(starts) != 4)
        if wrong.size:
            raise FormatError(
                f"{self._row(first, int(wrong[0]))}: expected `id x y z`, found {self._found(first, int(wrong[0]))}"
            )
        rows = flat.reshape(-1, 4)
        self.text.line()
        numbers = self._whole(rows[:, 0], first)
        return Nodes(numbers, rows[:, 1:], lambda node: self._row(first, node))

    def elements_of_rows(self, section: str, *, is_first: bool) -> Cells:
        """Reads elements a line: `id type physical entity count nodes` (format 1) or `id type n tags nodes`."""
        first, end, count = self._span(section)
        flat, starts = self.text.rows(end, np.int32, f"${section}: integers `id type ...`")
        self._check_rows(section, count, len(starts) - 1, first)
        self.text.line()
        sizes = np.diff(starts)

        def place(row: int) -> str:
            number = flat[starts[row]] if row < len(starts) - 1 else row
            return f"{self._row(first, row)}: element {number}"

        heads = 5 if is_first else 3
        short = np.flatnonzero(sizes < heads)
        if short.size:
            raise FormatError(f"{place(int(short[0]))} has {sizes[short[0]]} numbers; the line is cut off")
        begin = starts[:-1]
        kinds = flat[begin + 1]
        tag_counts = np.full(len(kinds), 2) if is_first else flat[begin + 2]
        node_counts = np.zeros(len(kinds), np.int64)
        for kind in np.unique(kinds).tolist():
            row = int(np.flatnonzero(kinds == kind)[0])
            node_counts[kinds == kind] = element_count(kind, place(row))
        expected = node_counts + (5 if is_first else 3 + tag_counts)
        announced = flat[begin + 4] if is_first else node_counts
        listed = sizes - (5 if is_first else 3 + tag_counts)
        wrong = np.flatnonzero((announced != listed) | (sizes != expected) | (tag_counts < 0))
        if wrong.size:
            row = int(wrong[0])
            raise FormatError(
                f"{place(row)} announces {announced[row]} nodes and lists {listed[row]}; its type {kinds[row]} has "
                f"{node_counts[row]}"
            )
        tags = np.zeros((len(kinds), 2), np.int32)
        at = begin + (2 if is_first else 3)
        for column in range(2):
            has = tag_counts > column
            tags[has, column] = flat[at[has] + column]
        blocks = []
        for kind, rows in _grouped(kinds * 1000 + np.minimum(tag_counts, 999)):
            name = GMSH[kind // 1000]
            count = KINDS[name].node_count
            blocks.append(_block(name, gathered(flat, starts[rows + 1] - count, count), rows))
        return Cells(flat[begin], tags, _dimensions(kinds), blocks, place)

    def _span(self, section: str) -> tuple[int, int, int]:
        """Returns the places of the first row and of the section's end, and the number of rows."""
        text = self.text
        at = text.at
        line = text.line() or b""
        try:
            count = int(line)
        except ValueError:
            raise FormatError(
                f"{text.where(at)}: section ${section}: expected a number of rows, found {shown(line)}"
            ) from None
        mark = b"$END" + section.encode() if section in ("NOD", "ELM") else b"$End" + section.encode()
        end = text.data.find(mark, text.at)
        if end < 0:
            raise FormatError(f"{text.where(at)}: section ${section} has no {mark.decode()}; the file is cut off")
        return text.at, end, count

    def _check_rows(self, section: str, count: int, found: int, first: int) -> None:
        if count != found:
            raise FormatError(
                f"{self.text.where(first - 1)}: section ${section} announces {count} rows, and {found} are before its "
                "end; the file is cut off or damaged"
            )

    def _row(self, first: int, row: int) -> str:
        return self.text.row_place(first, row)

    def _found(self, first: int, row: int) -> str:
        at = self.text.at
        self.text.at = first
        line = b""
        for _ in range(row + 1):
            line = self.text.full_line() or b""
        self.text.at = at
        return shown(line)

    def _whole(self, values: Floats, first: int) -> Ints:
        wrong = np.flatnonzero(values != np.round(values))
        if wrong.size or (len(values) and np.abs(values).max() > 2**53):
            row = int(wrong[0]) if wrong.size else int(np.abs(values).argmax())
            raise FormatError(f"{self._row(first, row)}: {values[row]:g} is not a number of a node")
        return values.astype(np.int64)

    # --- binary 2.2 ---------------------------------------------------------------------------------------------------

    def records(
        self, count: int, fields: list[tuple[str, str] | tuple[str, str, tuple[int]]], what: str
    ) -> npt.NDArray[np.void]:
        """Reads binary records of named fields."""
        dtype = np.dtype([(field[0], self.order + field[1], *field[2:]) for field in fields])
        return self.text.view(count, dtype, what)

    def nodes_22(self) -> Nodes:
        text = self.text
        count = text.integer("$Nodes")
        text.line()
        rows = self.records(count, [("number", "i4"), ("at", "f8", (3,))], "$Nodes")
        return Nodes(
            rows["number"].astype(np.int64), rows["at"].astype(np.float64), lambda node: f"{text.path}: $Nodes"
        )

    def elements_22(self) -> Cells:
        text = self.text
        count = text.integer("$Elements")
        text.line()
        parts = _Parts(str(text.path))
        while parts.count < count:
            head = self.records(1, [("kind", "i4"), ("rows", "i4"), ("tags", "i4")], "$Elements")[0]
            kind, rows, tag_count = int(head["kind"]), int(head["rows"]), int(head["tags"])
            nodes = element_count(kind, f"{text.path}: element {parts.count}")
            if rows < 1 or tag_count < 0 or rows > count - parts.count or tag_count > _MAX_TAGS:
                raise FormatError(
                    f"{text.path}: $Elements: a part of {rows} elements and {tag_count} tags; it is damaged"
                )
            found = self.records(rows, [("all", "i4", (1 + tag_count + nodes,))], "$Elements")["all"]
            found = found.astype(np.int32, copy=False)
            tags = np.zeros((rows, 2), np.int32)
            width = min(tag_count, 2)
            tags[:, :width] = found[:, 1 : 1 + width]
            parts.add(kind, found[:, 0], tags, found[:, 1 + tag_count :])
        return parts.cells()

    # --- format 4 -----------------------------------------------------------------------------------------------------

    def _integers(self, count: int, dtype: str, what: str) -> list[int]:
        if self.binary:
            return [int(value) for value in self.records(count, [("value", dtype)], what)["value"]]
        small = dtype == "i4"
        return [int(value) for value in self.text.numbers(count, np.int32 if small else np.int64, what)]

    def _skip_numbers(self, count: int, what: str) -> None:
        if self.binary:
            self.records(count, [("value", "f8")], what)
        else:
            self.text.numbers(count, np.float64, what)

    @property
    def _size_type(self) -> str:
        return f"u{self.size}"

    def entities(self, version: str, groups: Groups, *, partitioned: bool) -> None:
        """Reads the physical groups of each entity."""
        size = self._size_type if version == "4.1" else "u8"
        what = "$PartitionedEntities" if partitioned else "$Entities"
        if partitioned:
            self._integers(1, size, what)
            (ghosts,) = self._integers(1, size, what)
            self._integers(2 * ghosts, "i4", what)
        counts = self._integers(4, size, what)
        for dimension, count in enumerate(counts):
            if count > len(self.text.data):
                raise FormatError(f"{self.text.where()}: {what} announces {count} entities; the file is damaged")
            for _ in range(count):
                (tag,) = self._integers(1, "i4", what)
                if partitioned:
                    self._integers(2, "i4", what)
                    (partitions,) = self._integers(1, size, what)
                    self._integers(partitions, "i4", what)
                box = 3 if dimension == 0 and version == "4.1" else 6
                self._skip_numbers(box, what)
                (own,) = self._integers(1, size, what)
                groups.entities[dimension, tag] = self._integers(own, "i4", what)
                if dimension > 0:
                    (bounds,) = self._integers(1, size, what)
                    self._integers(bounds, "i4", what)

    def nodes_4(self, version: str) -> Nodes:
        text, new = self.text, version == "4.1"
        size = self._size_type if new else "u8"
        blocks, count = self._integers(2, size, "$Nodes")
        if new:
            self._integers(2, size, "$Nodes")
        if not 0 <= count <= len(text.data) or blocks > len(text.data):
            raise FormatError(f"{text.where()}: $Nodes announces {count} nodes; the file is cut off or damaged")
        numbers, points = np.empty(count, np.int64), np.empty((count, 3))
        done = 0
        for _ in range(blocks):
            first, second, parametric = self._integers(3, "i4", "$Nodes")
            dimension = first if new else second
            (rows,) = self._integers(1, size, "$Nodes")
            if not 0 <= dimension <= 3 or rows > count - done:
                raise FormatError(
                    f"{text.where()}: $Nodes: a block of dimension {dimension} with {rows} nodes is damaged"
                )
            width = 3 + (dimension if parametric else 0)
            numbers[done : done + rows], points[done : done + rows] = self._block_of_nodes(rows, width, new, size)
            done += rows
        if done != count:
            raise FormatError(f"{text.where()}: $Nodes announces {count} nodes, and its blocks have {done}")
        return Nodes(numbers, points, lambda node: f"{text.path}: $Nodes")

    def _block_of_nodes(self, rows: int, width: int, new: bool, size: str) -> tuple[Ints, Floats]:
        if new:
            if self.binary:
                tags = self.records(rows, [("value", size)], "$Nodes")["value"].astype(np.int64)
                found = self.records(rows, [("at", "f8", (width,))], "$Nodes")["at"]
            else:
                tags = self.text.numbers(rows, np.int64, "$Nodes")
                found = self.text.numbers(rows * width, np.float64, "$Nodes").reshape(rows, width)
            return tags, found[:, :3]
        if self.binary:
            record = self.records(rows, [("number", "i4"), ("at", "f8", (width,))], "$Nodes")
            return record["number"].astype(np.int64), record["at"][:, :3]
        at = self.text.at
        flat = self.text.numbers(rows * (1 + width), np.float64, "$Nodes").reshape(rows, 1 + width)
        return self._whole(flat[:, 0], at), flat[:, 1:4]

    def elements_4(self, version: str, groups: Groups) -> Cells:
        text, new = self.text, version == "4.1"
        size = self._size_type if new else "u8"
        blocks, count = self._integers(2, size, "$Elements")
        if new:
            self._integers(2, size, "$Elements")
        parts = _Parts(str(text.path))
        for _ in range(min(blocks, len(text.data) + 1)):
            first, second, kind = self._integers(3, "i4", "$Elements")
            (rows,) = self._integers(1, size, "$Elements")
            entity, dimension = (second, first) if new else (first, second)
            at = text.at
            nodes = element_count(kind, f"{text.where()}: element {parts.count}")
            if rows > count - parts.count:
                raise FormatError(f"{text.where()}: $Elements: a block of {rows} elements is more than are announced")
            if self.binary:
                dtype = size if new else "i4"
                found = self.records(rows, [("all", dtype, (1 + nodes,))], "$Elements")["all"]
                if found.size and int(found.max()) > np.iinfo(np.int32).max:
                    raise FormatError(f"{text.path}: $Elements: the number {found.max()} is too large; number anew")
                found = found.astype(np.int32)
            else:
                found = text.numbers(rows * (1 + nodes), np.int32, "$Elements").reshape(rows, 1 + nodes)
            if dimension != KINDS[GMSH[kind]].dimension:
                raise FormatError(f"{text.where(at)}: $Elements: {GMSH[kind]} in an entity of dimension {dimension}")
            tags = np.zeros((rows, 2), np.int32)
            tags[:, 1] = entity
            parts.add(kind, found[:, 0], tags, found[:, 1:], None if self.binary else at)
        if parts.count != count:
            raise FormatError(
                f"{text.where()}: $Elements announces {count} elements, and its blocks have {parts.count}"
            )
        groups.entities.setdefault((-1, 0), [])  # groups are those of entities, even if none has any
        return parts.cells(text)


class _Parts:
    """Gathers parts of elements of one type each."""

    def __init__(self, path: str) -> None:
        self._path = path
        self.count = 0
        self._numbers: list[Ints] = [np.empty(0, np.int32)]
        self._tags: list[Ints] = [np.empty((0, 2), np.int32)]
        self._kinds: list[Ints] = [np.empty(0, np.int16)]
        #: [kind]: nodes and rows of its parts.
        self._by_kind: dict[int, list[tuple[Ints, Ints]]] = {}
        #: First element of a part, and where its text begins.
        self._begins: list[tuple[int, int]] = []

    def add(self, kind: int, numbers: Ints, tags: Ints, nodes: Ints, at: int | None = None) -> None:
        rows = np.arange(self.count, self.count + len(numbers))
        if at is not None:
            self._begins.append((self.count, at))
        self._numbers.append(numbers)
        self._tags.append(tags)
        self._kinds.append(np.full(len(numbers), kind, np.int16))
        self._by_kind.setdefault(kind, []).append((nodes, rows))
        self.count += len(numbers)

    def cells(self, text: Text | None = None) -> Cells:
        blocks = [
            _block(GMSH[kind], _joined([part[0] for part in parts]), _joined([part[1] for part in parts]))
            for kind, parts in self._by_kind.items()
        ]
        numbers = np.concatenate(self._numbers)

        def place(row: int) -> str:
            where = self._path
            begins = [begin for begin in self._begins if begin[0] <= row]
            if text is not None and begins:
                where = text.row_place(begins[-1][1], row - begins[-1][0])
            return f"{where}: element {numbers[row]}"

        return Cells(numbers, np.concatenate(self._tags), _dimensions(np.concatenate(self._kinds)), blocks, place)


def _joined(parts: list[Ints]) -> Ints:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _dimensions(kinds: Ints) -> Ints:
    table = np.zeros(max(GMSH) + 1, np.int8)
    for kind, name in GMSH.items():
        table[kind] = KINDS[name].dimension
    return table[kinds]


def _grouped(keys: Ints) -> list[tuple[int, Ints]]:
    """Returns rows by key, keys in the order in which they come first."""
    _, first = np.unique(keys, return_index=True)
    return [(int(keys[row]), np.flatnonzero(keys == keys[row])) for row in sorted(first.tolist())]


def _block(kind: str, nodes: Ints, rows: Ints) -> Block:
    if kind in GMSH_ORDER:
        nodes = nodes[:, list(GMSH_ORDER[kind])]
    return Block(kind, nodes, rows)
