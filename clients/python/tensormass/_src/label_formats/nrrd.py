"""NRRD (.nrrd, .nhdr) and segmentations of 3D Slicer (.seg.nrrd), which are NRRD with names of segments.

Format: https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from tensormass._src.label_formats import content, unpacking
from tensormass._src.label_formats.content import Filler, Labels, Segment
from tensormass._src.mesh_formats import limits
from tensormass._src.mesh_formats.raw import FormatError
from tensormass._src.mesh_formats.text import shown

# Longest header and line of it [bytes].
_MAX_HEADER = 1 << 22
_MAX_LINE = 1 << 20
_MAX_DIMENSION = 16
_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": (
        "longlong",
        "long long",
        "long long int",
        "signed long long",
        "signed long long int",
        "int64",
        "int64_t",
    ),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_DTYPES = {name: dtype for dtype, names in _TYPES.items() for name in names}
#: Signs that turn a space into LPS.
_SPACES = {
    "left-posterior-superior": (1, 1, 1),
    "lps": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "ras": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
    "las": (1, -1, 1),
}
_PACKINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
_TEXTS = ("ascii", "text", "txt")
_VECTOR = re.compile(r"none|\(([^()]*)\)")
_SEGMENT = re.compile(r"Segment(\d{1,6})_(\w+)")


def read(path: Path) -> Labels:
    """Reads a file. Raises FormatError with its field."""
    with path.open("rb") as file:
        fields, values, detached = _header(file, path)
        if not detached:
            return _labels(path, path, file, fields, values)
    data_path = _data_path(path, fields)
    limits.allow_file(data_path)
    with data_path.open("rb") as file:
        return _labels(path, data_path, file, fields, values)


def _header(file: BinaryIO, path: Path) -> tuple[dict[str, str], dict[str, str], bool]:
    """Returns the fields, the pairs of key and value, and whether the data are in another file."""
    if not re.fullmatch(rb"NRRD000\d", file.readline(_MAX_LINE).strip()):
        raise FormatError(f"{path}:1: expected NRRD0001 to NRRD0005; this is not an NRRD file")
    fields: dict[str, str] = {}
    values: dict[str, str] = {}
    number = 1
    while True:
        line = file.readline(_MAX_LINE)
        number += 1
        if file.tell() > _MAX_HEADER or len(line) == _MAX_LINE:
            raise FormatError(f"{path}:{number}: a header of more than {_MAX_HEADER >> 20} MiB; the file is damaged")
        text = line.decode("utf-8", "replace").rstrip("\r\n")
        if not text:
            detached = "data file" in fields
            if not line and not detached:
                raise FormatError(f"{path}:{number}: the header has no end; the file is cut off")
            return fields, values, detached
        if text.startswith("#"):
            continue
        key, mark, value = text.partition(":=")
        if mark and ": " not in key:
            values[key.strip()] = value.strip()
            continue
        key, mark, value = text.partition(":")
        if not mark:
            raise FormatError(f"{path}:{number}: expected `field: value`, found {shown(line.strip())}")
        key = " ".join(key.lower().split())
        fields[{"datafile": "data file", "centerings": "centers", "lineskip": "line skip"}.get(key, key)] = (
            value.strip()
        )


def _data_path(path: Path, fields: dict[str, str]) -> Path:
    name = fields["data file"]
    if not name or name.startswith("LIST") or "%" in name:
        raise FormatError(f"{path}: data file {shown(name)}: data in several files are not read; save it as one .nrrd")
    # A file that comes from strangers must not name others of this machine.
    if Path(name).name != name or name in (".", ".."):
        raise FormatError(f"{path}: data file {shown(name)}: must lie beside it; save it as one .nrrd")
    if not (path.parent / name).is_file():
        raise FormatError(f"{path}: data file {shown(name)}: there is no such file beside it")
    return path.parent / name


def _labels(path: Path, data_path: Path, file: BinaryIO, fields: dict[str, str], values: dict[str, str]) -> Labels:
    for field in ("type", "dimension", "sizes", "encoding"):
        if field not in fields:
            raise FormatError(f"{path}: has no field `{field}`; the file is damaged")
    if values.get("Segmentation_MasterRepresentation", values.get("Segmentation_SourceRepresentation", "")).startswith(
        "Fractional"
    ):
        raise FormatError(f"{path}: is a fractional segmentation; save it as a binary one (Binary labelmap)")
    dimension = _whole(path, fields, "dimension")[0]
    if not 1 <= dimension <= _MAX_DIMENSION:
        raise FormatError(f"{path}: dimension {dimension}: must be 1 to {_MAX_DIMENSION}")
    sizes = _whole(path, fields, "sizes")
    if len(sizes) != dimension:
        raise FormatError(f"{path}: sizes {sizes}: the dimension is {dimension}; the file is damaged")
    count = content.checked_sizes(path, sizes)
    notes: list[str] = []
    list_axis, affine, unit_m = _axes(path, fields, sizes, notes)
    affine[:3] *= unit_m
    voxels = _voxels(path, data_path, file, fields, count, notes).reshape(sizes[::-1]).T
    voxels = np.moveaxis(voxels, list_axis, 0) if list_axis is not None else voxels[np.newaxis]
    return Labels(voxels, content.checked_affine(path, affine), _segments(path, values, len(voxels)), notes, unit_m)


def _whole(path: Path, fields: dict[str, str], name: str) -> list[int]:
    try:
        numbers = [int(word) for word in fields[name].split()]
    except ValueError:
        numbers = []
    if not numbers or any(abs(number) > 1 << 40 for number in numbers):
        raise FormatError(f"{path}: {name} {shown(fields[name])}: expected whole numbers")
    return numbers


def _axes(
    path: Path, fields: dict[str, str], sizes: list[int], notes: list[str]
) -> tuple[int | None, npt.NDArray[np.float64], float]:
    """Returns the axis of layers, if there is one, the affine map of the others, and its unit [m]."""
    affine = np.eye(4)
    space = fields.get("space", "").lower().strip('"')
    directions = _vectors(path, fields, "space directions")
    spatial = [axis for axis, vector in enumerate(directions) if vector is not None]
    if directions and len(directions) != len(sizes):
        raise FormatError(f"{path}: space directions: {len(directions)} of them for {len(sizes)} axes")
    if not directions:
        # A list of layers comes first where a file has one.
        spatial = list(range(len(sizes)))[-3:]
        kinds = fields.get("kinds", "").split()
        if len(kinds) == len(sizes) and len(sizes) == 4:
            spatial = [axis for axis, kind in enumerate(kinds) if kind in ("domain", "space")]
    others = [axis for axis in range(len(sizes)) if axis not in spatial]
    if len(spatial) != 3 or len(others) > 1:
        raise FormatError(
            f"{path}: has {len(spatial)} axes in space and {len(others)} others; expected 3, and one of layers at "
            "most; save one volume alone"
        )
    units = re.findall(r'"([^"]*)"', fields.get("space units", ""))
    if directions:
        for column, axis in enumerate(spatial):
            affine[:3, column] = directions[axis]
        origin = _vectors(path, fields, "space origin")
        if origin and origin[0] is not None:
            affine[:3, 3] = origin[0]
    else:
        spacings = fields.get("spacings", "").split()
        for column, axis in enumerate(spatial):
            affine[column, column] = _number(path, "spacings", spacings[axis]) if axis < len(spacings) else 1.0
        units = [unit for axis, unit in enumerate(re.findall(r'"([^"]*)"', fields.get("units", ""))) if axis in spatial]
        notes.append("has no orientation (space directions), and its axes are taken as left, back and head")
    if space in _SPACES:
        affine[:3] *= np.array(_SPACES[space])[:, np.newaxis]
    elif directions:
        notes.append(
            f"has the space {shown(space)}, which does not say where left and back are; it is taken as LPS"
            if space
            else "names no space, and is taken as LPS"
        )
    return (others[0] if others else None), affine, _unit(path, units)


def _unit(path: Path, units: list[str]) -> float:
    named = {unit for unit in units if unit}
    if not named:
        return 1e-3  # 3D Slicer and ITK write no unit and mean millimetres
    found = {content.metres(unit) for unit in named}
    unit_m = found.pop()
    if unit_m is None or found:
        raise FormatError(f"{path}: space units {', '.join(sorted(named))}: expected one of mm, m and um for all axes")
    return unit_m


def _vectors(path: Path, fields: dict[str, str], name: str) -> list[tuple[float, ...] | None]:
    text = fields.get(name, "")
    out: list[tuple[float, ...] | None] = []
    for match in _VECTOR.finditer(text):
        if match[0] == "none":
            out.append(None)
            continue
        vector = tuple(_number(path, name, word) for word in match[1].split(","))
        if len(vector) != 3:
            raise FormatError(f"{path}: {name} {shown(match[0])}: expected three numbers")
        out.append(vector)
    if text and not out:
        raise FormatError(f"{path}: {name} {shown(text)}: expected vectors such as (1,0,0)")
    return out


def _number(path: Path, name: str, word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise FormatError(f"{path}: {name}: expected a number, found {shown(word)}") from None


def _voxels(
    path: Path, data_path: Path, file: BinaryIO, fields: dict[str, str], count: int, notes: list[str]
) -> npt.NDArray[np.uint16]:
    name = fields["type"].lower()
    if name not in _DTYPES:
        raise FormatError(f"{path}: type {shown(fields['type'])}: labels are whole numbers; save a label map")
    encoding = fields["encoding"].lower()
    if encoding not in _PACKINGS and encoding not in _TEXTS:
        known = ", ".join((*_PACKINGS, *_TEXTS))
        raise FormatError(f"{path}: encoding {shown(encoding)}: known are {known}; save it again")
    order = fields.get("endian", "little").lower()
    if order not in ("little", "big"):
        raise FormatError(f"{path}: endian {shown(order)}: expected little or big")
    dtype = np.dtype(_DTYPES[name]).newbyteorder("<" if order == "little" else ">")
    for _ in range(_skip(path, fields, "line skip")):
        if not file.readline(_MAX_LINE):
            raise FormatError(f"{data_path}: line skip {fields['line skip']}: the file has fewer lines")
    skip = _skip(path, fields, "byte skip")
    limits.allow(2 * count)
    filler = Filler(data_path, count)
    if encoding in _TEXTS:
        _read_text(filler, file, data_path)
        return filler.result()
    packing = _PACKINGS[encoding]
    if skip == -1:
        if packing != "raw":
            raise FormatError(f"{path}: byte skip -1: only raw data can be counted from their end")
        size = file.seek(0, 2)
        if size < count * dtype.itemsize:
            raise FormatError(f"{data_path}: has {size} bytes, fewer than its {count} voxels; it is cut off")
        file.seek(size - count * dtype.itemsize)
        skip = 0
    if left := unpacking.fill(filler, file, data_path, packing, dtype, skip):
        notes.append(f"{left} bytes or more after the voxels are skipped")
    return filler.result()


def _skip(path: Path, fields: dict[str, str], name: str) -> int:
    if name not in fields:
        return 0
    number = _whole(path, fields, name)[0]
    if number < (-1 if name == "byte skip" else 0) or number > 1 << 32:
        raise FormatError(f"{path}: {name} {number}: not possible")
    return number


def _read_text(filler: Filler, file: BinaryIO, path: Path) -> None:
    rest = b""
    while filler.missing:
        piece = file.read(1 << 20)
        data = rest + piece
        words = data.split()
        rest = b""
        if piece and words and not data[-1:].isspace():
            rest = words.pop()
            if len(rest) > _MAX_LINE:
                break
        try:
            numbers = np.array([float(word) for word in words[: filler.missing]])
        except ValueError:
            raise FormatError(f"{path}: its voxels are not all numbers; the file is damaged") from None
        filler.take(numbers)
        if not piece:
            return


def _segments(path: Path, values: dict[str, str], layers: int) -> list[Segment]:
    found: dict[int, dict[str, str]] = {}
    for key, value in values.items():
        if match := _SEGMENT.fullmatch(key):
            found.setdefault(int(match[1]), {})[match[2]] = value
    if len(found) > content.MAX_SEGMENTS:
        raise FormatError(f"{path}: names {len(found)} segments, more than {content.MAX_SEGMENTS}")
    out = []
    for number, of in sorted(found.items()):
        name = of.get("Name") or of.get("ID") or f"Segment{number}"
        try:
            label, layer = int(of.get("LabelValue", number + 1)), int(of.get("Layer", 0))
        except ValueError:
            label, layer = -1, -1
        if not 0 < label <= content.MAX_LABEL or not 0 <= layer < layers:
            raise FormatError(
                f"{path}: segment {shown(name)}: label {shown(of.get('LabelValue', ''))} in layer "
                f"{shown(of.get('Layer', '0'))}: expected a label of 1 to {content.MAX_LABEL}, a layer below {layers}"
            )
        out.append(Segment(name, label, layer, _term(of.get("Tags", "")), _color(of.get("Color", ""))))
    return out


def _term(tags: str) -> str:
    """Returns the type of a segment in 3D Slicer's terminology: `...~SCT^39607008^Lung~...` -> `Lung`."""
    for tag in tags.split("|"):
        if tag.startswith("TerminologyEntry:"):
            parts = tag.split("~")
            if len(parts) > 2 and (words := parts[2].split("^")) and len(words) == 3:
                return words[2]
    return ""


def _color(text: str) -> tuple[float, float, float] | None:
    try:
        red, green, blue = (float(word) for word in text.split())
    except ValueError:
        return None
    return (red, green, blue) if all(0 <= part <= 1 for part in (red, green, blue)) else None
