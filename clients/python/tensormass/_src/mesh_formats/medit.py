"""Medit (.mesh, .meshb): versions 1 to 4, as text in any layout, and binary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.kinds import KINDS
from tensormass._src.mesh_formats.middles import in_vtk_order
from tensormass._src.mesh_formats.raw import Block, FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import Text, shown

_CELLS = {
    "Edges": "line",
    "Triangles": "triangle",
    "Quadrilaterals": "quad",
    "Tetrahedra": "tetra",
    "Prisms": "wedge",
    "Pentahedra": "wedge",
    "Hexahedra": "hexahedron",
    "Pyramids": "pyramid",
    "EdgesP2": "line3",
    "TrianglesP2": "triangle6",
    "TetrahedraP2": "tetra10",
    "HexahedraQ2": "hexahedron27",
}
# Integers a row of lists that mark other entries.
_MARKS = {
    "Corners": 1,
    "Ridges": 1,
    "RequiredVertices": 1,
    "RequiredEdges": 1,
    "RequiredTriangles": 1,
    "RequiredQuadrilaterals": 1,
    "RequiredTetrahedra": 1,
    "NormalAtVertices": 2,
    "TangentAtVertices": 2,
    "NormalAtTriangleVertices": 3,
    "NormalAtQuadrilateralVertices": 3,
    "TangentAtEdges": 3,
}
_VECTORS = {"Normals", "Tangents"}
# Numbers of keywords in binary files.
_BINARY = {3: "Dimension", 4: "Vertices", 5: "Edges", 6: "Triangles", 7: "Quadrilaterals", 8: "Tetrahedra", 9: "Prisms"}
_BINARY |= {10: "Hexahedra", 49: "Pyramids", 54: "End"}
_VERSIONS = (1, 2, 3, 4)


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    text = Text(path, comment=b"#")
    found = _Found(str(path))
    if text.data[:4] in (b"\1\0\0\0", b"\0\0\0\1"):
        _read_binary(text, found)
    else:
        _read_text(text, found)
    return found.raw()


class _Found:
    def __init__(self, where: str) -> None:
        self._where = where
        self.points: npt.NDArray[np.floating] | None = None
        self._cells: list[tuple[str, Ints, int]] = []
        self.notes: list[str] = []
        self.text: Text | None = None

    def add_vertices(self, rows: npt.NDArray[np.floating]) -> None:
        self.points = rows[:, :3] if self.points is None else np.concatenate([self.points, rows[:, :3]])

    def add_cells(self, name: str, rows: Ints, at: int) -> None:
        self._cells.append((name, rows, at))

    def raw(self) -> Raw:
        if self.points is None:
            raise FormatError(f"{self._where}: has no Vertices; it is cut off, or holds no mesh")
        raw = Raw(self.points, [])
        begins, first = [], 0
        references: set[int] = set()
        for name, rows, at in self._cells:
            kind = _CELLS[name]
            nodes = rows[:, :-1] - 1
            if kind == "tetra10":
                nodes = in_vtk_order(self.points, nodes, f"{self._where}: {name}")
            if KINDS[kind].dimension == 3:
                references |= set(np.unique(rows[:, -1]).tolist())
            raw.blocks.append(Block(kind, nodes, slice(first, first + len(rows))))
            begins.append((first, at, name))
            first += len(rows)

        def place(row: int) -> str:
            begin, at, name = [begin for begin in begins if begin[0] <= row][-1]
            where = self._where if self.text is None else self.text.row_place(at, row - begin)
            return f"{where}: element {row - begin + 1} of {name}"

        raw.place = place
        raw.notes = self.notes
        if len(references) > 1:
            raw.notes.append(
                f"{len(references)} references of elements ({_few(references)}) have no name and make no sets"
            )
        return raw


def _few(numbers: set[int]) -> str:
    first = ", ".join(map(str, sorted(numbers)[:5]))
    return first + (", ..." if len(numbers) > 5 else "")


def _read_text(text: Text, found: _Found) -> None:
    found.text = text
    word = text.word()
    if word != b"MeshVersionFormatted":
        raise FormatError(f"{text.where()}: expected MeshVersionFormatted, found {shown(word)}")
    version = text.integer("MeshVersionFormatted")
    if version not in _VERSIONS:
        raise FormatError(f"{text.where()}: MeshVersionFormatted {version} is not read; save as version 2")
    dimension = 3
    while (word := text.word()) and word != b"End":
        name = word.decode("ascii", "replace")
        if name == "Dimension":
            dimension = text.integer(name)
            if dimension != 3:
                raise FormatError(f"{text.where()}: Dimension {dimension}; a volume needs 3")
        elif name == "Vertices":
            count = text.integer(name)
            found.add_vertices(text.numbers(count * 4, np.float64, name).reshape(count, 4))
        elif name in _CELLS:
            count, width = text.integer(name), KINDS[_CELLS[name]].node_count + 1
            at = text.at
            found.add_cells(name, text.numbers(count * width, np.int32, name).reshape(count, width), at)
        elif name in _MARKS:
            text.numbers(text.integer(name) * _MARKS[name], np.int64, name)
        elif name in _VECTORS:
            text.numbers(text.integer(name) * 3, np.float64, name)
        else:
            _skip(text, name, found)


def _skip(text: Text, name: str, found: _Found) -> None:
    """Goes past a section that is not known, up to the next word with letters."""
    if not name[:1].isalpha():
        raise FormatError(f"{text.where()}: expected a keyword, found {shown(name)}; a count is wrong")
    count = text.integer(name)
    if count and any(kind in name for kind in ("Tetra", "Hexa", "Prism", "Penta", "Pyramid", "Polyhedra")):
        raise FormatError(f"{text.where()}: {count} {name} are not read; save linear elements, or TetrahedraP2")
    while word := text.word():
        if word[:1].isalpha():
            text.at -= len(word)
            break
    found.notes.append(f"the section {name} of {count} entries is skipped")


def _read_binary(text: Text, found: _Found) -> None:
    order = "<" if text.data[0] else ">"
    at = 4

    def integers(count: int, size: int) -> list[int]:
        nonlocal at
        piece = text.data[at : at + count * size]
        if len(piece) < count * size:
            raise FormatError(f"{text.path}: the file ends within a keyword; it is cut off")
        at += count * size
        return [int(value) for value in np.frombuffer(piece, f"{order}i{size}")]

    (version,) = integers(1, 4)
    if version not in _VERSIONS:
        raise FormatError(f"{text.path}: MeshVersionFormatted {version} is not read; save as version 2")
    whole, real, step = (8 if version == 4 else 4), (4 if version == 1 else 8), (8 if version >= 3 else 4)
    while at < len(text.data):
        keyword, following = integers(1, 4)[0], integers(1, step)[0]
        name = _BINARY.get(keyword, "")
        if name == "End":
            return
        if name == "Dimension":
            (dimension,) = integers(1, 4)
            if dimension != 3:
                raise FormatError(f"{text.path}: Dimension {dimension}; a volume needs 3")
        elif name == "Vertices":
            (count,) = integers(1, whole)
            dtype = np.dtype([("at", f"{order}f{real}", (3,)), ("reference", f"{order}i{whole}")])
            rows = _records(text, at, count, dtype, name)
            found.add_vertices(rows["at"].astype(np.float64))
        elif name:
            (count,) = integers(1, whole)
            width = KINDS[_CELLS[name]].node_count + 1
            dtype = np.dtype([("all", f"{order}i{whole}", (width,))])
            found.add_cells(name, _records(text, at, count, dtype, name)["all"].astype(np.int32), at)
        else:
            found.notes.append(f"the section with the number {keyword} is skipped")
        if following <= at - 4 or following > len(text.data):
            if following == 0:
                return
            raise FormatError(f"{text.path}: the section {name or keyword} names a wrong end; the file is damaged")
        at = following


def _records(text: Text, at: int, count: int, dtype: np.dtype[np.void], name: str) -> npt.NDArray[np.void]:
    text.at = at
    return text.view(count, dtype, name)
