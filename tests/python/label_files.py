"""Label maps for tests, written byte by byte: an asymmetric shape with any orientation, in each format that is read."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
_NRRD_TYPES = {"u1": "unsigned char", "i2": "short", "u2": "ushort", "i4": "int", "f4": "float", "f8": "double"}
_NIFTI_TYPES = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768, "i8": 1024, "u8": 1280}


def shape(spacing_m: Sequence[float] = (2e-3, 2e-3, 2e-3), size_m: float = 0.06) -> npt.NDArray[np.uint8]:
    """A body with three arms of different lengths along x, y and z from a corner (label 1), on a plate (label 2)."""
    counts = [round(size_m / step) for step in spacing_m]
    x, y, z = np.meshgrid(*((np.arange(n) + 0.5) / n for n in counts), indexing="ij")
    thin = 0.45
    arms = (
        ((x < 0.9) & (y < thin) & (z < thin))
        | ((x < thin) & (y < 0.7) & (z < thin))
        | ((x < thin) & (y < thin) & (z < 0.55))
    )
    out = np.zeros(counts, np.uint8)
    inner = (x > 0.1) & (y > 0.1) & (z > 0.2)
    out[arms & inner] = 1
    out[(z < 0.2) & (z > 0.05) & (x > 0.1) & (x < 0.9) & (y > 0.1) & (y < 0.7)] = 2
    return out


def oblique(spacing_m: Sequence[float], *, mirrored: bool = False) -> Floats:
    """Index -> LPS [m] of a turned image, [4, 4]."""
    a, b, c = np.radians([25, -40, 65])
    turn = (
        np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
        @ np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        @ np.array([[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]])
    )
    out = np.eye(4)
    out[:3, :3] = turn * spacing_m * ([1, 1, -1] if mirrored else [1, 1, 1])
    out[:3, 3] = [0.03, -0.12, 0.2]
    return out


def straight(spacing_m: Sequence[float]) -> Floats:
    """Index -> LPS [m] of an image along the axes."""
    return np.diag([*spacing_m, 1.0])


def center_m(voxels: npt.NDArray[np.uint8], affine: Floats, label: int = 1) -> Floats:
    """Centre of a label's voxels in LPS."""
    return affine[:3, :3] @ np.argwhere(voxels == label).mean(axis=0) + affine[:3, 3]


def nrrd(
    path: Path,
    voxels: npt.NDArray[np.generic],
    affine_m: Floats,
    *,
    space: str = "left-posterior-superior",
    unit: str = "",
    encoding: str = "gzip",
    names: Mapping[int, str] | None = None,
    more: str = "",
    order: Literal["<", ">"] = "<",
) -> Path:
    """Writes an NRRD file. Voxels are [i, j, k], or [layer, i, j, k] with the names of the segments in `more`."""
    scale = {"": 1e3, "mm": 1e3, "m": 1.0, "um": 1e6}[unit]
    signs = {"left": 1, "right": -1, "posterior": 1, "anterior": -1, "superior": 1}
    flip = np.array([signs[word] for word in space.split("-")])
    columns = (affine_m[:3] * flip[:, np.newaxis] * scale).T
    vectors = [f"({','.join(repr(float(x)) for x in column)})" for column in columns]
    layered = voxels.ndim == 4
    lines = [
        "NRRD0004",
        f"type: {_NRRD_TYPES[voxels.dtype.str[1:]]}",
        f"dimension: {voxels.ndim}",
        f"space: {space}",
        f"sizes: {' '.join(map(str, voxels.shape))}",
        f"space directions: {'none ' if layered else ''}{' '.join(vectors[:3])}",
        f"kinds: {'list ' if layered else ''}domain domain domain",
        f"endian: {'little' if order == '<' else 'big'}",
        f"encoding: {encoding}",
        f"space origin: {vectors[3]}",
    ]
    if unit:
        lines.append(f'space units: "{unit}" "{unit}" "{unit}"')
    for number, (label, name) in enumerate((names or {}).items()):
        lines += [f"Segment{number}_Name:={name}", f"Segment{number}_LabelValue:={label}", f"Segment{number}_Layer:=0"]
    if more:
        lines.append(more)
    data = voxels.astype(voxels.dtype.newbyteorder(order)).tobytes(order="F")
    if encoding in ("ascii", "text"):
        data = " ".join(map(str, voxels.ravel(order="F"))).encode()
    packed = gzip.compress(data, mtime=0) if encoding in ("gzip", "gz") else data
    path.write_bytes("\n".join(lines).encode() + b"\n\n" + packed)
    return path


def nifti(
    path: Path,
    voxels: npt.NDArray[np.generic],
    affine_m: Floats | None,
    *,
    form: str = "sform",
    unit: int = 2,
    slope: float = 0.0,
    intercept: float = 0.0,
    version: int = 1,
    order: Literal["<", ">"] = "<",
    wrong_qform: bool = False,
) -> Path:
    """Writes a NIfTI file with the orientation as sform, qform, or none. An affine map in LPS; the file has RAS."""
    scale = {0: 1e3, 1: 1.0, 2: 1e3, 3: 1e6}[unit & 7]
    ras = np.eye(4) if affine_m is None else np.diag([-1, -1, 1, 1]) @ affine_m
    ras[:3] *= scale
    spacing = np.linalg.norm(ras[:3, :3], axis=0)
    turn = ras[:3, :3] / spacing
    qfac = 1.0
    if np.linalg.det(turn) < 0:
        qfac, turn = -1.0, turn * [1, 1, -1]
    quaternion = _quaternion(turn)
    codes = {"sform": (0, 1), "qform": (1, 0), "none": (0, 0), "both": (1, 1)}[form]
    offsets = ras[:3, 3] + (5.0 if wrong_qform else 0.0)
    dim = [3, *voxels.shape, 1, 1, 1, 1]
    pixdim = [qfac, *spacing, 0, 0, 0, 0]
    kind = voxels.dtype.str[1:]
    head = bytearray(352 if version == 1 else 544)
    bits = 8 * voxels.dtype.itemsize
    if version == 1:
        struct.pack_into(order + "i", head, 0, 348)
        struct.pack_into(order + "8h", head, 40, *dim)
        struct.pack_into(order + "2h", head, 70, _NIFTI_TYPES[kind], bits)
        struct.pack_into(order + "8f", head, 76, *pixdim)
        struct.pack_into(order + "3f", head, 108, 352, slope, intercept)
        head[123] = unit
        struct.pack_into(order + "2h", head, 252, *codes)
        struct.pack_into(order + "6f", head, 256, *quaternion, *offsets)
        struct.pack_into(order + "12f", head, 280, *ras[:3].reshape(-1))
        head[344:348] = b"n+1\0"
    else:
        struct.pack_into(order + "i", head, 0, 540)
        head[4:12] = b"n+2\0\r\n\x1a\n"
        struct.pack_into(order + "2h", head, 12, _NIFTI_TYPES[kind], bits)
        struct.pack_into(order + "8q", head, 16, *dim)
        struct.pack_into(order + "8d", head, 104, *pixdim)
        struct.pack_into(order + "q", head, 168, 544)
        struct.pack_into(order + "2d", head, 176, slope, intercept)
        struct.pack_into(order + "2i", head, 344, *codes)
        struct.pack_into(order + "6d", head, 352, *quaternion, *offsets)
        struct.pack_into(order + "12d", head, 400, *ras[:3].reshape(-1))
        struct.pack_into(order + "i", head, 500, unit)
    data = bytes(head) + voxels.astype(voxels.dtype.newbyteorder(order)).tobytes(order="F")
    path.write_bytes(gzip.compress(data, mtime=0) if path.suffix == ".gz" else data)
    return path


def _quaternion(turn: Floats) -> list[float]:
    """b, c, d of a rotation whose a is positive, as NIfTI stores it."""
    a = np.sqrt(max(1 + np.trace(turn), 1e-12)) / 2
    if a > 1e-3:
        return [
            (turn[2, 1] - turn[1, 2]) / (4 * a),
            (turn[0, 2] - turn[2, 0]) / (4 * a),
            (turn[1, 0] - turn[0, 1]) / (4 * a),
        ]
    values, vectors = np.linalg.eigh(turn)
    return list(vectors[:, np.argmax(values)])
