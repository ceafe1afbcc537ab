"""How far one recording is from another, and how far a sequence of refined ones is from its limit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tensormass._src.meshes import FloatArray
from tensormass_tools.trade.recording import Recording

# The direction of a force is looked at while it is above this share of its largest.
_FELT_SHARE = 0.1
# Swings below this share of the first are noise; so is a first one below this share of the whole.
_SWING_SHARE = 0.02
# What Richardson's order is kept to: an erratic sequence is not trusted more than it deserves, nor beyond the schemes'.
_ORDERS = (0.5, 2.0)


@dataclass(frozen=True)
class Errors:
    """Of a recording against the reference. Relative ones are shares of the reference's; None: it has no such thing."""

    #: L2 norm over volume and time.
    displacement: float
    #: The largest of any point at any time, as a share of the reference's largest displacement.
    worst_node: float
    #: Of body volume against rest: largest difference of V / V₀.
    volume: float
    #: Root of the mean square over time of the magnitude's error, as a share of that of the magnitude.
    force: float | None = None
    #: Mean angle [rad] while the tool is felt, weighted by force.
    force_angle_rad: float | None = None
    #: Of the work of pressing in.
    work: float | None = None
    #: Natural frequency of the free motion, as a share; 1: it does not swing any more.
    frequency: float | None = None
    #: Difference of damping ratios.
    damping: float | None = None

    @property
    def judged(self) -> float:
        """What a tolerance is held against: what is seen or what is felt, whichever is worse."""
        return max(self.of_tolerance)

    @property
    def of_tolerance(self) -> tuple[float, ...]:
        """What is seen and, where there is a tool, what is felt."""
        return (self.displacement,) if self.force is None else (self.displacement, self.force)


def compare(recording: Recording, reference: Recording, weights: Sequence[FloatArray]) -> Errors:
    """`weights`: [body][point] m³."""
    off = above = 0.0
    worst = largest = 0.0
    for body, weight in enumerate(weights):
        difference = recording.displacement[body] - reference.displacement[body]
        off += float((weight * (difference**2).sum(axis=2)).sum())
        above += float((weight * (reference.displacement[body] ** 2).sum(axis=2)).sum())
        worst = max(worst, float(np.linalg.norm(difference, axis=2).max()))
        largest = max(largest, float(np.linalg.norm(reference.displacement[body], axis=2).max()))
    force, angle, work = _force_errors(recording, reference)
    own, true = (oscillation(of.free_times_s, of.free_m) for of in (recording, reference))
    return Errors(
        displacement=_share(math.sqrt(off), math.sqrt(above)),
        worst_node=_share(worst, largest),
        volume=float(np.abs(recording.volume - reference.volume).max()),
        force=force,
        force_angle_rad=angle,
        work=work,
        frequency=None if true is None else 1.0 if own is None else abs(own[0] - true[0]) / true[0],
        damping=None if true is None or own is None else own[1] - true[1],
    )


def _share(part: float, whole: float) -> float:
    if whole > 0:
        return part / whole
    return math.inf if part > 0 else 0.0


def _force_errors(recording: Recording, reference: Recording) -> tuple[float | None, float | None, float | None]:
    own, true = (np.linalg.norm(of.force, axis=1) for of in (recording, reference))
    if not true.any():
        return None, None, None
    felt = true > _FELT_SHARE * true.max()
    product = np.einsum("ti,ti->t", recording.force[felt], reference.force[felt])
    cosine = product / np.maximum(own[felt] * true[felt], np.finfo(float).tiny)
    angle = float(np.average(np.arccos(np.clip(cosine, -1, 1)), weights=true[felt]))
    size = _share(float(np.linalg.norm(own - true)), float(np.linalg.norm(true)))
    return size, angle, _share(abs(recording.work_j - reference.work_j), abs(reference.work_j))


def oscillation(times_s: FloatArray, values: FloatArray) -> tuple[float, float] | None:
    """Frequency [Hz] and damping ratio of a motion that swings and dies away, of its turning points; None: it does not
    swing three times."""
    turns: list[tuple[float, float]] = []
    changes = np.diff(values)
    # Around a turn halfway between two of them, values are equal.
    for last, following in itertools.pairwise(np.flatnonzero(changes)):
        if changes[last] * changes[following] < 0:
            # The vertex of the parabola through three points.
            i = last + 1
            before, after = changes[last], changes[i]
            shift = (before + after) / (before - after) / 2
            step_s = (times_s[i + 1] - times_s[i - 1]) / 2
            turns.append((float(times_s[i] + shift * step_s), float(values[i] + shift * (before + after) / 4)))
    swings = [abs(b[1] - a[1]) for a, b in itertools.pairwise(turns)]
    if not swings or swings[0] < _SWING_SHARE * float(np.abs(values).max()):
        return None
    count = 0
    while count < len(swings) and swings[count] > _SWING_SHARE * swings[0]:
        count += 1
    if count < 2:
        return None
    frequency_hz = count / (2 * (turns[count][0] - turns[0][0]))
    decrement = math.log(swings[0] / swings[count - 1]) / (count - 1)  # over half a period
    return frequency_hz, decrement / math.hypot(math.pi, decrement)


def richardson(differences: Sequence[float], ratio: float) -> tuple[float, float]:
    """Estimated error of the finest of a sequence and the order that it was taken with.

    Args:
        differences: between one level and the next, the last being the finest pair.
        ratio: by how much each level is finer than the one before.

    An order needs two differences; with one, the first order is assumed. Where differences do not shrink as they
    should, the order is kept within bounds and the estimate is as large as that makes it.
    """
    last = differences[-1]
    order = 1.0
    if len(differences) > 1 and last > 0 and differences[-2] > 0:
        order = min(max(math.log(differences[-2] / last) / math.log(ratio), _ORDERS[0]), _ORDERS[1])
    return last / (ratio**order - 1), order
