"""Object File Format (.off): vertices and polygons, as text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tensormass._src.mesh_formats.raw import Block, FormatError, Raw
from tensormass._src.mesh_formats.text import Text, shown

_HEAD = re.compile(rb"(ST)?C?N?OFF")


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    text = Text(path, comment=b"#")
    head = text.word()
    if not _HEAD.fullmatch(head):
        raise FormatError(
            f"{text.where()}: expected OFF, found {shown(head)}; save as .off of text in three dimensions"
        )
    vertices, faces = text.integer("OFF: vertices"), text.integer("OFF: faces")
    text.line()  # the number of edges, which may be left out
    first = text.at
    flat, starts = text.rows(len(text.data), np.float64, "OFF")
    rows = len(starts) - 1
    if rows < vertices + faces:
        raise FormatError(
            f"{path}: announces {vertices} vertices and {faces} faces, and has {rows} lines; it is cut off"
        )
    widths = np.diff(starts)
    short = np.flatnonzero(widths[:vertices] < 3)
    if short.size:
        raise FormatError(f"{text.row_place(first, int(short[0]))}: expected `x y z`")
    points = flat[starts[:vertices, None] + np.arange(3)]

    def place(face: int) -> str:
        return f"{text.row_place(first, vertices + face)}: face {face}"

    heads = starts[vertices : vertices + faces]
    counts = flat[heads]
    wrong = np.flatnonzero(
        (counts != np.round(counts)) | (counts < 1) | (counts >= widths[vertices : vertices + faces])
    )
    if wrong.size:
        raise FormatError(f"{place(int(wrong[0]))} has {counts[wrong[0]]:g} corners, and its line has other numbers")
    raw = Raw(points, [], place=place)
    for count in np.unique(counts).astype(int).tolist():
        chosen = np.flatnonzero(counts == count)
        nodes = flat[heads[chosen][:, None] + 1 + np.arange(count)]
        fraction = np.flatnonzero((nodes != np.round(nodes)).any(axis=1) | (np.abs(nodes).max(axis=1) > 2**53))
        if fraction.size:
            raise FormatError(f"{place(int(chosen[fraction[0]]))} has a corner that is not a number of a vertex")
        raw.blocks.append(Block(_kind(count), nodes.astype(np.int64), chosen))
    if rows > vertices + faces:
        raw.notes.append(f"{rows - vertices - faces} lines after the faces are skipped")
    return raw


def _kind(corners: int) -> str:
    return {1: "vertex", 2: "line", 3: "triangle", 4: "quad"}.get(corners, "polygon")
