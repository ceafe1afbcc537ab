"""Polygon File Format (.ply): vertices and faces, as text and binary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import Block, FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import Text, shown

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_CORNERS = ("vertex_indices", "vertex_index")
# Lines of a head, and entries of one list.
_MAX_HEAD = 1000
_MAX_LIST = 1 << 20


@dataclass
class _Property:
    name: str
    type: str
    #: Type of a list's length; empty: a single number.
    length_type: str = ""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)

    def column(self, name: str) -> int:
        """Returns the place of a number among the single ones that come before any list; -1 without it."""
        for index, found in enumerate(self.properties):
            if found.length_type:
                break
            if found.name == name:
                return index
        return -1


@dataclass
class _Rows:
    """Rows that have lists of the same lengths."""

    numbers: Ints
    #: [property]: values, [rows] or [rows, length].
    values: list[npt.NDArray[Any]]


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    text = Text(path)
    order, elements = _head(text)
    raw: Raw | None = None
    points = None
    blocks: list[Block] = []
    notes = []
    for element in elements:
        rows = _text_rows(text, element) if not order else _binary_rows(text, element, order)
        if element.name == "vertex":
            points = _points(text, element, rows)
        elif element.name == "face":
            blocks = _faces(text, element, rows)
        elif element.count:
            notes.append(f"{element.count} entries of the element {element.name!r} are skipped")
    if points is None:
        raise FormatError(f"{path}: has no element `vertex`; it holds no surface")
    raw = Raw(points, blocks, notes=notes)
    raw.place = lambda face: f"{path}: face {face}"
    return raw


def _head(text: Text) -> tuple[str, list[_Element]]:
    if text.line() != b"ply":
        raise FormatError(f"{text.path}:1: expected `ply`")
    order: str | None = None
    elements: list[_Element] = []
    for _ in range(_MAX_HEAD):
        at = text.at
        line = text.line()
        words = (line or b"").decode("ascii", "replace").split()
        try:
            if line is None:
                break
            if not words or words[0] in ("comment", "obj_info"):
                continue
            if words[0] == "format":
                order = _ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[0] == "property" and words[1] == "list":
                elements[-1].properties.append(_Property(words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[0] == "property":
                elements[-1].properties.append(_Property(words[2], _TYPES[words[1]]))
            elif words[0] == "end_header" and order is not None:
                return order, elements
            else:
                raise ValueError
        except (ValueError, IndexError, KeyError):
            raise FormatError(f"{text.where(at)}: not a line of a PLY file's head: {shown(line or b'')}") from None
    raise FormatError(f"{text.path}: the head has no `end_header`; the file is cut off")


def _text_rows(text: Text, element: _Element) -> list[_Rows]:
    """Reads lines of text: one row a line."""
    if not element.count:
        return []
    first = end = text.at
    for _ in range(element.count):
        stop = text.data.find(b"\n", end)
        if stop < 0:
            end = len(text.data)
            break
        end = stop + 1
    flat, starts = text.rows(end, np.float64, element.name)
    if len(starts) - 1 != element.count:
        raise FormatError(
            f"{text.path}: announces {element.count} of {element.name} and has {len(starts) - 1}; it is cut off"
        )
    widths = np.diff(starts)
    chunks = []
    # Rows with lists of one length are read together, by the length of the whole row and then by each list's.
    left: dict[tuple[int, ...], Ints] = {(): np.arange(element.count)}
    columns: dict[tuple[int, ...], list[tuple[int, int]]] = {(): []}
    position: dict[tuple[int, ...], int] = {(): 0}
    for found in element.properties:
        new_left: dict[tuple[int, ...], Ints] = {}
        for key, rows in left.items():
            at = position[key]
            if not found.length_type:
                columns[key].append((at, 0))
                position[key] += 1
                new_left[key] = rows
                continue
            short = np.flatnonzero(widths[rows] <= at)
            if short.size:
                raise FormatError(f"{text.row_place(first, int(rows[short[0]]))}: the line is cut off")
            lengths = flat[starts[rows] + at]
            wrong = np.flatnonzero(~((lengths >= 0) & (lengths <= _MAX_LIST) & (lengths == np.round(lengths))))
            if wrong.size:
                row = text.row_place(first, int(rows[wrong[0]]))
                raise FormatError(f"{row}: a list of {lengths[wrong[0]]:g} numbers; the file is damaged")
            for size in np.unique(lengths).astype(int).tolist():
                longer = (*key, size)
                new_left[longer] = rows[lengths == size]
                columns[longer] = [*columns[key], (at + 1, size)]
                position[longer] = at + 1 + size
        left = new_left
    for key, rows in left.items():
        short = np.flatnonzero(widths[rows] < position[key])
        if short.size:
            raise FormatError(f"{text.row_place(first, int(rows[short[0]]))}: the line is cut off")
        values: list[npt.NDArray[Any]] = []
        for (at, size), found in zip(columns[key], element.properties, strict=True):
            begin = starts[rows] + at
            values.append(flat[begin[:, None] + np.arange(size)] if found.length_type else flat[begin])
        chunks.append(_Rows(rows, values))
    return chunks


def _binary_rows(text: Text, element: _Element, order: str) -> list[_Rows]:
    """Reads binary rows: as many at a time as have lists of the same lengths."""
    chunks = []
    done, step = 0, 1
    while done < element.count:
        lengths = _lengths(text, element, order)
        fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
        for index, found in enumerate(element.properties):
            if found.length_type:
                fields.append((f"n{index}", order + found.length_type))
                fields.append((f"v{index}", order + found.type, (lengths[index],)))
            else:
                fields.append((f"v{index}", order + found.type))
        dtype = np.dtype(fields)
        size = dtype.itemsize
        if size == 0:
            raise FormatError(f"{text.path}: the element {element.name!r} has no properties; the file is damaged")
        available = min((len(text.data) - text.at) // size, element.count - done)
        if available < 1:
            raise FormatError(f"{text.path}: ends after {done} of {element.count} of {element.name}; it is cut off")
        taken = min(available, step)
        rows = text.view(taken, dtype, element.name)
        text.at -= taken * size
        same = np.ones(taken, bool)
        for index, length in lengths.items():
            same &= rows[f"n{index}"] == length
        other = np.flatnonzero(~same)
        good = int(other[0]) if other.size else taken
        step = 2 * step if good == taken else 1
        values = [rows[f"v{index}"][:good] for index in range(len(element.properties))]
        chunks.append(_Rows(np.arange(done, done + good), values))
        text.at += good * size
        done += good
    return chunks


def _lengths(text: Text, element: _Element, order: str) -> dict[int, int]:
    """Returns the lengths of the lists of the next row, by the places of their properties."""
    at, lengths = text.at, {}
    for index, found in enumerate(element.properties):
        if found.length_type:
            dtype = np.dtype(order + found.length_type)
            piece = text.data[at : at + dtype.itemsize]
            if len(piece) < dtype.itemsize:
                raise FormatError(f"{text.path}: ends within {element.name}; it is cut off")
            number = float(np.frombuffer(piece, dtype)[0])
            if not 0 <= number <= _MAX_LIST or number != round(number):
                raise FormatError(f"{text.path}: {element.name} has a list of {number:g} numbers; the file is damaged")
            lengths[index] = int(number)
            at += dtype.itemsize + int(number) * np.dtype(found.type).itemsize
        else:
            at += np.dtype(found.type).itemsize
    return lengths


def _points(text: Text, element: _Element, chunks: list[_Rows]) -> npt.NDArray[np.float64]:
    columns = [element.column(axis) for axis in "xyz"]
    if min(columns) < 0:
        raise FormatError(f"{text.path}: the vertices have no x, y and z; it holds no surface")
    points = np.empty((element.count, 3))
    for chunk in chunks:
        for axis, column in enumerate(columns):
            points[chunk.numbers, axis] = chunk.values[column]
    return points


def _faces(text: Text, element: _Element, chunks: list[_Rows]) -> list[Block]:
    columns = [index for index, found in enumerate(element.properties) if found.name in _CORNERS and found.length_type]
    if not columns:
        raise FormatError(f"{text.path}: the faces have no list `vertex_indices`; it holds no surface")
    by_size: dict[int, list[tuple[Ints, Ints]]] = {}
    for chunk in chunks:
        corners = chunk.values[columns[0]]
        if corners.dtype.kind == "f" and (corners != np.round(corners)).any():
            raise FormatError(f"{text.path}: face {chunk.numbers[0]} has a corner that is not a whole number")
        by_size.setdefault(corners.shape[1], []).append((corners, chunk.numbers))
    blocks = []
    for size, parts in by_size.items():
        kind = {0: "", 1: "vertex", 2: "line", 3: "triangle", 4: "quad"}.get(size, "polygon")
        if not kind:
            continue
        corners = np.concatenate([part[0] for part in parts]).astype(np.int64)
        blocks.append(Block(kind, corners, np.concatenate([part[1] for part in parts])))
    return blocks
