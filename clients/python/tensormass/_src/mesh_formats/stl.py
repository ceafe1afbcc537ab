"""Stereolithography (.stl): triangles, as text and binary."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import Block, FormatError, Raw
from tensormass._src.mesh_formats.text import Text, shown

_HEAD = 84
_RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
# Bytes of text that are parsed at a time.
_PIECE = 1 << 20
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_END = re.compile(rb"end\s*facet", re.IGNORECASE)
_FACET = re.compile(rb"\bfacet\b", re.IGNORECASE)
_SOLID = re.compile(rb"^\s*solid\b", re.IGNORECASE | re.MULTILINE)


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    text = Text(path)
    data = text.data
    count = int.from_bytes(data[80:_HEAD], "little") if len(data) >= _HEAD else -1
    is_text = data[:512].lstrip()[:5].lower() == b"solid"
    if count >= 0 and (len(data) == _HEAD + count * _RECORD.itemsize or not is_text):
        text.at = _HEAD
        rows = text.view(count, _RECORD, "triangles")
        raw = _raw(rows["corners"].reshape(-1, 3).astype(np.float64))
        if left := len(data) - _HEAD - count * _RECORD.itemsize:
            raw.notes.append(f"{left} bytes after the triangles are skipped")
        return raw
    if not is_text:
        raise FormatError(f"{path}:1: expected `solid` or a binary STL, found {shown(data[:20])}")
    return _read_text(text)


def _raw(corners: npt.NDArray[np.float64]) -> Raw:
    return Raw(
        corners,
        [Block("triangle", np.arange(len(corners), dtype=np.int32).reshape(-1, 3), slice(0, len(corners) // 3))],
    )


def _read_text(text: Text) -> Raw:
    data = text.data
    parts = [np.empty((0, 3))]
    at, solids = 0, 0
    while at < len(data):
        # A piece ends with a triangle.
        match = _END.search(data, min(at + _PIECE, len(data)))
        stop = match.end() if match else len(data)
        piece = data[at:stop]
        solids += len(_SOLID.findall(piece))
        found = _VERTEX.findall(piece)
        triangles = len(_END.findall(piece))
        if len(found) != 3 * triangles or len(_FACET.findall(piece)) != triangles:
            raise FormatError(_wrong_triangle(text, at, piece))
        if found:
            try:
                parts.append(np.array(found, dtype=bytes).astype(np.float64))
            except ValueError:
                raise FormatError(_wrong_number(text, at, piece)) from None
        at = stop
    raw = _raw(np.concatenate(parts))
    if solids > 1:
        raw.notes.append(f"{solids} solids are joined into one surface; their names are skipped")
    return raw


def _wrong_triangle(text: Text, at: int, piece: bytes) -> str:
    begin = 0
    for match in _END.finditer(piece):
        corners = len(_VERTEX.findall(piece[begin : match.start()]))
        if corners != 3:
            return f"{text.where(at + match.start())}: a facet has {corners} vertices, not 3; the file is damaged"
        begin = match.end()
    return (
        f"{text.where(at + len(piece))}: the file ends within a facet, or a facet has no end; it is cut off or damaged"
    )


def _wrong_number(text: Text, at: int, piece: bytes) -> str:
    for match in _VERTEX.finditer(piece):
        for word in match.groups():
            try:
                float(word)
            except ValueError:
                return f"{text.where(at + match.start())}: expected a number, found {shown(word)}"
    return f"{text.where(at)}: a vertex is not readable"
