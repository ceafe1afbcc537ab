"""Reads numbers of text files in pieces, so that memory stays near the size of the result, and names lines."""

from __future__ import annotations

import mmap
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import FormatError

# Bytes that are parsed at a time.
_PIECE = 1 << 20
# Longest word that a message repeats.
_MAX_SHOWN = 40
_SPACE = 32


class Text:
    """A file and a place in it. Words are separated by bytes up to a space.

    Args:
        comment: starts a comment that ends with its line.
        commas: commas separate words, too.
    """

    def __init__(self, path: Path, *, comment: bytes = b"", commas: bool = False) -> None:
        self.path = path
        with path.open("rb") as file:
            size = file.seek(0, 2)
            #: A mapped file is not copied.
            self.data: mmap.mmap | bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        self.at = 0
        self._comment = comment
        self._commas = commas

    def where(self, at: int | None = None) -> str:
        """Returns `FILE:LINE` of a place, by default of the present one."""
        at = self.at if at is None else at
        line = 1
        for first in range(0, at, _PIECE):
            line += self.data[first : min(first + _PIECE, at)].count(b"\n")
        return f"{self.path}:{line}"

    def line(self) -> bytes | None:
        """Returns the rest of the line without spaces around it, and goes to the next one; None at the end."""
        if self.at >= len(self.data):
            return None
        end = self.data.find(b"\n", self.at)
        end = len(self.data) if end < 0 else end
        line = self.data[self.at : end]
        self.at = end + 1
        return line.strip()

    def full_line(self) -> bytes | None:
        """Returns the next line that is not empty and no comment, without its comment; None at the end."""
        while (line := self.line()) is not None:
            line = line.split(self._comment)[0].strip() if self._comment else line
            if line:
                return line
        return None

    def word(self) -> bytes:
        """Returns the next word, empty at the end."""
        while self.at < len(self.data):
            byte = self.data[self.at]
            if byte <= _SPACE:
                self.at += 1
            elif self._comment and byte == self._comment[0]:
                end = self.data.find(b"\n", self.at)
                self.at = len(self.data) if end < 0 else end
            else:
                break
        first = self.at
        while self.at < len(self.data) and self.data[self.at] > _SPACE:
            self.at += 1
        return self.data[first : self.at]

    def integer(self, what: str) -> int:
        """Reads one whole number that is not negative."""
        word = self.word()
        try:
            number = int(word)
        except ValueError:
            number = -1
        if number < 0:
            raise FormatError(f"{self.where()}: {what}: expected a number of them, found {shown(word)}")
        return number

    def numbers(self, count: int, dtype: npt.DTypeLike, what: str) -> npt.NDArray[Any]:
        """Reads the next `count` numbers.

        Raises:
            FormatError: fewer of them, or a word that is not a number; the message names the line.
        """
        # A number needs a byte and another one that separates it.
        if not 0 <= count <= (len(self.data) - self.at) // 2 + 1:
            raise FormatError(
                f"{self.where()}: {what}: the file announces {count} numbers and is too short for them; it is cut off, "
                "or a count is wrong"
            )
        out = np.empty(count, dtype)
        done = 0
        while done < count:
            piece, ends, whole = self._piece(self.at, len(self.data))
            if not len(ends):
                if not whole:
                    self.at += len(piece)
                    continue
                raise FormatError(
                    f"{self.where(len(self.data))}: {what}: the file ends after {done} of {count} numbers"
                )
            taken = min(len(ends), count - done)
            out[done : done + taken] = self._parsed(piece[: ends[taken - 1]], taken, out.dtype, self.at, what)
            self.at += int(ends[taken - 1])
            done += taken
        return out

    def rows(self, end: int, dtype: npt.DTypeLike, what: str) -> tuple[npt.NDArray[Any], npt.NDArray[np.int64]]:
        """Reads all numbers before the place `end`, and where the rows start among them.

        Returns:
            The numbers, and [rows + 1] the index of each line's first one; lines without numbers are left out.
        """
        first = self.at
        count = lines = 0
        at = first
        while at < end:
            piece, ends, whole = self._piece(at, end)
            stop = len(piece) if whole else (int(ends[-1]) if len(ends) else len(piece))
            count += len(ends)
            lines += piece[:stop].count(b"\n") + 1
            at += stop
        numbers, starts = np.empty(count, dtype), np.zeros(lines + 1, np.int64)
        at, done, line = first, 0, 0
        while at < end:
            piece, ends, whole = self._piece(at, end)
            stop = len(piece) if whole else (int(ends[-1]) if len(ends) else len(piece))
            numbers[done : done + len(ends)] = self._parsed(piece[:stop], len(ends), numbers.dtype, at, what)
            breaks = np.flatnonzero(np.frombuffer(piece[:stop], np.uint8) == 10)
            starts[line + 1 : line + 1 + len(breaks)] = done + np.searchsorted(ends, breaks, side="right")
            line += len(breaks)
            done += len(ends)
            at += stop
        self.at = end
        starts = np.append(starts[: line + 1], count)
        return numbers, np.append(starts[:-1][np.diff(starts) > 0], count)

    def view(self, count: int, dtype: np.dtype[Any], what: str) -> npt.NDArray[Any]:
        """Reads `count` binary numbers or records without a copy: they are a view of the file.

        Raises:
            FormatError: the file ends before.
        """
        size = count * dtype.itemsize
        if count < 0 or size > len(self.data) - self.at:
            raise FormatError(f"{self.path}: {what}: the file ends within {count} entries; it is cut off")
        first = self.at
        self.at += size
        return np.frombuffer(self.data, dtype, count, first) if size else np.empty(count, dtype)

    def row_place(self, first: int, row: int) -> str:
        """Returns `FILE:LINE` of the row with a number among the lines from the place `first` that are not empty."""
        at = first
        for _ in range(row + 1):
            while True:
                end = self.data.find(b"\n", at)
                end = len(self.data) if end < 0 else end
                begin, at = at, end + 1
                line = self.data[begin:end]
                if self._comment:
                    line = line.split(self._comment)[0]
                if line.strip() or at > len(self.data):
                    break
        return self.where(begin)

    def _piece(self, at: int, limit: int) -> tuple[bytes, npt.NDArray[np.int64], bool]:
        """Returns bytes from `at` on, the ends of the words that end within them, and whether they reach `limit`."""
        stop = min(at + _PIECE, limit)
        if self._comment and stop < limit:
            newline = self.data.find(b"\n", stop, limit)
            stop = limit if newline < 0 else newline
        piece = self.data[at:stop]
        if self._comment and self._comment in piece:
            piece = b"\n".join(
                line if (cut := line.find(self._comment)) < 0 else line[:cut] + b" " * (len(line) - cut)
                for line in piece.split(b"\n")
            )
        if self._commas:
            piece = piece.replace(b",", b" ")
        filled = np.frombuffer(piece, np.uint8) > _SPACE
        if stop < limit and filled.all():
            raise FormatError(f"{self.where(at)}: found a word of more than {_PIECE} letters; this is not a text file")
        ends = np.flatnonzero(filled[:-1] & ~filled[1:]) + 1
        if stop == limit and len(filled) and filled[-1]:
            ends = np.append(ends, len(filled))
        return piece, ends, stop == limit

    def _parsed(self, piece: bytes, count: int, dtype: np.dtype[np.generic], at: int, what: str) -> npt.ArrayLike:
        integers = np.issubdtype(dtype, np.integer)
        values = _parse(piece, integers)
        if values is None or len(values) != count:
            # Fortran writes 1.0D-03.
            values = None if integers else _parse(piece.translate(_FORTRAN), integers)
        if values is None or len(values) != count:
            for word in piece.split():
                place = piece.index(word)
                try:
                    _ = int(word) if integers else float(word.translate(_FORTRAN))
                except ValueError:
                    kind = "a whole number" if integers else "a number"
                    raise FormatError(
                        f"{self.where(at + place)}: {what}: expected {kind}, found {shown(word)}"
                    ) from None
            raise FormatError(f"{self.where(at)}: {what}: not readable as numbers")
        if integers and count:
            info = np.iinfo(dtype)  # type: ignore[type-var]
            if values.min() < info.min or values.max() > info.max:
                wrong = int(values[(values < info.min) | (values > info.max)][0])
                place = piece.find(str(wrong).encode())
                raise FormatError(f"{self.where(at + max(place, 0))}: {what}: {wrong} is too large or too small")
        return values


_FORTRAN = bytes.maketrans(b"dD", b"ee")


def _parse(piece: bytes, integers: bool) -> npt.NDArray[Any] | None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            values: npt.NDArray[Any] = np.fromstring(piece, np.int64 if integers else np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            return None
    return values


def shown(word: bytes | str) -> str:
    """Returns a word of a file for a message."""
    text = word.decode("ascii", "backslashreplace") if isinstance(word, bytes) else word
    return repr(text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "…")


def checked_width(rows: npt.NDArray[np.int64]) -> int:
    """Returns the numbers in each row; -1 if rows differ, 0 without rows."""
    widths = np.diff(rows)
    return 0 if not len(widths) else int(widths[0]) if (widths == widths[0]).all() else -1
