"""Legacy VTK (.vtk): unstructured grids, polydata, and structured and rectilinear grids; text and binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.finish import sets_from_data
from tensormass._src.mesh_formats.kinds import ELEMENT_FIELDS, FIELD_ALIASES, SET_PREFIX
from tensormass._src.mesh_formats.raw import FormatError, Raw
from tensormass._src.mesh_formats.text import Text, shown
from tensormass._src.mesh_formats.vtk_cells import blocks_of, grid_hexahedra, polygons

_TYPES = {
    "bit": "u1",
    "char": "i1",
    "signed_char": "i1",
    "unsigned_char": "u1",
    "short": "i2",
    "unsigned_short": "u2",
    "int": "i4",
    "unsigned_int": "u4",
    "long": "i8",
    "unsigned_long": "u8",
    "long_long": "i8",
    "unsigned_long_long": "u8",
    "vtkidtype": "i4",  # VTK writes its own indices as int
    "vtktypeint8": "i1",
    "vtktypeuint8": "u1",
    "vtktypeint16": "i2",
    "vtktypeuint16": "u2",
    "vtktypeint32": "i4",
    "vtktypeuint32": "u4",
    "vtktypeint64": "i8",
    "vtktypeuint64": "u8",
    "float": "f4",
    "double": "f8",
}
# Points along an axis of an image.
_MAX_AXIS = 4096
# Kinds of attributes with a fixed number of components.
_VECTORS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9, "TENSORS6": 6}
_GRIDS = {"STRUCTURED_GRID", "RECTILINEAR_GRID", "STRUCTURED_POINTS"}


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._text = Text(path)
        self._binary = False
        self._points: npt.NDArray[Any] | None = None
        self._axes: list[npt.NDArray[Any]] = []
        self._dimensions = (0, 0, 0)
        self._vectors = {"ORIGIN": np.zeros(3), "SPACING": np.ones(3)}
        self._cells: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]] | None = None
        self._types: npt.NDArray[Any] | None = None
        #: Lines, polygons ... of polydata: offsets and connectivity.
        self._parts: dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]] = {}
        self._data: dict[str, dict[str, npt.NDArray[Any]]] = {"POINT_DATA": {}, "CELL_DATA": {}}
        self._types_at = 0
        self._about = ("", 0)

    def read(self) -> Raw:
        text = self._text
        version = text.line() or b""
        if not version.lower().startswith(b"# vtk datafile version"):
            raise FormatError(f"{text.where(0)}: expected `# vtk DataFile Version`, found {shown(version)}")
        text.line()  # a title
        form = (text.line() or b"").upper()
        if form not in (b"ASCII", b"BINARY"):
            raise FormatError(f"{text.path}:3: expected ASCII or BINARY, found {shown(form)}")
        self._binary = form == b"BINARY"
        word, kind = self._keyword(), text.word().decode("ascii", "replace").upper()
        if word != "DATASET":
            raise FormatError(f"{text.where()}: expected DATASET, found {shown(word)}")
        if kind not in {"UNSTRUCTURED_GRID", "POLYDATA"} | _GRIDS:
            raise FormatError(
                f"{text.where()}: DATASET {shown(kind)} is not read; save an unstructured grid or a surface (in "
                "ParaView: Threshold, or Extract Surface)"
            )
        while word := self._keyword():
            self._section(word)
        return self._raw(kind)

    def _keyword(self) -> str:
        return self._text.word().decode("ascii", "replace").upper()

    def _section(self, word: str) -> None:
        text = self._text
        if word == "POINTS":
            count = text.integer(word)
            self._points = self._array(3 * count, text.word(), word).reshape(-1, 3)
        elif word == "DIMENSIONS":
            self._dimensions = (text.integer(word), text.integer(word), text.integer(word))
        elif word in ("ORIGIN", "SPACING", "ASPECT_RATIO"):
            self._vectors[word.replace("ASPECT_RATIO", "SPACING")] = text.numbers(3, np.float64, word)
        elif word in ("X_COORDINATES", "Y_COORDINATES", "Z_COORDINATES"):
            count = text.integer(word)
            self._axes.append(self._array(count, text.word(), word))
        elif word == "CELLS":
            self._cells = self._connectivity(word)
        elif word in ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS"):
            self._parts[word] = self._connectivity(word)
        elif word == "CELL_TYPES":
            count = text.integer(word)
            self._types_at = text.at
            self._types = self._array(count, b"int", word)
        elif word in ("POINT_DATA", "CELL_DATA"):
            self._about = (word, text.integer(word))
        elif word == "METADATA":
            self._skip_metadata()
        elif word == "FIELD":
            text.word()
            for _ in range(text.integer(word)):
                while (first := text.word()).upper() == b"METADATA":
                    self._skip_metadata()
                name = _name(first)
                width, count = text.integer(f"array {name!r}"), text.integer(f"array {name!r}")
                self._attribute(name, text.word(), width, count)
        else:
            self._attributes(word)

    def _skip_metadata(self) -> None:
        """Goes past what describes an array; an empty line ends it."""
        self._text.line()
        while self._text.line():
            pass

    def _attributes(self, word: str) -> None:
        text = self._text
        name = _name(text.word())
        count = self._about[1]
        if word in _VECTORS:
            self._attribute(name, text.word(), _VECTORS[word], count)
        elif word == "SCALARS":
            kind = text.word()
            width = 1
            at = text.at
            line = text.line() or b""
            if line.isdigit():
                width = int(line)
                at = text.at - 1
            table = text.word()
            if table.upper() == b"LOOKUP_TABLE":
                text.word()
            else:
                text.at = at
            self._attribute(name, kind, width, count)
        elif word == "TEXTURE_COORDINATES":
            width = text.integer(word)
            self._attribute(name, text.word(), width, count)
        elif word in ("GLOBAL_IDS", "PEDIGREE_IDS", "EDGE_FLAGS"):
            self._attribute(name, text.word(), 1, count)
        elif word == "COLOR_SCALARS":
            width = text.integer(word)
            self._array(width * count, b"unsigned_char" if self._binary else b"float", word)
        elif word == "LOOKUP_TABLE":
            self._array(4 * text.integer(word), b"unsigned_char" if self._binary else b"float", word)
        else:
            raise FormatError(
                f"{text.where()}: {shown(word)} is not a part of a VTK file that is known; save it as .vtu"
            )

    def _attribute(self, name: str, kind: bytes, width: int, count: int) -> None:
        text = self._text
        if kind.lower() == b"string":
            text.line()
            for _ in range(width * count):
                self._string()
            return
        values = self._array(width * count, kind, f"array {name!r}")
        wanted = name.startswith(SET_PREFIX) or FIELD_ALIASES.get(name, name) in ELEMENT_FIELDS
        about = self._about[0]
        if about and wanted:
            if count != self._about[1]:
                raise FormatError(f"{text.where()}: array {name!r} has {count} rows, not {self._about[1]}")
            self._data[about][name] = values.reshape(-1, width) if width > 1 else values

    def _string(self) -> None:
        text = self._text
        if not self._binary:
            text.line()
            return
        # Two bits of the first byte say how many bytes hold the length.
        at = text.at
        head = text.data[at] if at < len(text.data) else 0
        size = {3: 1, 2: 2, 1: 4, 0: 8}[head >> 6]
        length = int.from_bytes(text.data[at : at + size], "big") & ((1 << (8 * size - 2)) - 1)
        text.at = min(at + size + length, len(text.data))

    def _array(self, count: int, kind: bytes, what: str) -> npt.NDArray[Any]:
        text = self._text
        name = kind.decode("ascii", "replace").lower()
        if name not in _TYPES:
            raise FormatError(
                f"{text.where()}: {what} has numbers of type {shown(kind)}; known are {', '.join(sorted(_TYPES))}"
            )
        dtype = np.dtype(_TYPES[name])
        if not self._binary:
            integers = np.int32 if name == "int" else np.int64
            return text.numbers(count, integers if dtype.kind in "iu" else np.float64, what)
        # The data begin after the end of the line.
        text.line()
        if name == "bit":
            return np.unpackbits(text.view((count + 7) // 8, np.dtype(np.uint8), what))[:count]
        return text.view(count, dtype.newbyteorder(">"), what).astype(dtype, copy=False)

    def _connectivity(self, what: str) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Returns offsets [cells + 1] and connectivity, of both layouts: since version 5.1 they are two arrays."""
        text = self._text
        first, second = text.integer(what), text.integer(what)
        at = text.at
        if text.word().upper() == b"OFFSETS":
            offsets = self._array(first, text.word(), f"{what} OFFSETS").astype(np.int64)
            if text.word().upper() != b"CONNECTIVITY":
                raise FormatError(f"{text.where()}: {what}: expected CONNECTIVITY")
            connectivity = _small(self._array(second, text.word(), f"{what} CONNECTIVITY"))
            if len(offsets) == 0:
                offsets = np.zeros(1, np.int64)
            return offsets, connectivity
        text.at = at
        flat = self._array(second, b"int", what)
        offsets = np.zeros(first + 1 if first <= len(flat) else 0, np.int64)
        if not len(offsets):
            raise FormatError(f"{text.where()}: {what}: {first} cells in {second} numbers; the file is damaged")
        keep = np.ones(len(flat), bool)
        _walk(flat, offsets, keep, lambda cell: f"{text.where()}: {what}: cell {cell}")
        return offsets, flat[keep]

    def _raw(self, kind: str) -> Raw:
        text = self._text
        if kind in _GRIDS:
            return self._grid(kind)
        if self._points is None:
            raise FormatError(f"{text.path}: has no POINTS; it is cut off, or holds no mesh")
        raw = Raw(self._points, [])
        raw.place = self._place
        if kind == "POLYDATA":
            raw.blocks = polygons(self._parts, raw.place)
            return raw
        if self._cells is None or self._types is None:
            raise FormatError(f"{text.path}: has no CELLS or no CELL_TYPES; it is cut off, or holds no mesh")
        offsets, connectivity = self._cells
        raw.blocks = blocks_of(np.asarray(self._types), offsets, connectivity, raw.place)
        self._add_data(raw)
        return raw

    def _place(self, cell: int) -> str:
        text = self._text
        if self._binary or self._types is None or cell >= len(self._types):
            return f"{text.path}: cell {cell}"
        text.at = self._types_at
        text.numbers(cell + 1, np.int64, "CELL_TYPES")
        return f"{text.where()}: cell {cell}"

    def _grid(self, kind: str) -> Raw:
        where = self._text.path
        notes = []
        if kind == "STRUCTURED_POINTS":
            self._axes = [
                origin + step * np.arange(self._checked(count))
                for origin, step, count in zip(*self._vectors.values(), self._dimensions, strict=True)
            ]
            kind = "RECTILINEAR_GRID"
            notes.append("every cell of the image is an element; for a part of it, save that (in ParaView: Threshold)")
        if kind == "RECTILINEAR_GRID":
            if len(self._axes) != 3 or tuple(map(len, self._axes)) != self._dimensions:
                raise FormatError(f"{where}: DIMENSIONS {self._dimensions} are not those of the three coordinates")
            z, y, x = np.meshgrid(*self._axes[::-1], indexing="ij")
            self._points = np.stack([x.reshape(-1), y.reshape(-1), z.reshape(-1)], axis=1)
        if self._points is None or len(self._points) != int(np.prod(self._dimensions)):
            raise FormatError(f"{where}: DIMENSIONS {self._dimensions} do not match the number of points")
        raw = Raw(self._points, [grid_hexahedra(self._dimensions, str(where))], notes=notes)
        self._add_data(raw)
        return raw

    def _checked(self, count: int) -> int:
        """Returns the points along an axis of an image, which its file need not hold."""
        if count > _MAX_AXIS:
            raise FormatError(f"{self._text.path}: DIMENSIONS {self._dimensions}: beyond the limit of {_MAX_AXIS}")
        return count

    def _add_data(self, raw: Raw) -> None:
        cells = sum(len(block.nodes) for block in raw.blocks)
        for name, values in self._data["CELL_DATA"].items():
            if len(values) != cells:
                raise FormatError(f"{self._text.path}: data {name!r} of cells has {len(values)} rows for {cells} cells")
            raw.cell_data[name] = values
        for name, values in self._data["POINT_DATA"].items():
            if len(values) != len(raw.points):
                raise FormatError(f"{self._text.path}: data {name!r} of points has {len(values)} rows")
        sets_from_data(raw, self._data["POINT_DATA"])


def _small(numbers: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Returns indices as int32 if they fit."""
    fits = not numbers.size or (numbers.min() >= 0 and numbers.max() <= np.iinfo(np.int32).max)
    return numbers.astype(np.int32) if fits else numbers


def _name(word: bytes) -> str:
    """Returns the name of an array. VTK writes a space as %20."""
    return unquote(word.decode("utf-8", "replace"))


def _walk(
    flat: npt.NDArray[np.int64], offsets: npt.NDArray[np.int64], keep: npt.NDArray[np.bool_], where: object
) -> None:
    """Finds the cells in `n a b c n a b c ...`: fills offsets without the counts, and marks the counts in `keep`."""
    assert callable(where)
    at, cell, cells, size = 0, 0, len(offsets) - 1, len(flat)
    while cell < cells:
        count = int(flat[at]) if at < size else -1
        if count < 0 or at + count >= size + (count == 0):
            raise FormatError(f"{where(cell)} has {count} nodes; the file is damaged")
        # Cells of one kind follow each other: double the number of those that are taken at once.
        step = 1
        same = 1
        while cell + same < cells:
            step = min(2 * step, cells - cell - same)
            last = at + (same + step) * (count + 1)
            heads = flat[at + same * (count + 1) : min(last, size) : count + 1]
            other = np.flatnonzero(heads != count)
            good = int(other[0]) if other.size else len(heads)
            same += good
            if good < step:
                break
        if at + same * (count + 1) > size:
            raise FormatError(f"{where(cell + same - 1)} is cut off")
        keep[at : at + same * (count + 1) : count + 1] = False
        offsets[cell + 1 : cell + 1 + same] = offsets[cell] + count * np.arange(1, same + 1)
        at += same * (count + 1)
        cell += same
    if at != size:
        raise FormatError(f"{where(cells)}: {size - at} numbers follow the last cell; the file is damaged")
