"""Segments of a label map: found by name, freed of crumbs and holes, and where they touch each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tensormass import InvalidArgumentError, Labels, Segment
from tensormass._shared.components import MIN_PART
from tensormass._shared.names import suggestion

if TYPE_CHECKING:
    from tensormass import BoolArray, FloatArray

# Voxels around a segment that are looked at, too.
_MARGIN = 2
# A surface lies half a voxel from the centres of the voxels beside it; smoothing and meshing may add so much [voxels].
_SLACK = 0.75
# Voxels on each side of a point that are looked at along an axis, and points at a time.
_MAX_STEPS = 8
_POINTS = 256


@dataclass(frozen=True)
class Chosen:
    """One segment that becomes a body: its voxels in a box of the label map."""

    segment: Segment
    #: bool [i, j, k], with `_MARGIN` empty voxels around.
    mask: npt.NDArray[np.bool_]
    #: Index (i, j, k, 1) in `mask` -> LPS [m].
    affine: npt.NDArray[np.float64]
    #: What was found and done, for messages.
    notes: tuple[str, ...]
    #: Volume of the segment's voxels before crumbs were dropped and holes filled.
    file_volume_m3: float

    @property
    def spacing_m(self) -> FloatArray:
        """Returns the distance of voxels along each axis, [3]."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    @property
    def volume_m3(self) -> float:
        """Returns the volume of the voxels."""
        return float(np.count_nonzero(self.mask)) * abs(float(np.linalg.det(self.affine[:3, :3])))


def named(labels: Labels) -> list[Segment]:
    """Returns the segments that the file names; without names, each label, by its number."""
    if not labels.segments:  # counted once, because an image may be large
        found = np.flatnonzero(np.bincount(labels.voxels.reshape(-1)))
        labels.segments = [Segment(str(label), int(label)) for label in found if label]
    return labels.segments


def find(labels: Labels, name: str, where: str) -> Segment:
    """Returns a segment by its name, in any case, or by its label if no name fits.

    Raises:
        InvalidArgumentError: there is none, or several have the name.
    """
    known = named(labels)
    for fits in ([of for of in known if of.name == name], [of for of in known if of.name.lower() == name.lower()]):
        if len(fits) > 1:
            numbers = " and ".join(str(of.label) for of in fits)
            raise InvalidArgumentError(
                f"{where}: --segment {name!r}: {len(fits)} segments have this name (labels {numbers}); rename one in "
                "the program that made the file"
            )
        if fits:
            return fits[0]
    of_label = [of for of in known if str(of.label) == name]
    if len(of_label) == 1:
        return of_label[0]
    if not known:
        raise InvalidArgumentError(f"{where}: has no segments: every voxel is 0; segment it first")
    raise InvalidArgumentError(
        f"{where}: --segment {name!r}: no such segment; {suggestion(name, [of.name for of in known])}"
    )


def mask_of(labels: Labels, segment: Segment) -> BoolArray:
    """Returns the voxels of a segment, [i, j, k]."""
    mask: BoolArray = labels.voxels[segment.layer] == segment.label
    return mask


def choose(
    labels: Labels,
    segments: list[Segment],
    where: str,
    *,
    fill_holes: bool = False,
    largest: bool = False,
) -> list[Chosen]:
    """Returns the voxels of segments that become bodies, one body each. A voxel of two of them goes to the first.

    Args:
        fill_holes: fills cavities.
        largest: keeps the largest of several separate parts. Otherwise all are kept, but for crumbs.

    Raises:
        InvalidArgumentError: a segment without voxels.
    """
    taken: BoolArray | None = None
    out = []
    for segment in segments:
        mask = mask_of(labels, segment)
        notes = []
        if not mask.any():
            raise InvalidArgumentError(
                f"{where}: segment {segment.name!r} is empty: no voxel of layer {segment.layer} has its label, "
                f"{segment.label}; choose another, or paint it and save the file again"
            )
        notes += _overlaps(labels, segment, mask, segments)
        if taken is not None and (shared := int(np.count_nonzero(mask & taken))):
            mask &= ~taken
            notes.append(
                f"{_voxels(shared)} of it belong to a segment that was named before, too, and stay there; name "
                f"{segment.name!r} first to give them to it"
            )
            if not mask.any():
                raise InvalidArgumentError(
                    f"{where}: segment {segment.name!r} lies within segments that were named before it; name it first"
                )
        taken = mask.copy() if taken is None else taken | mask
        out.append(_cut_out(labels, segment, mask, notes, fill_holes=fill_holes, largest=largest))
    return out


def _overlaps(labels: Labels, segment: Segment, mask: BoolArray, chosen: list[Segment]) -> list[str]:
    """Names segments of other layers that share voxels with this one and become no body."""
    notes = []
    for other in named(labels):
        if other.layer == segment.layer or other in chosen:
            continue
        shared = int(np.count_nonzero(mask & mask_of(labels, other)))
        if shared:
            notes.append(
                f"{_voxels(shared)} of it belong to {other.name!r}, too, and are taken; name both, "
                f"--segment {other.name!r} first, to leave them out"
            )
    return notes


def _cut_out(
    labels: Labels, segment: Segment, mask: BoolArray, notes: list[str], *, fill_holes: bool, largest: bool
) -> Chosen:
    low, high = _box(mask)
    cut = np.pad(mask[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], _MARGIN)
    if (at_border := [axis for axis in range(3) if low[axis] == 0 or high[axis] == mask.shape[axis]]) and any(
        mask.shape[axis] > 1 for axis in at_border
    ):
        notes.append("it reaches the border of the image, and is cut flat there")
    cut = _parts(cut, notes, largest=largest)
    cut = _holes(cut, notes, fill_holes=fill_holes)
    affine = labels.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ (np.array(low) - _MARGIN)
    voxel_m3 = abs(float(np.linalg.det(affine[:3, :3])))
    return Chosen(segment, cut, affine, tuple(notes), np.count_nonzero(mask) * voxel_m3)


def _box(mask: BoolArray) -> tuple[list[int], list[int]]:
    """Returns the first index and the one after the last along each axis."""
    low, high = [], []
    for axis in range(3):
        filled = np.flatnonzero(mask.any(axis=tuple(other for other in range(3) if other != axis)))
        low.append(int(filled[0]))
        high.append(int(filled[-1]) + 1)
    return low, high


def _parts(mask: BoolArray, notes: list[str], *, largest: bool) -> BoolArray:
    """Drops crumbs: parts, connected over faces, below a share of the largest one."""
    from scipy import ndimage

    part, count = ndimage.label(mask)
    if count == 1:
        return mask
    sizes = np.bincount(part.reshape(-1))
    sizes[0] = 0
    kept = sizes == sizes.max() if largest else sizes >= max(1.0, MIN_PART * sizes.max())
    if largest:
        kept[np.argmax(sizes) + 1 :] = False
    if dropped := count - int(kept.sum()):
        what = "1 separate part" if dropped == 1 else f"{dropped} separate parts"
        notes.append(f"{what} of {_voxels(int(sizes[~kept].sum()))} {'is' if dropped == 1 else 'are'} dropped")
    if (remaining := int(kept.sum())) > 1:
        listed = ", ".join(f"{size:,}" for size in np.sort(sizes[kept])[::-1][:5])
        notes.append(f"{remaining} separate parts are kept, of {listed} voxels; --largest keeps the largest alone")
    out: BoolArray = kept[part]
    return out


def _holes(mask: BoolArray, notes: list[str], *, fill_holes: bool) -> BoolArray:
    """Names cavities. Fills crumbs, or all of them if asked."""
    from scipy import ndimage

    hole, _ = ndimage.label(~mask)
    sizes = np.bincount(hole.reshape(-1))
    # The margin makes the outside one part, and it has the corner. Part 0 is the segment.
    sizes[[0, hole[0, 0, 0]]] = 0
    filled = sizes > 0
    if not fill_holes:
        # Such cavities hold far less than a mesh may be off.
        filled &= sizes < MIN_PART * np.count_nonzero(mask)
        if sizes[filled].sum() >= MIN_PART * np.count_nonzero(mask):
            filled[:] = False
    for which, said in ((filled, "filled"), (~filled & (sizes > 0), "kept as cavities; --fill-holes fills them")):
        if found := int(np.count_nonzero(which)):
            holes = "1 hole" if found == 1 else f"{found} holes"
            notes.append(f"{holes} of {_voxels(int(sizes[which].sum()))} {'is' if found == 1 else 'are'} {said}")
    out: BoolArray = mask | filled[hole]
    return out


def _voxels(count: int) -> str:
    return "1 voxel" if count == 1 else f"{count:,} voxels"


def touching(labels: Labels, chosen: Chosen, other: BoolArray, points_m: FloatArray, slack_m: float) -> BoolArray:
    """Returns which points on the surface of a chosen segment lie at voxels of another one, [point_count].

    Args:
        other: voxels of the other one, [i, j, k] of the label map.
        slack_m: distance by which the surface may be off.
    """
    # Largest distance from the centre of a voxel, along each axis.
    reach = np.maximum(0.5 + _SLACK, 0.5 + slack_m / chosen.spacing_m)
    most = np.ceil(reach).astype(int)
    # Some of many small voxels are enough.
    steps = [np.arange(-end, end + 1, max(1, end // _MAX_STEPS)) for end in most]
    offsets = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    inverse = np.linalg.inv(labels.affine)
    places = points_m @ inverse[:3, :3].T + inverse[:3, 3]
    found = np.zeros(len(points_m), bool)
    limits = np.array(other.shape) - 1
    for first in range(0, len(places), _POINTS):
        piece = places[first : first + _POINTS, np.newaxis]
        voxels = np.rint(piece).astype(int) + offsets
        near = (((voxels - piece) / reach) ** 2).sum(axis=2) <= 1
        near &= ((voxels >= 0) & (voxels <= limits)).all(axis=2)
        i, j, k = np.moveaxis(np.clip(voxels, 0, limits), 2, 0)
        found[first : first + _POINTS] = (near & other[i, j, k]).any(axis=1)
    return found
