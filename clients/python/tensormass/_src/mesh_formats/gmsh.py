"""Gmsh (.msh): formats 1, 2.2, 4.0 and 4.1, text and binary.

Physical groups with names are sets. An element that is written once for each of its groups is one element.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.finish import sets_from_data
from tensormass._src.mesh_formats.gmsh_parts import Cells, Cursor, Groups, Nodes
from tensormass._src.mesh_formats.kinds import ELEMENT_FIELDS, FIELD_ALIASES, SET_PREFIX
from tensormass._src.mesh_formats.raw import FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import Text, shown

_VERSIONS = ("2", "2.0", "2.1", "2.2", "4", "4.0", "4.1")
_NAME = re.compile(rb'\s*(\d+)\s+(-?\d+)\s+"([^"\n]*)"')
# Numbers of one node or element in its data.
_MAX_WIDTH = 1000
# A section that is not read ends with `$End...`; those with bytes in them are read by their counts.
_SKIPPED = {"Comments", "Periodic", "Parametrizations", "InterpolationScheme", "GhostElements"}


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._cursor = Cursor(Text(path))
        self._version = ""
        self._groups = Groups()
        self._nodes: Nodes | None = None
        self._cells: Cells | None = None
        #: Data of nodes and of elements: numbers and values.
        self._data: dict[tuple[str, str], tuple[Ints, npt.NDArray[np.float64]]] = {}

    def read(self) -> Raw:
        text = self._cursor.text
        while (line := text.full_line()) is not None:
            if not line.startswith(b"$"):
                raise FormatError(f"{text.where(text.at - 1)}: expected a section ($...), found {shown(line)}")
            self._section(line[1:].decode("ascii", "replace").strip(), text.at)
        if self._nodes is None or self._cells is None:
            names = ("NOD", "ELM") if self._version == "1" else ("Nodes", "Elements")
            name = names[0] if self._nodes is None else names[1]
            raise FormatError(f"{text.path}: section ${name} is missing; the file is cut off, or holds no mesh")
        return self._raw(self._nodes, self._cells)

    def _section(self, name: str, at: int) -> None:
        text, cursor = self._cursor.text, self._cursor
        if name == "MeshFormat":
            self._format()
        elif name == "NOD":
            self._version = "1"
            self._nodes = cursor.nodes_of_rows("NOD")
            return
        elif name == "ELM":
            self._cells = cursor.elements_of_rows("ELM", is_first=True)
            return
        elif name in _SKIPPED or not self._version:
            pass
        elif name == "PhysicalNames":
            self._names()
        elif name in ("Entities", "PartitionedEntities"):
            cursor.entities(self._version, self._groups, partitioned=name != "Entities")
        elif name == "Nodes":
            old = self._version.startswith("2")
            if old and not cursor.binary:
                self._nodes = cursor.nodes_of_rows(name)
                return
            self._nodes = cursor.nodes_22() if old else cursor.nodes_4(self._version)
        elif name == "Elements":
            old = self._version.startswith("2")
            if old and not cursor.binary:
                self._cells = cursor.elements_of_rows(name, is_first=False)
                return
            self._cells = cursor.elements_22() if old else cursor.elements_4(self._version, self._groups)
        elif name in ("NodeData", "ElementData", "ElementNodeData"):
            self._values(name)
        # The end of a section is searched for, so that what follows its content may be anything.
        end = text.data.find(b"$End" + name.encode(), text.at)
        if end < 0:
            raise FormatError(f"{text.where(at - 1)}: section ${name} has no $End{name}; the file is cut off")
        text.at = end
        text.line()

    def _format(self) -> None:
        text, cursor = self._cursor.text, self._cursor
        words = (text.line() or b"").split()
        version = words[0].decode("ascii", "replace") if words else ""
        if version not in _VERSIONS:
            raise FormatError(
                f"{text.where(text.at - 1)}: MeshFormat version {shown(version)} is not read; save as 2.2 or 4.1"
            )
        self._version = {"4": "4.0", "4.0": "4.0", "4.1": "4.1"}.get(version, "2.2")
        cursor.binary = len(words) > 1 and words[1] == b"1"
        if len(words) > 2 and words[2] not in (b"8", b"4"):
            raise FormatError(f"{text.where(text.at - 1)}: MeshFormat data size {shown(words[2])} is not 8")
        cursor.size = 4 if len(words) > 2 and words[2] == b"4" and self._version == "4.1" else 8
        if cursor.binary:
            one = text.data[text.at : text.at + 4]
            text.at += 4
            if one not in (b"\1\0\0\0", b"\0\0\0\1"):
                raise FormatError(f"{text.where()}: MeshFormat: the order of bytes is not told; the file is damaged")
            cursor.order = "<" if one[0] else ">"

    def _names(self) -> None:
        text = self._cursor.text
        count = text.integer("PhysicalNames")
        text.line()
        for _ in range(count):
            line = text.line()
            match = None if line is None else _NAME.match(line)
            if match is None:
                raise FormatError(
                    f'{text.where(text.at - 1)}: expected `dimension tag "name"`, found {shown(line or b"")}'
                )
            self._groups.names[int(match[1]), int(match[2])] = match[3].decode("utf-8", "replace")

    def _values(self, section: str) -> None:
        """Reads data with the name of a set or an element field."""
        text, cursor = self._cursor.text, self._cursor
        strings = text.integer(section)
        text.line()
        found = [(text.line() or b"").strip(b'"').decode("utf-8", "replace") for _ in range(min(strings, 1000))]
        name = found[0] if found else ""
        text.numbers(text.integer(section), np.float64, section)
        tags = text.numbers(text.integer(section), np.int64, section)
        text.line()
        if len(tags) < 3:
            raise FormatError(f"{text.where()}: {section} has {len(tags)} numbers about its size, not 3")
        wanted = name.startswith(SET_PREFIX) or FIELD_ALIASES.get(name, name) in ELEMENT_FIELDS
        if not wanted or section == "ElementNodeData":
            return
        width, count = int(tags[1]), int(tags[2])
        if not 1 <= width <= _MAX_WIDTH or count < 0:
            raise FormatError(f"{text.where()}: {section} {name!r} has {count} rows of {width} numbers")
        if cursor.binary:
            rows = cursor.records(count, [("tag", "i4"), ("values", "f8", (width,))], f"{section} {name!r}")
            numbers, values = rows["tag"].astype(np.int64), rows["values"]
        else:
            flat = text.numbers(count * (width + 1), np.float64, f"{section} {name!r}").reshape(count, width + 1)
            numbers, values = flat[:, 0].astype(np.int64), flat[:, 1:]
        self._data[section, name] = numbers, values

    def _raw(self, nodes: Nodes, cells: Cells) -> Raw:
        where = str(self._cursor.text.path)
        numbering = nodes.numbering()
        raw = Raw(nodes.points, [], place=cells.place, repeats_elements=True)
        for block in cells.blocks:
            rows = block.rows
            assert not isinstance(rows, slice)
            block.nodes = numbering.indices(block.nodes, lambda row, rows=rows: cells.place(int(rows[row])))  # type: ignore[misc]
            raw.blocks.append(block)
        self._groups.add_sets(raw, cells)
        point_data: dict[str, npt.NDArray[Any]] = {}
        for (section, name), (numbers, values) in self._data.items():
            if section == "NodeData":
                index = numbering.indices(numbers.reshape(-1, 1), lambda row, name=name: f"{where}: data {name!r}")  # type: ignore[misc]
                point_data[name] = np.zeros(len(nodes.points))
                point_data[name][index.reshape(-1)] = values[:, 0]
            else:
                raw.cell_data[name] = cells.rows_of(numbers, values, f"{where}: data {name!r}")
        sets_from_data(raw, point_data)
        return raw
