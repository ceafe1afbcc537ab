"""VTK's XML formats (.vtu, .vtp): text, base64 and raw data, without compression or with ZLib, LZ4 or LZMA."""

from __future__ import annotations

import base64
import binascii
import lzma
import mmap
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats import limits
from tensormass._src.mesh_formats.finish import sets_from_data
from tensormass._src.mesh_formats.kinds import ELEMENT_FIELDS, FIELD_ALIASES, SET_PREFIX
from tensormass._src.mesh_formats.raw import Block, FormatError, Ints, Raw
from tensormass._src.mesh_formats.text import _parse, shown
from tensormass._src.mesh_formats.vtk_cells import blocks_of, polygons

_TYPES = {
    **{f"Int{bits}": f"i{bits // 8}" for bits in (8, 16, 32, 64)},
    **{f"UInt{bits}": f"u{bits // 8}" for bits in (8, 16, 32, 64)},
    "Float32": "f4",
    "Float64": "f8",
}
_PARTS = {"Verts": "VERTICES", "Lines": "LINES", "Polys": "POLYGONS", "Strips": "TRIANGLE_STRIPS"}
_KINDS = ("UnstructuredGrid", "PolyData")
# Sizes of blocks of compressed data [bytes] up to which they are read; VTK itself makes them of 32 KiB.
_MAX_BLOCK = 1 << 28


def read(path: Path) -> Raw:
    """Reads a file. Raises FormatError that names the array."""
    return _Reader(path).read()


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as file:
            size = file.seek(0, 2)
            self._data: mmap.mmap | bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        self._root, self._appended_at = self._parsed()
        self._expanded = 0
        root = self._root
        if root.tag != "VTKFile" or root.get("type") not in _KINDS:
            raise FormatError(
                f"{path}: holds {root.get('type') or root.tag}, not {' or '.join(_KINDS)}; save an unstructured grid "
                "(.vtu) or a surface (.vtp)"
            )
        self._order: Literal["<", ">"] = ">" if root.get("byte_order") == "BigEndian" else "<"
        header = root.get("header_type", "UInt32")
        if header not in ("UInt32", "UInt64"):
            raise FormatError(f"{path}: header_type {shown(header)} is not UInt32 or UInt64")
        self._header = np.dtype(_TYPES[header]).newbyteorder(self._order)
        self._decompress = self._decompressor(root.get("compressor"))
        appended = root.find("AppendedData")
        self._base64 = appended is not None and appended.get("encoding", "base64") != "raw"

    def _parsed(self) -> tuple[ElementTree.Element, int]:
        """Returns the tree, and where appended data begin. These may hold any bytes, so they are cut out."""
        data = self._data
        begin, end = data.find(b"<AppendedData"), -1
        text: bytes
        if begin >= 0:
            end = data.find(b">", begin) + 1
            mark = data.find(b"_", end) + 1
            close = data.rfind(b"</AppendedData")
            if not end or not mark or close < mark:
                raise FormatError(f"{self._path}: AppendedData has no end; the file is cut off")
            text = data[:end] + data[close:]
        else:
            text, mark = data[:], 0
        if b"<!" in text.replace(b"<!--", b""):
            raise FormatError(f"{self._path}: declares a document type, which is not read; remove the line with `<!`")
        try:
            return ElementTree.fromstring(text), mark
        except (ElementTree.ParseError, LookupError, ValueError) as error:
            line = getattr(error, "position", (1, 0))[0]
            raise FormatError(f"{self._path}:{line}: not readable as XML: {error}; the file is damaged") from None

    def _decompressor(self, name: str | None) -> Callable[[bytes, int], bytes] | None:
        if not name:
            return None
        if name == "vtkZLibDataCompressor":
            return _inflate
        if name == "vtkLZMADataCompressor":
            return _unpack_lzma
        if name == "vtkLZ4DataCompressor":
            try:
                import lz4.block
            except ImportError:
                raise FormatError(
                    f"{self._path}: reading the compressor LZ4 needs lz4; install with: pip install "
                    "'tensormass[meshes]', or save with ZLib"
                ) from None
            return lambda piece, size: lz4.block.decompress(piece, uncompressed_size=size)
        raise FormatError(f"{self._path}: the compressor {shown(name)} is not known; save with ZLib, LZ4 or LZMA")

    def read(self) -> Raw:
        kind = self._root.get("type") or ""
        grid = self._root.find(kind)
        pieces = [] if grid is None else grid.findall("Piece")
        raws = [raw for piece in pieces if (raw := self._piece(kind, piece)) is not None]
        if not raws:
            raise FormatError(f"{self._path}: has no pieces with points; it is empty")
        return raws[0] if len(raws) == 1 else _joined(raws)

    def _piece(self, kind: str, piece: ElementTree.Element) -> Raw | None:
        points = piece.find("Points")
        array = None if points is None else points.find("DataArray")
        if array is None:
            return None
        positions = self._array(array)
        if positions.size == 0:
            return None
        if positions.ndim != 2 or positions.shape[1] != 3 or positions.dtype.kind != "f":
            raise FormatError(
                f"{self._path}: Points have shape {list(positions.shape)} of {positions.dtype}, not [n, 3]"
            )
        raw = Raw(positions, [])
        raw.place = lambda cell: f"{self._path}: cell {cell}"
        if kind == "PolyData":
            parts = {name: self._cells(found) for tag, name in _PARTS.items() if (found := piece.find(tag)) is not None}
            raw.blocks = polygons({name: part[:2] for name, part in parts.items()}, raw.place)
            return raw
        cells = piece.find("Cells")
        if cells is None:
            raise FormatError(f"{self._path}: a Piece has no Cells; it is cut off")
        offsets, connectivity, types = self._cells(cells)
        raw.blocks = blocks_of(types, offsets, connectivity, raw.place)
        raw.cell_data = self._data_of(piece.find("CellData"), sum(len(block.nodes) for block in raw.blocks))
        sets_from_data(raw, self._data_of(piece.find("PointData"), len(positions)))
        return raw

    def _cells(self, cells: ElementTree.Element) -> tuple[Ints, Ints, Ints]:
        arrays = {array.get("Name", "").lower(): array for array in cells.findall("DataArray")}
        found: list[Ints] = []
        for name in ("offsets", "connectivity", "types"):
            values = self._array(arrays[name]).reshape(-1) if name in arrays else np.empty(0, np.int64)
            if values.dtype.kind not in "iu":
                raise FormatError(f"{self._path}: the array {name!r} has numbers of type {values.dtype}, not integers")
            small = name != "offsets" and (not values.size or 0 <= values.min() <= values.max() < 1 << 31)
            found.append(values.astype(np.int32 if small else np.int64))
        return np.concatenate([[0], found[0]]), found[1], found[2]

    def _data_of(self, data: ElementTree.Element | None, count: int) -> dict[str, npt.NDArray[Any]]:
        """Reads the arrays that matter: sets and element fields."""
        found: dict[str, npt.NDArray[Any]] = {}
        for array in [] if data is None else data.findall("DataArray"):
            name = array.get("Name", "")
            if name.startswith(SET_PREFIX) or FIELD_ALIASES.get(name, name) in ELEMENT_FIELDS:
                values = self._array(array)
                if len(values) != count:
                    raise FormatError(f"{self._path}: the array {name!r} has {len(values)} rows, not {count}")
                found[name] = values
        return found

    def _array(self, array: ElementTree.Element) -> npt.NDArray[Any]:
        name = array.get("Name", "Points")
        where = f"{self._path}: the array {name!r}"
        kind = array.get("type", "")
        if kind not in _TYPES:
            raise FormatError(f"{where} has numbers of type {shown(kind)}; known are {', '.join(_TYPES)}")
        dtype = np.dtype(_TYPES[kind]).newbyteorder(self._order)
        form = array.get("format", "ascii").lower()
        if form == "ascii":
            values = self._ascii(array, dtype, where)
        elif form == "binary":
            values = self._decoded("".join((array.text or "").split()).encode("ascii", "replace"), dtype, where)
        elif form == "appended":
            values = self._appended(array, dtype, where)
        else:
            raise FormatError(f"{where} has the format {shown(form)}, not ascii, binary or appended")
        width = array.get("NumberOfComponents", "1")
        if not width.isdigit() or int(width) < 1 or len(values) % int(width):
            raise FormatError(f"{where} has {len(values)} numbers, which are not rows of {shown(width)}")
        values = values.astype(dtype.newbyteorder("="), copy=False)
        return values.reshape(-1, int(width)) if int(width) > 1 else values

    def _ascii(self, array: ElementTree.Element, dtype: np.dtype[np.generic], where: str) -> npt.NDArray[Any]:
        text = (array.text or "").encode("ascii", "replace")
        array.text = None
        values = _parse(text, dtype.kind in "iu") if text.strip() else np.empty(0, dtype)
        if values is None:
            wrong = next((word for word in text.split() if not _is_number(word)), b"")
            raise FormatError(f"{where}: {shown(wrong)} is not a number of type {array.get('type')}")
        return values.astype(dtype, copy=False)

    def _appended(self, array: ElementTree.Element, dtype: np.dtype[np.generic], where: str) -> npt.NDArray[Any]:
        offset = array.get("offset", "")
        at = self._appended_at + int(offset) if offset.isdigit() else -1
        if not self._appended_at or not 0 < at < len(self._data):
            raise FormatError(f"{where}: offset {shown(offset)} lies outside of the file; it is cut off")
        if not self._base64:
            return self._unpacked(lambda first, size: self._data[at + first : at + first + size], dtype, where)
        end = self._data.find(b"<", at)
        # Arrays follow each other; each part is padded by itself, so that decoding stops at its own end.
        return self._decoded(self._data[at:end], dtype, where)

    def _decoded(self, text: bytes, dtype: np.dtype[np.generic], where: str) -> npt.NDArray[Any]:
        """Decodes base64. The header is encoded by itself if data are compressed, together with them otherwise."""
        width = self._header.itemsize
        try:
            if self._decompress is None:
                size = int(np.frombuffer(base64.b64decode(text[: _encoded(width)]), self._header, 1)[0])
                if size > len(text):
                    raise FormatError(f"{where} has {size} bytes, more than the file has; it is cut off or damaged")
                data = base64.b64decode(text[: _encoded(width + size)])
                if len(data) < width + size:
                    raise FormatError(f"{where} has {len(data) - width} of {size} bytes; the file is cut off")
                return np.frombuffer(data[width : width + size - size % dtype.itemsize], dtype)
            head = base64.b64decode(text[: _encoded(3 * width)])
            count = int(np.frombuffer(head, self._header, 1)[0])
            if count > len(text):
                raise FormatError(f"{where} has {count} blocks, more than the file has bytes; it is damaged")
            length = _encoded((3 + count) * width)
            header = base64.b64decode(text[:length])
            total = sum(np.frombuffer(header[3 * width :], self._header, count).tolist()) if count else 0
            if total > len(text):
                raise FormatError(f"{where} has {total} bytes, more than the file has; it is cut off or damaged")
            data = header + base64.b64decode(text[length : length + _encoded(total)])
        except (binascii.Error, ValueError) as error:
            if isinstance(error, FormatError):
                raise
            raise FormatError(f"{where} is not readable as base64: {error}; the file is damaged") from None
        return self._unpacked(lambda first, size: data[first : first + size], dtype, where)

    def _unpacked(self, at: Callable[[int, int], bytes], dtype: np.dtype[np.generic], where: str) -> npt.NDArray[Any]:
        width = self._header.itemsize

        def numbers(first: int, count: int) -> list[int]:
            piece = at(first * width, count * width)
            if len(piece) < count * width:
                raise FormatError(f"{where} ends within its header; the file is cut off")
            return [int(number) for number in np.frombuffer(piece, self._header)]

        if self._decompress is None:
            (size,) = numbers(0, 1)
            data = at(width, size) if size <= len(self._data) else b""
            if len(data) < size:
                raise FormatError(f"{where} has {len(data)} of {size} bytes; the file is cut off")
            return np.frombuffer(data[: size - size % dtype.itemsize], dtype)
        (blocks,) = numbers(0, 1)
        if not blocks:
            return np.empty(0, dtype)
        if blocks > len(self._data):
            raise FormatError(f"{where} has {blocks} blocks, more than the file has bytes; it is damaged")
        _, size, last = numbers(0, 3)
        sizes = [size] * (blocks - 1) + [last or size]
        if max(size, last) > _MAX_BLOCK:
            raise FormatError(f"{where} has blocks of {max(size, last)} bytes, beyond the limit of {_MAX_BLOCK}")
        packed = numbers(3, blocks)
        if max(packed) > len(self._data):
            raise FormatError(f"{where} has a block of {max(packed)} bytes, more than the file has; it is damaged")
        if sum(sizes) % dtype.itemsize:
            raise FormatError(f"{where} has {sum(sizes)} bytes, not whole numbers of {dtype.itemsize}; it is damaged")
        self._expanded += sum(sizes)
        most = limits.MAX_EXPANSION * len(self._data)
        if self._expanded > max(most, limits.MEMORY_FLOOR):
            raise FormatError(
                f"{where} expands to {sum(sizes)} bytes, beyond the limit for the file's size; it is damaged"
            )
        if self._expanded <= most:
            limits.allow(sum(sizes))
        out = np.empty(sum(sizes), np.uint8)
        first = 0
        for block in self._blocks(at, packed, sizes, width, where):
            out[first : first + len(block)] = np.frombuffer(block, np.uint8)
            first += len(block)
        return out.view(dtype)

    def _blocks(
        self, at: Callable[[int, int], bytes], packed: list[int], sizes: list[int], width: int, where: str
    ) -> Iterator[bytes]:
        assert self._decompress is not None
        first = (3 + len(packed)) * width
        for index, (length, size) in enumerate(zip(packed, sizes, strict=True)):
            try:
                block = self._decompress(at(first, length), size)
            except Exception as error:
                raise FormatError(f"{where}: block {index} is damaged: {error}") from None
            if len(block) != size:
                raise FormatError(f"{where}: block {index} has {len(block)} of {size} bytes; the file is damaged")
            yield block
            first += length


def _encoded(size: int) -> int:
    return (size + 2) // 3 * 4


def _inflate(piece: bytes, size: int) -> bytes:
    return zlib.decompressobj().decompress(piece, size + 1)


def _unpack_lzma(piece: bytes, size: int) -> bytes:
    return lzma.LZMADecompressor(memlimit=_MAX_BLOCK).decompress(piece, size + 1)


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _joined(raws: list[Raw]) -> Raw:
    """Joins the pieces of a file. Data of cells stay if every piece has them."""
    first = raws[0]
    out = Raw(np.concatenate([raw.points for raw in raws]), [], place=first.place)
    points = cells = 0
    for raw in raws:
        for block in raw.blocks:
            rows = block.rows
            rows = (
                slice(rows.start + cells, rows.start + cells + len(block.nodes))
                if isinstance(rows, slice)
                else rows + cells
            )
            out.blocks.append(Block(block.kind, block.nodes + points, rows))
        for sets, own, shift in (
            (out.node_sets, raw.node_sets, points),
            (out.cell_sets, raw.cell_sets, cells),
        ):
            for name, members in own.items():
                sets[name] = np.concatenate([sets.get(name, np.empty(0, np.int64)), members + shift])
        points += len(raw.points)
        cells += sum(len(block.nodes) for block in raw.blocks)
    shared = set.intersection(*(set(raw.cell_data) for raw in raws))
    out.cell_data = {name: np.concatenate([raw.cell_data[name] for raw in raws]) for name in sorted(shared)}
    return out
