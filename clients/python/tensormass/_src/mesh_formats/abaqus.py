"""Input files of Abaqus and CalculiX (.inp): nodes, elements and sets, in parts, instances and assemblies.

A part's sets keep their names. The set of one instance alone is INSTANCE.NAME, if there are several instances.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats import abaqus_elements
from tensormass._src.mesh_formats.abaqus_deck import Deck, Keyword
from tensormass._src.mesh_formats.abaqus_model import Elements, Instance, Scope, Space
from tensormass._src.mesh_formats.abaqus_resolve import resolved
from tensormass._src.mesh_formats.kinds import KINDS
from tensormass._src.mesh_formats.raw import FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import shown

# Keywords that make or move nodes and elements in ways that are not read.
_REFUSED = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "IMPORT", "PARAMETER", "SUBSTRUCTURE GENERATE"}
_FLATTEN = "write the file with plain *NODE and *ELEMENT (Abaqus: a flattened input file)"


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    reader = _Reader(path)
    for keyword in Deck(path).keywords():
        reader.take(keyword)
    return reader.raw()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._root = Space("")
        self._parts: dict[str, Space] = {}
        self._instances: dict[str, Instance] = {}
        self._part: Space | None = None
        self._instance: Instance | None = None
        self._has_assembly = False
        self._notes: list[str] = []
        self._surfaces: list[str] = []

    @property
    def _space(self) -> Space:
        if self._instance is not None:
            return self._instance.own
        return self._part or self._root

    def take(self, keyword: Keyword) -> None:
        """Takes one keyword. Those that say nothing of the mesh are passed over."""
        name, given = keyword.name, keyword.parameters
        if name in _REFUSED or (name == "SYSTEM" and keyword.has_data()):
            raise FormatError(f"{keyword.where} is not read; {_FLATTEN}")
        if name == "PART":
            part = self._named(keyword, "NAME")
            self._part = self._parts.setdefault(part.upper(), Space(part))
        elif name == "END PART":
            self._part = None
        elif name == "ASSEMBLY":
            self._has_assembly = True
        elif name == "INSTANCE":
            self._take_instance(keyword)
        elif name == "END INSTANCE":
            self._instance = None
        elif name == "NODE":
            self._take_nodes(keyword)
        elif name == "ELEMENT":
            self._take_elements(keyword)
        elif name == "NSET":
            self._space.sets.take(keyword, self._named(keyword, "NSET"), of_nodes=True)
        elif name == "ELSET":
            self._space.sets.take(keyword, self._named(keyword, "ELSET"), of_nodes=False)
        elif name == "SURFACE" and given.get("NAME"):
            self._surfaces.append(given["NAME"])

    def _named(self, keyword: Keyword, parameter: str) -> str:
        value = keyword.parameters.get(parameter, "")
        if not value:
            raise FormatError(f"{keyword.where} has no {parameter}=; give it a name")
        return value

    def _take_instance(self, keyword: Keyword) -> None:
        name, part = self._named(keyword, "NAME"), self._named(keyword, "PART")
        if part.upper() not in self._parts:
            known = ", ".join(space.name for space in self._parts.values()) or "none"
            raise FormatError(f"{keyword.where}: there is no part {shown(part)} before it; known: {known}")
        if name.upper() in self._instances:
            raise FormatError(f"{keyword.where}: a second instance {shown(name)}; rename one")
        rows = []
        for at, fields in keyword.fields():
            try:
                rows.append([float(word) if word else 0.0 for word in fields])
            except ValueError:
                raise FormatError(
                    f"{keyword.text.where(at)}: *INSTANCE: expected numbers, found {shown(','.join(fields))}"
                ) from None
        translation = np.array(([*rows[0], 0.0, 0.0, 0.0] if rows else [0.0] * 3)[:3])
        rotation = None
        if len(rows) > 1:
            rotation = np.array(rows[1])
            if rotation.shape != (7,) or not np.isfinite(rotation).all() or np.all(rotation[:3] == rotation[3:6]):
                raise FormatError(f"{keyword.where}: a rotation is two points of its axis and an angle, 7 numbers")
        self._instance = Instance(name, self._parts[part.upper()], Space(name), translation, rotation)
        self._instances[name.upper()] = self._instance

    def _take_nodes(self, keyword: Keyword) -> None:
        given = keyword.parameters
        if given.get("SYSTEM", "R").upper() not in ("R", ""):
            raise FormatError(f"{keyword.where}, SYSTEM={given['SYSTEM']} is not read; {_FLATTEN}")
        if keyword.has_empty_fields():
            rows = []
            for at, fields in keyword.fields():
                try:
                    row = [float(word) if word else 0.0 for word in fields[:4]]
                except ValueError:
                    raise FormatError(
                        f"{keyword.text.where(at)}: *NODE: expected `number, x, y, z`, found {shown(','.join(fields))}"
                    ) from None
                rows.append([*row, 0.0, 0.0, 0.0][:4])
            table = np.array(rows).reshape(-1, 4)
        else:
            flat, starts = keyword.numbers(np.float64)
            widths = np.diff(starts)
            table = np.zeros((len(widths), 4))
            for column in range(4):
                has = widths > column
                table[has, column] = flat[starts[:-1][has] + column]
        wrong = np.flatnonzero((table[:, 0] != np.round(table[:, 0])) | (np.abs(table[:, 0]) > 2**53))
        if wrong.size:
            raise FormatError(
                f"{keyword.row_place(int(wrong[0]))}: *NODE: {table[wrong[0], 0]:g} is not a number of a node"
            )
        numbers = table[:, 0].astype(np.int64)
        self._space.nodes.append((numbers, table[:, 1:], keyword))
        if given.get("NSET"):
            self._space.sets.add(given["NSET"], numbers, of_nodes=True)

    def _take_elements(self, keyword: Keyword) -> None:
        kind_name = self._named(keyword, "TYPE").upper()
        try:
            kind = abaqus_elements.solid(kind_name)
        except FormatError as error:
            raise FormatError(f"{keyword.where}: {error}") from None
        flat, starts = keyword.numbers(np.int32)
        if kind is None:
            self._take_flat(keyword, kind_name, flat, starts)
            return
        width = KINDS[kind].node_count + 1
        ends = np.arange(width, len(flat) + width, width)
        if len(flat) and (len(flat) % width or not np.isin(ends, starts).all()):
            # Elements end where lines end.
            element = int(np.flatnonzero(~np.isin(ends, starts))[0])
            line = int(np.searchsorted(starts, element * width))
            number = flat[element * width]
            raise FormatError(
                f"{keyword.row_place(line)}: element {number}: {kind_name} needs {width - 1} nodes, and its lines have "
                "another number of them"
            )
        table = flat.reshape(-1, width)
        lines = np.searchsorted(starts, np.arange(0, len(flat), width))
        self._add(Elements(kind_name, kind, table[:, 0], table[:, 1:], keyword, lines))

    def _take_flat(self, keyword: Keyword, kind_name: str, flat: Ints, starts: Ints) -> None:
        """Takes elements without a volume: of as many nodes as their name says, or one a line. Sets may name them."""
        count = abaqus_elements.flat_node_count(kind_name) + 1
        ends = np.arange(count, len(flat) + count, count)
        if count > 1 and len(flat) % count == 0 and np.isin(ends, starts).all():
            starts = np.arange(0, len(flat) + 1, count)
        widths = np.diff(starts)
        for width in np.unique(widths).tolist():
            lines = np.flatnonzero(widths == width)
            if width < 2:
                raise FormatError(f"{keyword.row_place(int(lines[0]))}: an element of type {kind_name} has no nodes")
            table = flat[starts[lines][:, None] + np.arange(width)]
            kind = abaqus_elements.flat(kind_name, width - 1)
            self._add(Elements(kind_name, kind, table[:, 0], table[:, 1:], keyword, lines))

    def _add(self, elements: Elements) -> None:
        self._space.elements.append(elements)
        if name := elements.keyword.parameters.get("ELSET"):
            self._space.sets.add(name, elements.numbers, of_nodes=False)

    # --- all together -------------------------------------------------------------------------------------------------

    def raw(self) -> Raw:
        """Puts the instances together."""
        raw = Raw(np.empty((0, 3)), [])
        raw.notes = self._notes
        places: list[tuple[int, Elements]] = []
        points: list[npt.NDArray[np.float64]] = [np.empty((0, 3))]
        used = {id(instance.part) for instance in self._instances.values()}
        scopes = [Scope(self._root, [self._root], None)]
        for instance in self._instances.values():
            scopes.append(Scope(instance.own, [instance.part, instance.own], instance))
        for part in self._parts.values():
            if id(part) in used:
                continue
            if self._has_assembly:
                count = sum(len(elements.numbers) for elements in part.elements)
                raw.notes.append(f"the part {part.name!r} of {count} elements has no *INSTANCE and is skipped")
            else:
                scopes.append(Scope(part, [part], None))
        first_node = first_element = 0
        for scope in scopes:
            first_node, first_element = scope.place(raw, points, places, first_node, first_element)
        raw.points = np.concatenate(points)
        begins = np.array([begin for begin, _ in places])

        def place(row: int) -> str:
            index = int(np.searchsorted(begins, row, side="right")) - 1
            begin, elements = places[index]
            at = row - begin
            return f"{elements.keyword.row_place(int(elements.lines[at]))}: element {elements.numbers[at]}"

        raw.place = place
        resolved(raw, scopes)
        if self._surfaces:
            names = ", ".join(map(repr, self._surfaces[:5]))
            raw.notes.append(f"{len(self._surfaces)} surfaces (*SURFACE) are skipped: {names}")
        if not len(raw.points):
            raise FormatError(f"{self._path}: has no *NODE with nodes; is it an input file of Abaqus or CalculiX?")
        return raw
