"""Errors of one recording against another, and the distance of a refined sequence from its limit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tensormass import BoolArray, FloatArray
from tensormass_tools.trade.recording import Recording

# The direction of a force counts while the force is above this share of its largest.
_FELT_SHARE = 0.1
# Swings below this share of the first one are noise, as is a first swing below this share of the whole motion.
_SWING_SHARE = 0.02
# Bounds of Richardson's order. An erratic sequence is not trusted. Coarse levels approach each other at second order,
# finer ones do not: clamped edges and contacts limit the order.
_ORDERS = (0.5, 1.0)


@dataclass(frozen=True)
class Errors:
    """Errors of a recording against the reference. Relative errors are shares of the reference's value; None if the
    reference has no such value."""

    #: Displacement, L2 norm over volume and time.
    displacement: float
    #: Largest displacement error of any point at any time, as a share of the reference's largest displacement.
    worst_node: float
    #: Largest difference of V / V₀, the volume of a body against rest.
    volume: float
    #: Root mean square over time of the force magnitude's error, as a share of that of the magnitude.
    force: float | None = None
    #: Mean angle between the forces [rad] while there is contact, weighted by force.
    force_angle_rad: float | None = None
    #: Work of the tool while it presses in.
    work: float | None = None
    #: Natural frequency of the free motion, as a share; 1 if the motion no longer swings.
    frequency: float | None = None
    #: Difference of damping ratios.
    damping: float | None = None
    #: As `force`, over the time for which the tool stays in, and over the rest; None also in older results.
    force_held: float | None = None
    force_moving: float | None = None
    #: As `force_held`, at the first of two depths; `force_held` is then at the deepest.
    force_held_shallow: float | None = None

    @property
    def judged(self) -> float:
        """Returns the error that is compared with the tolerance: the larger one of displacement and force."""
        return max(self.of_tolerance)

    @property
    def of_tolerance(self) -> tuple[float, ...]:
        """Returns the error of displacement and, with a tool, that of the force."""
        return (self.displacement,) if self.force is None else (self.displacement, self.force)


def compare(
    recording: Recording, reference: Recording, weights: Sequence[FloatArray], held: Sequence[BoolArray] = ()
) -> Errors:
    """Computes the errors.

    Args:
        weights: volume of each point, [body][point] m³.
        held: whether the tool stays in, at one or two depths (`Script.held`), [depth][sample]; empty: not told.
    """
    off = above = 0.0
    worst = largest = 0.0
    for body, weight in enumerate(weights):
        difference = recording.displacement[body] - reference.displacement[body]
        off += float((weight * (difference**2).sum(axis=2)).sum())
        above += float((weight * (reference.displacement[body] ** 2).sum(axis=2)).sum())
        worst = max(worst, float(np.linalg.norm(difference, axis=2).max()))
        largest = max(largest, float(np.linalg.norm(reference.displacement[body], axis=2).max()))
    force, angle, work = _force_errors(recording, reference)
    at_depth = [_force_size(recording, reference, of_depth) for of_depth in held]
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
        force_held=at_depth[-1] if held else None,
        force_moving=_force_size(recording, reference, ~np.logical_or.reduce(held)) if held else None,
        force_held_shallow=at_depth[0] if len(held) > 1 else None,
    )


def _share(part: float, whole: float) -> float:
    if whole > 0:
        return part / whole
    return math.inf if part > 0 else 0.0


def _force_errors(recording: Recording, reference: Recording) -> tuple[float | None, float | None, float | None]:
    size = _force_size(recording, reference, np.ones(len(reference.force), bool))
    if size is None:
        return None, None, None
    own, true = (np.linalg.norm(of.force, axis=1) for of in (recording, reference))
    felt = true > _FELT_SHARE * true.max()
    product = np.einsum("ti,ti->t", recording.force[felt], reference.force[felt])
    cosine = product / np.maximum(own[felt] * true[felt], np.finfo(float).tiny)
    angle = float(np.average(np.arccos(np.clip(cosine, -1, 1)), weights=true[felt]))
    return size, angle, _share(abs(recording.work_j - reference.work_j), abs(reference.work_j))


def _force_size(recording: Recording, reference: Recording, part: BoolArray) -> float | None:
    """Returns the error of the force's magnitude over a part of the samples; None if the reference feels nothing."""
    own, true = (np.linalg.norm(of.force[part], axis=1) for of in (recording, reference))
    return _share(float(np.linalg.norm(own - true)), float(np.linalg.norm(true))) if true.any() else None


def oscillation(times_s: FloatArray, values: FloatArray) -> tuple[float, float] | None:
    """Returns frequency [Hz] and damping ratio of a decaying oscillation, from its turning points; None if it swings
    less than three times."""
    turns: list[tuple[float, float]] = []
    changes = np.diff(values)
    # Two samples around a turning point may have equal values.
    for last, following in itertools.pairwise(np.flatnonzero(changes)):
        if changes[last] * changes[following] < 0:
            # Vertex of the parabola through three points.
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
    """Returns an error bar for the finest level of a sequence, and the order used.

        bar = |u_n - u_(n-1)| / (ratio^order - 1)

    Args:
        differences: between each level and the next, the finest pair last.
        ratio: refinement of each level against the one before.

    An order needs two differences; with one, first order is assumed. An order above one is not used. In a sequence of
    second order the bar is therefore 2.5 times the error, which is its factor of safety.
    """
    last = differences[-1]
    order = _ORDERS[1]
    if len(differences) > 1 and last > 0 and differences[-2] > 0:
        order = min(max(math.log(differences[-2] / last) / math.log(ratio), _ORDERS[0]), _ORDERS[1])
    return last / (ratio**order - 1), order
