"""The bytes of a file's data, unpacked piece by piece, so that a small file cannot take all memory."""

from __future__ import annotations

import bz2
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from tensormass._src.label_formats.content import Filler
from tensormass._src.mesh_formats.raw import FormatError

# Bytes that are read and unpacked at a time.
_PIECE = 1 << 20


def fill(filler: Filler, file: BinaryIO, path: Path, packing: str, dtype: np.dtype[np.generic], skip: int) -> int:
    """Unpacks values until the filler has all. Returns the number of bytes that are left over, as far as is known.

    Args:
        packing: `raw`, `gzip` or `bzip2`.
        skip: bytes before the first value, after unpacking.

    Raises:
        FormatError: damaged data. The filler tells if they end too early.
    """
    rest = b""
    for piece in pieces(file, path, packing):
        data = rest + piece
        if skip:
            dropped = min(skip, len(data))
            data, skip = data[dropped:], skip - dropped
        count = min(len(data) // dtype.itemsize, filler.missing)
        filler.take(np.frombuffer(data, dtype, count))
        rest = data[count * dtype.itemsize :]
        if not filler.missing:
            return len(rest)
    return len(rest)


def pieces(file: BinaryIO, path: Path, packing: str) -> Iterator[bytes]:
    """Yields the unpacked bytes in pieces of bounded size."""
    if packing == "raw":
        while piece := file.read(_PIECE):
            yield piece
        return
    try:
        yield from _gunzipped(file) if packing == "gzip" else _bunzipped(file)
    except (zlib.error, OSError, EOFError) as error:
        raise FormatError(f"{path}: its data cannot be unpacked ({packing}: {error}); the file is damaged") from error


def _gunzipped(file: BinaryIO) -> Iterator[bytes]:
    unpacker = zlib.decompressobj(wbits=47)  # gzip or zlib
    data = file.read(_PIECE)
    while data:
        yield unpacker.decompress(data, _PIECE)
        if unpacker.eof:  # another member may follow
            data = unpacker.unused_data or file.read(_PIECE)
            if data[:2] != b"\x1f\x8b":
                return
            unpacker = zlib.decompressobj(wbits=47)
            continue
        data = unpacker.unconsumed_tail or file.read(_PIECE)


def _bunzipped(file: BinaryIO) -> Iterator[bytes]:
    unpacker = bz2.BZ2Decompressor()
    while not unpacker.eof:
        data = file.read(_PIECE) if unpacker.needs_input else b""
        if unpacker.needs_input and not data:
            return
        yield unpacker.decompress(data, _PIECE)
