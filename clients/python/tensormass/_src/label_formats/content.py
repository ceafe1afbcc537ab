"""The content of a label map: voxels, their place in the patient, and the names of segments."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass._src.mesh_formats.raw import FormatError

#: Most voxels of a file, all layers together (512 × 512 × 1024). A larger file is refused before memory is taken.
MAX_VOXELS = 1 << 28
#: Largest label. Labels are kept in 16 bits.
MAX_LABEL = 0xFFFF
#: Most segments that a header may name.
MAX_SEGMENTS = 4096
# A value may be off a whole number by this, because scaled values are rounded.
_WHOLE = 1e-3
_METRES = {"m": 1.0, "mm": 1e-3, "um": 1e-6}


@dataclass(frozen=True)
class Segment:
    """A named part of a label map."""

    #: Name in the file.
    name: str
    #: Its voxels have this value.
    label: int
    #: Index into the first axis of `Labels.voxels`. Segments of several layers may overlap.
    layer: int = 0
    #: Name of the file's terminology, such as `Lung`; empty if it has none.
    term: str = ""
    #: Red, green and blue (0 to 1), if the file has them.
    color: tuple[float, float, float] | None = None


@dataclass
class Labels:
    """A label map. Its space is LPS: x to the patient's left, y to the back, z to the head."""

    #: uint16 [layers, i, j, k].
    voxels: npt.NDArray[np.uint16]
    #: float64 [4, 4]: index (i, j, k, 1) of a voxel's centre -> LPS [m].
    affine: npt.NDArray[np.float64]
    #: Segments that the file names; empty: each label is a segment with its number as name.
    segments: list[Segment]
    #: What the reader left out or assumed.
    notes: list[str] = field(default_factory=list)
    #: Unit of the file [m].
    unit_m: float = 1e-3


class Filler:
    """Takes the values of a file piece by piece and keeps them as labels, which must be whole numbers."""

    def __init__(self, path: Path, count: int, slope: float = 1.0, intercept: float = 0.0) -> None:
        self._path = path
        self._out = np.empty(count, np.uint16)
        self._done = 0
        self._slope, self._intercept = slope, intercept

    def take(self, values: npt.NDArray[Any]) -> None:
        """Takes the next values, in the file's order.

        Raises:
            FormatError: a value that is not a label.
        """
        if (self._slope, self._intercept) != (1.0, 0.0):
            values = values.astype(np.float64) * self._slope + self._intercept
        if values.dtype.kind == "f":
            whole = np.rint(values)
            wrong = ~(np.abs(values - whole) <= _WHOLE)  # NaN is wrong, too
            if wrong.any():
                raise FormatError(
                    f"{self._path}: has the value {values[wrong][0]:g}, and a label is a whole number: this is a "
                    "probability or an image; threshold it, and save a label map"
                )
            values = whole
        if values.size and (values.min() < 0 or values.max() > MAX_LABEL):
            worst = values.min() if values.min() < 0 else values.max()
            raise FormatError(
                f"{self._path}: has the value {worst:g}, and labels run from 0 to {MAX_LABEL}: this is an image; "
                "segment it first, or number its labels anew"
            )
        self._out[self._done : self._done + values.size] = values
        self._done += values.size

    @property
    def missing(self) -> int:
        """Returns how many values are still to come."""
        return len(self._out) - self._done

    def result(self) -> npt.NDArray[np.uint16]:
        """Returns the labels.

        Raises:
            FormatError: the file ended before.
        """
        if self.missing:
            raise FormatError(
                f"{self._path}: ends after {self._done} of {len(self._out)} voxels; it is cut off, or its sizes are "
                "wrong"
            )
        return self._out


def checked_sizes(path: Path, sizes: list[int]) -> int:
    """Returns the number of voxels.

    Raises:
        FormatError: no voxels, or too many of them.
    """
    if any(size < 1 for size in sizes):
        raise FormatError(f"{path}: sizes {sizes}: each must be at least 1")
    count = 1
    for size in sizes:
        count *= size
    if count > MAX_VOXELS:
        raise FormatError(
            f"{path}: sizes {sizes}: {count} voxels, more than {MAX_VOXELS}; crop it to the segment or resample it"
        )
    return count


def checked_affine(path: Path, affine: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Returns the affine map.

    Raises:
        FormatError: not finite, without a volume, or without an extent in metres.
    """
    if not np.isfinite(affine).all():
        raise FormatError(f"{path}: its directions or its origin are not finite; write the file again")
    lengths = np.linalg.norm(affine[:3, :3], axis=0)
    if not (lengths > 0).all() or abs(np.linalg.det(affine[:3, :3] / lengths)) < 1e-3:
        raise FormatError(
            f"{path}: its axes have the directions {np.round(affine[:3, :3].T, 6).tolist()} (in metres), which span no "
            "volume; write the file again with its orientation"
        )
    return affine


def metres(unit: str) -> float | None:
    """Returns a unit of length in metres; None if the word is not one."""
    word = unit.strip().lower().replace("µ", "u").replace("μ", "u")
    names = {"millimeter": "mm", "millimetre": "mm", "meter": "m", "metre": "m", "micron": "um", "micrometer": "um"}
    return _METRES.get(names.get(word.rstrip("s") if word.rstrip("s") in names else word, word))
