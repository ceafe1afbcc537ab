"""Keywords of input files of Abaqus and CalculiX, with their data lines, through included files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.limits import allow_file
from tensormass._src.mesh_formats.raw import FormatError, Ints
from tensormass._src.mesh_formats.text import Text, shown

#: Files that include each other, and all included files.
_MAX_DEPTH = 10
_MAX_INCLUDED = 1000
# Keywords whose data lines are read.
_WITH_DATA = ("NODE", "ELEMENT", "NSET", "ELSET")
_BOM = b"\xef\xbb\xbf"
_STAR = re.compile(rb"\n[ \t]*\*")
_EMPTY_FIELD = re.compile(rb",[ \t]*,|\n[ \t]*,")
_LETTER = re.compile(rb"[A-Za-z_]")
_SPLIT = re.compile(r'"[^"]*"|[^,]+')


@dataclass
class Keyword:
    """A keyword with its parameters and the lines of data after it."""

    name: str
    parameters: dict[str, str]
    text: Text
    #: Place of the keyword.
    at: int
    #: Places of data lines, first and end; comments lie between them.
    spans: list[tuple[int, int]] = field(default_factory=list)

    @property
    def where(self) -> str:
        return f"{self.text.where(self.at)}: *{self.name}"

    def has_data(self) -> bool:
        return any(self.text.data[first:end].strip() for first, end in self.spans)

    def lines(self) -> Iterator[tuple[int, str]]:
        """Yields the places of data lines and their text."""
        for first, end in self.spans:
            at = first
            while at < end:
                stop = self.text.data.find(b"\n", at, end)
                stop = end if stop < 0 else stop
                line = self.text.data[at:stop].decode("utf-8", "replace").strip()
                if line:
                    yield at, line
                at = stop + 1

    def fields(self) -> Iterator[tuple[int, list[str]]]:
        """Yields the places of data lines and their fields, without quotes around them."""
        for at, line in self.lines():
            yield at, [part.strip().strip('"') for part in line.rstrip(",").split(",")]

    def numbers(self, dtype: npt.DTypeLike) -> tuple[npt.NDArray[Any], Ints]:
        """Returns all numbers of the data lines, and [rows + 1] where rows start among them."""
        flats, starts, total = [np.empty(0, dtype)], [np.zeros(1, np.int64)], 0
        for first, end in self.spans:
            self.text.at = first
            flat, rows = self.text.rows(end, dtype, f"*{self.name}")
            flats.append(flat)
            starts.append(rows[1:] + total)
            total += len(flat)
        return (flats[1] if len(flats) == 2 else np.concatenate(flats)), np.concatenate(starts)

    def has_empty_fields(self) -> bool:
        return any(_EMPTY_FIELD.search(self.text.data, first, end) for first, end in self.spans)

    def has_words(self) -> bool:
        return any(_LETTER.search(self.text.data, first, end) for first, end in self.spans)

    def row_place(self, row: int) -> str:
        """Returns `FILE:LINE` of a data line by its number."""
        for index, (at, _) in enumerate(self.lines()):
            if index == row:
                return self.text.where(at)
        return self.text.where(self.at)


class Deck:
    """Reads the keywords of a file and of those that it includes."""

    def __init__(self, path: Path) -> None:
        self._folder = path.resolve().parent
        self._path = path
        self._included = 0

    def keywords(self) -> Iterator[Keyword]:
        """Yields keywords in their order. Data lines of an included file belong to the keyword before *INCLUDE: they
        come as a second keyword of that name."""
        before: Keyword | None = None
        for keyword in self._of(self._path, 0):
            if keyword.name:
                before = keyword
                yield keyword
            elif before is None or before.name not in _WITH_DATA:
                at = next((at for at, _ in keyword.lines()), 0)
                where = keyword.text.where(at)
                raise FormatError(f"{where}: expected a keyword such as *NODE or *ELEMENT before this line")
            else:
                yield replace(keyword, name=before.name, parameters=before.parameters)

    def _of(self, path: Path, depth: int) -> Iterator[Keyword]:
        text = Text(path, commas=True)
        data = text.data
        first = len(_BOM) if data[: len(_BOM)] == _BOM else 0
        at = first
        while at < len(data) and data[at] in b" \t":
            at += 1
        if data[at : at + 1] != b"*":
            match = _STAR.search(data, first)
            at = match.start() + 1 if match else len(data)
        # What comes before the first keyword belongs to the file that includes this one.
        keyword = Keyword("", {}, text, first, [(first, at)])
        while at < len(data):
            line_end = data.find(b"\n", at)
            line_end = len(data) if line_end < 0 else line_end
            line = data[at:line_end].strip()
            following = _STAR.search(data, line_end) if line_end < len(data) else None
            end = following.start() + 1 if following else len(data)
            if line.startswith(b"**"):
                if line_end + 1 < end:
                    keyword.spans.append((line_end + 1, end))
            else:
                yield from self._expanded(keyword, depth)
                keyword = self._keyword(text, at, line, line_end, end)
            at = end
        yield from self._expanded(keyword, depth)

    def _keyword(self, text: Text, at: int, line: bytes, line_end: int, end: int) -> Keyword:
        # A line that ends with a comma goes on in the next one.
        begin = min(line_end + 1, end)
        while line.endswith(b",") and begin < end:
            stop = text.data.find(b"\n", begin, end)
            stop = end if stop < 0 else stop
            line += text.data[begin:stop].strip()
            begin = min(stop + 1, end)
        name, *rest = _SPLIT.findall(line.decode("utf-8", "replace").lstrip("*")) or [""]
        parameters = {}
        for part in rest:
            key, _, value = part.partition("=")
            parameters["".join(key.split()).upper()] = value.strip().strip('"')
        spans = [(begin, end)] if begin < end else []
        return Keyword(" ".join(name.upper().split()), parameters, text, at, spans)

    def _expanded(self, keyword: Keyword, depth: int) -> Iterator[Keyword]:
        if keyword.name == "INCLUDE":
            yield from self._of(self._file_of(keyword, depth), depth + 1)
            keyword = replace(keyword, name="")  # data lines go on after it
        if not keyword.name and not keyword.has_data():
            return
        if keyword.name in _WITH_DATA and "INPUT" in keyword.parameters:
            text = Text(self._file_of(keyword, depth), commas=True)
            keyword.text, keyword.at, keyword.spans = text, 0, [(0, len(text.data))]
        yield keyword

    def _file_of(self, keyword: Keyword, depth: int) -> Path:
        named = keyword.parameters.get("INPUT", "")
        path = (self._folder / named).resolve()
        self._included += 1
        if not named:
            raise FormatError(f"{keyword.where} names no file; expected INPUT=FILE")
        if depth >= _MAX_DEPTH or self._included > _MAX_INCLUDED:
            raise FormatError(f"{keyword.where}, INPUT={shown(named)}: more than {_MAX_DEPTH} files include each other")
        if not path.is_relative_to(self._folder):
            raise FormatError(
                f"{keyword.where}, INPUT={shown(named)}: lies outside of the folder of the file; put it beside the file"
            )
        if not path.is_file():
            raise FormatError(f"{keyword.where}, INPUT={shown(named)}: no such file; put it beside the file")
        allow_file(path)
        return path
