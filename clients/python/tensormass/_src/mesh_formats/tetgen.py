"""TetGen: nodes (.node) and tetrahedra (.ele) of one name, with attributes and markers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.limits import allow_file
from tensormass._src.mesh_formats.middles import in_vtk_order
from tensormass._src.mesh_formats.numbering import Numbering
from tensormass._src.mesh_formats.raw import Block, FormatError, Raw
from tensormass._src.mesh_formats.text import Text


def read(path: Path) -> Raw:
    """Reads both files, by the name of either. Raises FormatError with file and line."""
    other = path.with_suffix(".node" if path.suffix.lower() == ".ele" else ".ele")
    if not other.is_file():
        raise FormatError(f"{path}: {other.name} is not beside it; TetGen writes nodes and elements into two files")
    allow_file(other)
    node_file, element_file = (other, path) if path.suffix.lower() == ".ele" else (path, other)
    nodes, node_text, first = _table(node_file, "nodes")
    if int(node_text[1]) != 3:
        raise FormatError(f"{node_file}: has nodes in {node_text[1]:g} dimensions, not 3")
    if nodes.shape[1] < 4:
        raise FormatError(f"{node_file}: expected `number x y z` a line")
    text = Text(node_file, comment=b"#")
    numbering = Numbering(_whole(nodes[:, 0], str(node_file)), lambda node: text.row_place(first, node))
    elements, head, begin = _table(element_file, "elements")
    width = int(head[1])
    if width not in (4, 10) or elements.shape[1] < 1 + width:
        raise FormatError(f"{element_file}: has elements of {head[1]:g} nodes; known are tetrahedra of 4 or 10")
    numbers = _whole(elements[:, : 1 + width].reshape(-1), str(element_file)).reshape(-1, 1 + width)
    element_text = Text(element_file, comment=b"#")

    def place(row: int) -> str:
        return f"{element_text.row_place(begin, row)}: element {numbers[row, 0]}"

    cells = numbering.indices(numbers[:, 1:], place)
    points = nodes[:, 1:4]
    if width == 10:
        cells = in_vtk_order(points, cells, str(element_file))
    raw = Raw(points, [Block("tetra" if width == 4 else "tetra10", cells, slice(0, len(cells)))], place=place)
    attributes = elements[:, 1 + width :]
    for column in range(attributes.shape[1]):
        count = len(np.unique(attributes[:, column]))
        raw.notes.append(f"attribute {column + 1} of the elements ({count} values) has no name and is skipped")
    return raw


def _table(path: Path, what: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], int]:
    """Returns the rows after the head, the head's numbers, and where the rows begin."""
    text = Text(path, comment=b"#")
    line = text.full_line()
    try:
        head = np.array([float(word) for word in (line or b"").split()])
        if not np.isfinite(head).all():
            raise ValueError
        count = int(head[0])
    except (ValueError, IndexError, OverflowError):
        raise FormatError(f"{text.where(max(text.at - 1, 0))}: expected the number of {what} and their size") from None
    if len(head) < 2:
        raise FormatError(f"{text.where(max(text.at - 1, 0))}: expected the number of {what} and their size")
    first = text.at
    flat, starts = text.rows(len(text.data), np.float64, what)
    if len(starts) - 1 < count or count < 1:
        raise FormatError(f"{path}: announces {count} {what} and has {len(starts) - 1}; it is cut off")
    widths = np.diff(starts[: count + 1])
    wrong = np.flatnonzero(widths != widths[0])
    if wrong.size:
        row = int(wrong[0])
        raise FormatError(f"{text.row_place(first, row)}: has {widths[row]} numbers, the lines before have {widths[0]}")
    return flat[: starts[count]].reshape(count, widths[0]), head, first


def _whole(values: npt.NDArray[np.float64], where: str) -> npt.NDArray[np.int64]:
    if (values != np.round(values)).any() or np.abs(values).max(initial=0) > 2**53:
        raise FormatError(f"{where}: a number of a node or an element is not whole; the file is damaged")
    return values.astype(np.int64)
