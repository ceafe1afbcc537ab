"""The path of a probe of 5 mm that roams over the demo organ: references/roam-path.csv.

The path is made of waves with seeded phases, so that no mesh is better along it than beside it by design. The probe
waits above until the organ hangs still, goes down, roams at a depth that varies, and lifts off. The committed file is
what every run takes. `make` makes it, and a test compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tensormass._src.meshes import FloatArray
from tensormass._src.organ import liver

FILE = Path(__file__).parent / "references" / "roam-path.csv"
RADIUS_M = 0.005
#: Times between the rows of the file [s]. Forces are compared at them.
SAMPLE_S = 1 / 60
SETTLES_S, LOWERS_S, ROAMS_S, LIFTS_S = 1.0, 0.5, 7.0, 0.5
_SEED = 41
# Middle and half width of the path, on top of the organ and away from the part that is held.
_CENTER_M, _HALF_M = np.array([-0.042, 0.010]), np.array([0.038, 0.024])
# The organ sags by 2 to 4 mm under its weight before the probe comes.
_DEPTH_M, _DEPTH_HALF_M = 0.0065, 0.001
_ABOVE_M = 0.015
_WAVES = 3
_DIFFERENCE_M = 1e-5


@dataclass(frozen=True)
class Path3:
    """Positions of the probe's centre. times_s: [n], from SAMPLE_S on; positions_m: [n, 3]; depths_m: [n], below the
    surface at rest; negative above it."""

    times_s: FloatArray
    positions_m: FloatArray
    depths_m: FloatArray

    def at(self, times_s: FloatArray) -> FloatArray:
        """Returns positions between the rows, by cubics with continuous velocity (Catmull and Rom), [n, 3] m."""
        place = np.clip(np.asarray(times_s) / SAMPLE_S - 1, 0, len(self.times_s) - 1)
        i = np.minimum(place.astype(np.int64), len(self.times_s) - 2)
        t = (place - i)[:, None]
        before, start, end, after = (
            self.positions_m[np.clip(i + offset, 0, len(self.times_s) - 1)] for offset in (-1, 0, 1, 2)
        )
        first, last = (end - before) / 2, (after - start) / 2
        cubic: FloatArray = (
            (2 * t**3 - 3 * t**2 + 1) * start
            + (t**3 - 2 * t**2 + t) * first
            + (3 * t**2 - 2 * t**3) * end
            + (t**3 - t**2) * last
        )
        return cubic

    @property
    def touched_m(self) -> FloatArray:
        """Points of the path that lie below the surface, [n, 3] m."""
        return self.positions_m[self.depths_m > 0]


def read(file: Path = FILE) -> Path3:
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    return Path3(table[:, 0], table[:, 1:4], table[:, 4])


def make() -> Path3:
    """Makes the path again."""
    random = np.random.default_rng(_SEED)
    total_s = SETTLES_S + LOWERS_S + ROAMS_S + LIFTS_S
    times_s = SAMPLE_S * np.arange(1, round(total_s / SAMPLE_S) + 1)
    share = np.clip((times_s - SETTLES_S) / (total_s - SETTLES_S), 0, 1)
    waves = [_wave(random, share) for _ in range(3)]
    plane_m = _CENTER_M + _HALF_M * np.stack(waves[:2], axis=1)
    depths_m = _DEPTH_M + _DEPTH_HALF_M * waves[2]
    down = np.clip((times_s - SETTLES_S) / LOWERS_S, 0, 1)
    up = np.clip((times_s - (total_s - LIFTS_S)) / LIFTS_S, 0, 1)
    pressed = _smooth(down) * (1 - _smooth(up))
    depths_m = pressed * depths_m - (1 - pressed) * _ABOVE_M
    surface_m, normal = _surface(plane_m)
    positions_m = surface_m + normal * (RADIUS_M - depths_m)[:, None]
    positions_m, depths_m = np.round(positions_m, 7).astype(np.float64), np.round(depths_m, 7).astype(np.float64)
    return Path3(times_s.astype(np.float64), positions_m, depths_m)


def text(path: Path3) -> str:
    rows = np.column_stack([path.times_s, path.positions_m, path.depths_m])
    lines = [f"{time:.6f}," + ",".join(f"{value:.7f}" for value in values) for time, *values in rows]
    return "\n".join(["time_s,x_m,y_m,z_m,depth_m", *lines]) + "\n"


def _wave(random: np.random.Generator, share: FloatArray) -> FloatArray:
    """Returns a sum of waves between -1 and 1."""
    wave = np.zeros(len(share))
    for cycles in range(1, _WAVES + 1):
        amplitude, phase = random.uniform(0.5, 1) / cycles, random.uniform(0, 2 * np.pi)
        wave += amplitude * np.sin(2 * np.pi * cycles * share + phase)
    scaled: FloatArray = wave / np.abs(wave).max()
    return scaled


def _smooth(share: FloatArray) -> FloatArray:
    smooth: FloatArray = share**3 * (10 - 15 * share + 6 * share**2)
    return smooth


def _surface(plane_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the points of the organ's top above points of the plane, and its normals there, [n, 3] each."""
    low, high = np.zeros(len(plane_m)), np.full(len(plane_m), 0.07)
    for _ in range(40):
        middle = (low + high) / 2
        is_inside = liver(np.column_stack([plane_m, middle])) > 0
        low, high = np.where(is_inside, middle, low), np.where(is_inside, high, middle)
    points = np.column_stack([plane_m, low])
    steps = _DIFFERENCE_M * np.eye(3)
    gradient = np.stack([liver(points - step) - liver(points + step) for step in steps], axis=1)
    return points, gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


if __name__ == "__main__":
    FILE.write_text(text(make()))
    print(f"wrote {FILE.name}")
