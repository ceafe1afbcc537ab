"""Wavefront (.obj): vertices, faces, and places in a picture."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import Block, FormatError, Raw
from tensormass._src.mesh_formats.text import Text, shown

# Lines that say how a surface looks, or how its parts are called.
_QUIET = {b"vn", b"s", b"mtllib", b"usemtl", b"g", b"o", b"vp", b"mg", b"lod", b"shadow_obj", b"trace_obj"}
_MAX_INDEX = (1 << 31) - 1
_SKIPPED = {b"l": "lines", b"p": "points"}


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError with its line."""
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._text = Text(path, comment=b"#")
        self._vertices = array("d")
        self._places = array("d")
        #: Corners of triangles, their places in a picture (-1: none), and where each triangle's line is.
        self._corners = array("q")
        self._corner_places = array("q")
        self._lines = array("q")
        self._skipped: dict[str, int] = {}

    def read(self) -> Raw:
        text = self._text
        at = 0
        while (line := text.line()) is not None:
            while line.endswith(b"\\"):
                line = line[:-1] + b" " + (text.line() or b"")
            words = line.split(b"#")[0].split()
            if words:
                self._line(words, at)
            at = text.at
        raw = Raw(np.asarray(self._vertices, np.float64).reshape(-1, 3), [])
        if self._corners:
            corners = np.asarray(self._corners, np.int64).reshape(-1, 3)
            raw.blocks.append(Block("triangle", corners, slice(0, len(corners))))
        raw.place = lambda row: f"{text.where(self._lines[row])}: the face"
        raw.texture = self._texture(raw)
        raw.notes += [f"{count} {what} are skipped" for what, count in self._skipped.items()]
        return raw

    def _line(self, words: list[bytes], at: int) -> None:
        head, *rest = words
        if head in (b"v", b"vt"):
            count = 3 if head == b"v" else 2
            try:
                numbers = [float(word) for word in rest[:count]]
            except ValueError:
                numbers = []
            if head == b"vt" and len(numbers) == 1:
                numbers.append(0.0)
            if len(numbers) < count:
                raise FormatError(
                    f"{self._text.where(at)}: expected {count} numbers after {shown(head)}, found "
                    f"{shown(b' '.join(rest))}"
                )
            (self._vertices if head == b"v" else self._places).extend(numbers)
        elif head == b"f":
            self._face(rest, at)
        elif head in _SKIPPED:
            self._skipped[_SKIPPED[head]] = self._skipped.get(_SKIPPED[head], 0) + 1
        elif head not in _QUIET:
            if not head.isalpha() and head not in (b"usemap", b"cstype"):
                raise FormatError(f"{self._text.where(at)}: not a line of a Wavefront file: {shown(head)}")
            what = f"lines of {head.decode('ascii', 'replace')!r}"
            self._skipped[what] = self._skipped.get(what, 0) + 1

    def _face(self, rest: list[bytes], at: int) -> None:
        if len(rest) < 3:
            raise FormatError(f"{self._text.where(at)}: a face of {len(rest)} corners; it needs 3")
        corners, places = [], []
        for word in rest:
            parts = word.split(b"/")
            try:
                corner = int(parts[0])
                place = int(parts[1]) if len(parts) > 1 and parts[1] else 0
            except ValueError:
                raise FormatError(
                    f"{self._text.where(at)}: expected numbers of vertices, found {shown(word)}"
                ) from None
            # A negative number counts from the last vertex so far.
            corner = corner - 1 if corner > 0 else len(self._vertices) // 3 + corner
            place = place - 1 if place > 0 else len(self._places) // 2 + place if place < 0 else -1
            if not 0 <= corner <= _MAX_INDEX or place > _MAX_INDEX or parts[0] == b"0":
                raise FormatError(f"{self._text.where(at)}: {shown(word)} is not a vertex; they count from 1")
            corners.append(corner)
            places.append(place)
        for k in range(1, len(corners) - 1):
            self._corners.extend((corners[0], corners[k], corners[k + 1]))
            self._corner_places.extend((places[0], places[k], places[k + 1]))
            self._lines.append(at)

    def _texture(self, raw: Raw) -> npt.NDArray[np.float64] | None:
        """Returns the places of all corners; None if a corner has none."""
        chosen = np.asarray(self._corner_places, np.int64).reshape(-1, 3)
        if not len(chosen) or (chosen < 0).all():
            return None
        if (chosen < 0).any():
            raw.notes.append("some faces have no places in a picture, so those of the others are skipped")
            return None
        wrong = np.flatnonzero((chosen >= len(self._places) // 2).any(axis=1))
        if wrong.size:
            raise FormatError(
                f"{self._text.where(self._lines[int(wrong[0])])}: a corner names place {chosen[wrong[0]].max() + 1} "
                f"in a picture, and there are {len(self._places) // 2}"
            )
        places = np.asarray(self._places, np.float64).reshape(-1, 2)[chosen]
        return places if np.isfinite(places).all() else None
