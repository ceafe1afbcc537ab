"""NIfTI (.nii, .nii.gz), versions 1 and 2.

Format: https://nifti.nimh.nih.gov/nifti-1 and nifti-2. Its space is RAS+, and is turned into LPS here.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import numpy.typing as npt

from tensormass._src.label_formats import content, unpacking
from tensormass._src.label_formats.content import Filler, Labels
from tensormass._src.mesh_formats import limits
from tensormass._src.mesh_formats.raw import FormatError

_SIZES = {348: 1, 540: 2}
_TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
_OTHER_TYPES = {1: "bits", 32: "complex numbers", 128: "colours", 1536: "float128", 1792: "complex numbers"}
_OTHER_TYPES |= {2048: "complex numbers", 2304: "colours"}
#: Bits of xyzt_units that say the unit of length.
_UNITS = {0: None, 1: 1.0, 2: 1e-3, 3: 1e-6}
_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
# A difference of qform and sform below this share of a voxel is rounding.
_SAME = 0.01


def read(path: Path) -> Labels:
    """Reads a file. Raises FormatError with its field."""
    with path.open("rb") as file:
        packing = "gzip" if file.read(2) == b"\x1f\x8b" else "raw"
        file.seek(0)
        head = _first(file, path, packing)
        file.seek(0)
        header = _Header(path, head)
        limits.allow(2 * header.count)
        filler = Filler(path, header.count, header.slope, header.intercept)
        left = unpacking.fill(filler, file, path, packing, header.dtype, header.offset)
        notes = header.notes
        if left:
            notes.append(f"{left} bytes or more after the voxels are skipped")
        voxels = filler.result().reshape(header.sizes[::-1]).T
    return Labels(voxels[np.newaxis], header.affine(), [], notes, header.unit_m)


def _first(file: BinaryIO, path: Path, packing: str) -> bytes:
    head = b""
    for piece in unpacking.pieces(file, path, packing):
        head += piece
        if len(head) >= 540:
            break
    return head[:540]


class _Header:
    """The header's fields that matter, checked."""

    def __init__(self, path: Path, head: bytes) -> None:
        self.path = path
        self.notes: list[str] = []
        order, version = self._version(head)
        get = struct.Struct
        if version == 1:
            magic = head[344:347]
            dim = get(order + "8h").unpack_from(head, 40)
            datatype, bits = get(order + "hh").unpack_from(head, 70)
            self._pixdim = get(order + "8f").unpack_from(head, 76)
            offset, slope, intercept = get(order + "3f").unpack_from(head, 108)
            units = head[123]
            self._codes = get(order + "2h").unpack_from(head, 252)
            self._quaternion = get(order + "6f").unpack_from(head, 256)
            self._rows = get(order + "12f").unpack_from(head, 280)
        else:
            magic = head[4:7]
            datatype, bits = get(order + "hh").unpack_from(head, 12)
            dim = get(order + "8q").unpack_from(head, 16)
            self._pixdim = get(order + "8d").unpack_from(head, 104)
            (offset,) = get(order + "q").unpack_from(head, 168)
            slope, intercept = get(order + "2d").unpack_from(head, 176)
            self._codes = get(order + "2i").unpack_from(head, 344)
            self._quaternion = get(order + "6d").unpack_from(head, 352)
            self._rows = get(order + "12d").unpack_from(head, 400)
            (units,) = get(order + "i").unpack_from(head, 500)
        if magic != (b"n+1", b"n+2")[version - 1]:
            raise FormatError(
                f"{path}: is the header of a pair (.hdr and .img) or damaged (magic {magic!r}); save it as one .nii"
            )
        self.sizes = self._checked_sizes(dim)
        self.count = content.checked_sizes(path, self.sizes)
        self.dtype = self._checked_type(datatype, order)
        if bits != 8 * self.dtype.itemsize:
            raise FormatError(f"{path}: bitpix {bits}: datatype {datatype} has {8 * self.dtype.itemsize} bits")
        self.offset = self._checked_offset(offset, 352 if version == 1 else 544)
        self.slope, self.intercept = self._checked_scale(float(slope), float(intercept))
        self.unit_m = self._checked_unit(units)

    def _version(self, head: bytes) -> tuple[Literal["<", ">"], int]:
        orders: tuple[Literal["<"], Literal[">"]] = ("<", ">")
        for order in orders:
            if len(head) >= 4 and (size := struct.unpack_from(order + "i", head)[0]) in _SIZES:
                if len(head) < size:
                    break
                return order, _SIZES[size]
        raise FormatError(f"{self.path}: expected a header of 348 or 540 bytes; this is not a NIfTI file, or cut off")

    def _checked_sizes(self, dim: tuple[int, ...]) -> list[int]:
        if not 1 <= dim[0] <= 7:
            raise FormatError(f"{self.path}: dim[0] {dim[0]}: must be 1 to 7; the file is damaged")
        sizes = [*dim[1 : dim[0] + 1], 1, 1][: max(3, dim[0])]
        if any(size > 1 for size in sizes[3:]):
            raise FormatError(
                f"{self.path}: dim {list(dim[: dim[0] + 1])}: several volumes in one file; save one of them alone"
            )
        return list(sizes[:3])

    def _checked_type(self, datatype: int, order: Literal["<", ">"]) -> np.dtype[Any]:
        if datatype not in _TYPES:
            what = _OTHER_TYPES.get(datatype, "unknown")
            raise FormatError(f"{self.path}: datatype {datatype} ({what}): labels are whole numbers; save a label map")
        return np.dtype(_TYPES[datatype]).newbyteorder(order)

    def _checked_offset(self, offset: float, least: int) -> int:
        if offset == 0:
            return least
        if not least <= offset < 1 << 32 or offset != int(offset):
            raise FormatError(f"{self.path}: vox_offset {offset:g}: expected at least {least}; the file is damaged")
        return int(offset)

    def _checked_scale(self, slope: float, intercept: float) -> tuple[float, float]:
        """A slope of 0 means no scaling. Programs write NaN for the same."""
        if slope == 0 or np.isnan(slope):
            return 1.0, 0.0
        if not np.isfinite([slope, intercept]).all():
            raise FormatError(f"{self.path}: scl_slope {slope:g}, scl_inter {intercept:g}: not finite; write it again")
        return slope, intercept

    def _checked_unit(self, units: int) -> float:
        code = units & 7
        if code not in _UNITS:
            raise FormatError(f"{self.path}: xyzt_units {units}: its unit of length is not m, mm or um; write it again")
        unit_m = _UNITS[code]
        if unit_m is None:
            self.notes.append("names no unit of length, and is taken as millimetres")
            return 1e-3
        return unit_m

    def affine(self) -> npt.NDArray[np.float64]:
        """Returns the map from indices to LPS [m]: of the sform, else the qform, else of the spacings alone."""
        qform, sform = self._codes
        out = None
        if sform > 0:
            out = np.vstack([np.array(self._rows, np.float64).reshape(3, 4), [0, 0, 0, 1]])
        if qform > 0:
            other = self._of_quaternion()
            if out is None:
                out = other
            else:
                self._compare(out, other)
        if out is None:
            out = np.diag([*self._spacings(), 1.0])
            # The axes have no direction, so their order is the only one there is.
            self.notes.append("has no orientation (qform_code and sform_code are 0); its axes are taken as RAS")
        out = _LPS @ out
        out[:3] *= self.unit_m
        return content.checked_affine(self.path, out)

    def _spacings(self) -> npt.NDArray[np.float64]:
        # Some programs write negative spacings; the standard has none.
        return np.abs(np.array(self._pixdim[1:4], np.float64))

    def _of_quaternion(self) -> npt.NDArray[np.float64]:
        b, c, d = (float(part) for part in self._quaternion[:3])
        squared = 1.0 - (b * b + c * c + d * d)
        if not squared > -1e-3:
            raise FormatError(f"{self.path}: quatern_b, c, d {b:g}, {c:g}, {d:g}: not a rotation; write it again")
        a = np.sqrt(max(squared, 0.0))
        b, c, d = np.array([b, c, d]) / max(np.sqrt(a * a + b * b + c * c + d * d), 1e-12)
        turn = np.array(
            [
                [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
                [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
                [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
            ]
        )
        out = np.eye(4)
        out[:3, :3] = turn * self._spacings() * [1, 1, -1 if self._pixdim[0] < 0 else 1]
        out[:3, 3] = self._quaternion[3:]
        return out

    def _compare(self, sform: npt.NDArray[np.float64], qform: npt.NDArray[np.float64]) -> None:
        corners = np.array([[i, j, k, 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)], np.float64)
        corners[:, :3] *= np.array(self.sizes) - 1
        off = float(np.linalg.norm(corners @ (sform - qform).T, axis=1).max())
        voxel = float(np.linalg.norm(sform[:3, :3], axis=0).min())
        if not off <= _SAME * voxel:
            self.notes.append(
                f"has a qform and an sform that differ by up to {off:.3g} in its unit; the sform is used: if that is "
                "wrong, set sform_code to 0"
            )
