"""Guesses the unit of a mesh file, which has none, from its size."""

from __future__ import annotations

import numpy as np

from tensormass._src.meshes import FloatArray

# A body of soft tissue is smaller [m], and one in millimetres is larger.
_LARGE_M = 5.0


def guess_unit_m(points: FloatArray) -> float | None:
    """Returns the unit [m] of points [n, 3] that are too far apart for metres (5 m): 1e-3, millimetres. None if they
    may be metres."""
    return 1e-3 if float(np.ptp(points, axis=0).max()) > _LARGE_M else None


def guess_in_words(points: FloatArray, unit_m: float) -> str:
    """Returns a guess in words."""
    size = " × ".join(f"{length:.3g}" for length in np.ptp(points, axis=0))
    return (
        f"is {size} in a unit that the file does not name, and is taken as millimetres (mesh.scale: {unit_m:g}); write "
        "a scene file with the mesh and its scale if that is wrong"
    )
