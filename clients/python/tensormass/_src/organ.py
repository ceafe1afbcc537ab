"""The demo's organs: shapes blended from smooth primitives, as implicit functions.

They model no patient and no data set. Lengths in metres, z up, x towards the liver's left lobe, y to the front.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tensormass._src import interface, isosurface
from tensormass._src.mesh_geometry import boundary_surface
from tensormass._src.meshes import FloatArray, TriangleSurface, VolumeMesh

# Halvings that find a distance to rounding.
_BISECTIONS = 60


@dataclass(frozen=True)
class Focus:
    """A place where cells are smaller: where tools act. Cells grow smoothly from `scale` times their size there to
    their full size; at `radius_m` from it (before it is drawn together) they are half-way. The full size is `far` times
    that of the uniform mesh."""

    center_m: FloatArray
    scale: float
    radius_m: float
    far: float

    def placed(self, points: FloatArray) -> FloatArray:
        """Draws points of a regular lattice together around the focus, [n, 3] m -> [n, 3] m."""
        offset = points - self.center_m
        return self.center_m + offset * self._shrink(np.linalg.norm(offset, axis=1, keepdims=True))

    def before(self, distance_m: float) -> float:
        """Returns the distance from the focus that a lattice point must have to come to `distance_m`."""
        low, high = 0.0, distance_m / self.scale
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            is_short = middle * float(self._shrink(np.array(middle))) < distance_m
            low, high = (middle, high) if is_short else (low, middle)
        return high

    def _shrink(self, distance_m: FloatArray) -> FloatArray:
        share: FloatArray = distance_m**2 / (distance_m**2 + self.radius_m**2)
        return self.scale + (1 - self.scale) * share


@dataclass(frozen=True)
class Organ:
    """An organ of the built-in scenes: a shape, the box around it, and the cell sizes of its volume and skin.

    `dataclasses.replace(tm.ORGANS["liver"], cell_m=0.004).volume(graded=False)` is a finer mesh of the demo's liver.
    """

    #: Name of the set of nodes that an organ's surroundings hold.
    HELD: ClassVar[str] = "held"
    #: Maps points [n, 3] m to numbers [n], positive inside of the organ.
    inside: isosurface.Implicit
    #: Positive where its surroundings hold the organ.
    held: isosurface.Implicit
    #: Lower corner of the box, [3] m.
    lower_m: FloatArray
    #: Upper corner of the box, [3] m.
    upper_m: FloatArray
    #: Edge of a cell of the volume [m].
    cell_m: float
    #: Edge of a cell from which the skin is made [m].
    skin_cell_m: float
    #: Place where a graded volume has smaller cells; None: no such place.
    focus: Focus | None = None

    def volume(self, *, graded: bool) -> VolumeMesh:
        """Makes the tetrahedra that are simulated: those of `unfitted`, fitted to the part that is held. Its nodes are
        the set `HELD`. Positions are in metres."""
        return interface.fit(self.unfitted(graded=graded), self.held, Organ.HELD)

    def unfitted(self, *, graded: bool) -> VolumeMesh:
        """Fills the organ with tetrahedra of one size, or graded towards the focus, which must exist then."""
        if not graded:
            return isosurface.fill(self.inside, self.lower_m, self.upper_m, self.cell_m)
        focus = self.focus
        assert focus is not None, "graded towards a focus"
        lower = [at - focus.before(at - to) for at, to in zip(focus.center_m, self.lower_m, strict=True)]
        upper = [at + focus.before(to - at) for at, to in zip(focus.center_m, self.upper_m, strict=True)]
        lattice = isosurface.fill(
            lambda points: self.inside(focus.placed(points)), np.array(lower), np.array(upper), focus.far * self.cell_m
        )
        return replace(lattice, nodes=focus.placed(lattice.nodes))

    def skin(self) -> TriangleSurface:
        """Makes the visible surface."""
        fine = isosurface.fill(self.inside, self.lower_m, self.upper_m, self.skin_cell_m)
        return isosurface.smooth(boundary_surface(fine), self.inside, step_m=1e-4)


def liver(points: FloatArray) -> FloatArray:
    """Implicit function of the liver, [n, 3] m -> [n]: positive inside; near the surface, its distance [m], roughly."""
    # The right lobe is a thick dome, the left one a thin wedge that tapers away; between them a shallow furrow.
    right = _ellipsoid(points, (-0.040, -0.004, 0.000), (0.068, 0.068, 0.050), tilt_deg=(0.0, 6.0, 10.0))
    right_tip = _ellipsoid(points, (-0.068, 0.022, -0.018), (0.036, 0.044, 0.032), tilt_deg=(0.0, 0.0, 25.0))
    left = _ellipsoid(points, (0.042, 0.000, 0.004), (0.070, 0.046, 0.029), tilt_deg=(0.0, 9.0, -12.0))
    body = _blend(_blend(right, right_tip, 0.030), left, 0.035)
    furrow = _ellipsoid(points, (0.016, 0.052, 0.034), (0.009, 0.038, 0.029), tilt_deg=(20.0, 0.0, -10.0))
    # The underside is hollow where other organs lie against it, and has the groove of the gall bladder.
    hollow = _ellipsoid(points, (0.020, -0.008, -0.085), (0.115, 0.075, 0.066), tilt_deg=(8.0, -8.0, 0.0))
    groove = _ellipsoid(points, (-0.012, 0.045, -0.040), (0.014, 0.036, 0.018), tilt_deg=(-15.0, 0.0, 8.0))
    for carved, width in ((furrow, 0.024), (hollow, 0.022), (groove, 0.016)):
        body = -_blend(-body, carved, width)
    return body


def liver_held(points: FloatArray) -> FloatArray:
    """Positive where the liver is held: ligaments hold its back, and it rests on its neighbours below."""
    back, below = -0.035 - points[:, 1], -0.032 - points[:, 2]
    hollow = 0.15 - np.linalg.norm(points - [0.03, 0.0, -0.155], axis=1)
    return np.maximum(np.maximum(back, below), hollow)


def kidney(points: FloatArray) -> FloatArray:
    """Implicit function of the kidney, like `liver`: a bean, its hilum towards -x."""
    bean = _ellipsoid(points, (0.000, 0.000, 0.000), (0.030, 0.024, 0.055), tilt_deg=(0.0, 0.0, 0.0))
    hilum = _ellipsoid(points, (-0.034, 0.000, 0.000), (0.018, 0.026, 0.016), tilt_deg=(0.0, 0.0, 0.0))
    return -_blend(-bean, hilum, 0.018)


def kidney_held(points: FloatArray) -> FloatArray:
    """Positive where the kidney is held: at the hilum by its vessels, and at its lower pole."""
    return np.maximum(0.022 - np.linalg.norm(points - [-0.03, 0.0, 0.0], axis=1), -0.043 - points[:, 2])


# The demo's probe waits above the focus of the liver. A grasper takes the tip of its left lobe.
_ABOVE = Focus(np.array([-0.035, 0.015, 0.048]), scale=0.35, radius_m=0.078, far=1.42)
_LEFT_TIP = Focus(np.array([0.105, -0.006, -0.004]), scale=0.25, radius_m=0.078, far=1.42)
_LIVER = Organ(
    liver, liver_held, np.array([-0.12, -0.085, -0.065]), np.array([0.125, 0.085, 0.065]), 0.0093, 0.0042, _ABOVE
)
# The liver has about 15,000 tetrahedra, 21,000 of one size, the kidney 5,600.
#: Organs of the built-in scenes, by name.
ORGANS = {
    "liver": _LIVER,
    "liver_tip": replace(_LIVER, focus=_LEFT_TIP),
    "kidney": Organ(
        kidney, kidney_held, np.array([-0.035, -0.03, -0.06]), np.array([0.035, 0.03, 0.06]), 0.0074, 0.0034
    ),
}


def _ellipsoid(
    points: FloatArray,
    center_m: tuple[float, float, float],
    radii_m: tuple[float, float, float],
    tilt_deg: tuple[float, float, float],
) -> FloatArray:
    """Returns about the distance to an ellipsoid, positive inside: Quilez's k0 (1 - k0) / k1 without its pole."""
    local = (points - np.array(center_m)) @ _rotation(tilt_deg)
    radii = np.array(radii_m)
    k0 = np.linalg.norm(local / radii, axis=1)
    k1 = np.linalg.norm(local / radii**2, axis=1)
    distance: FloatArray = np.where(k0 > 1e-3, k0 * (1.0 - k0) / np.maximum(k1, 1e-9), radii.min())
    return np.minimum(distance, radii.min())


def _rotation(tilt_deg: tuple[float, float, float]) -> FloatArray:
    """Returns the matrix of rotations about x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(tilt_deg)):
        turn = np.eye(3)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        turn[u, u] = turn[v, v] = np.cos(angle)
        turn[v, u] = np.sin(angle)
        turn[u, v] = -turn[v, u]
        matrix = turn @ matrix
    return matrix


def _blend(a: FloatArray, b: FloatArray, width_m: float) -> FloatArray:
    """Returns the smooth union: the larger of the two, rounded (cubic, so that curvature is continuous) where they are
    close."""
    close = np.maximum(width_m - np.abs(a - b), 0.0) / width_m
    union: FloatArray = np.maximum(a, b) + close**3 * (width_m / 6.0)
    return union
