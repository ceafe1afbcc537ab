"""Which settings to measure, and which of the measured ones are worth having."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tensormass import FloatArray
from tensormass_tools.trade.knobs import SOLVE_KNOBS, Knobs, Setting
from tensormass_tools.trade.scene_edits import Value
from tensormass_tools.trade.store import Measurement

# Number of values of a knob in combinations: the scene's own and the best of the others.
_VALUES_A_KNOB = 4
_PRODUCT_LIMIT = 400_000
# Settings that take longer than this many times the scene, and longer than the budget, are not measured.
_DEAREST = 50.0
# A value whose error is above this many tolerances is not worth any cost.
_HOPELESS_TOLERANCES = 5.0
# Relative difference below which times are the same.
_SCATTER = 0.02
# A more expensive point is on the front only if its error is below this share of the cheaper one's, because times
# scatter.
_WORTHWHILE = 0.99
# Factor by which a better solved setting must be farther from the reference, to show that it was close by chance.
_BY_CHANCE = 1.05


def at_one_speed(measured: Sequence[Measurement]) -> list[Measurement]:
    """Corrects costs for changes of the machine's speed. Each setting was timed in turns with the unmodified scene, the
    first measurement. Its cost becomes the ratio of both times the median cost of the unmodified scene."""
    turns = [of for of in measured if of.own_p50_s > 0]
    if not turns:
        return list(measured)
    p50_s, p99_s = (float(np.median(of)) for of in zip(*((of.own_p50_s, of.own_p99_s) for of in turns), strict=True))
    even = [replace(of, cost_s=of.cost_s * p50_s / of.own_p50_s) if of.own_p50_s > 0 else of for of in measured]
    if (costs := even[0].costs) is not None:
        even[0] = replace(even[0], costs=replace(costs, step_p50_s=p50_s, step_p99_s=p99_s))
    return even


def one_at_a_time(knobs: Knobs, quick: bool) -> list[dict[str, Value]]:
    """Returns the unmodified scene, then each value of each knob alone; `quick`: only neighbours of ordered knobs."""
    settings: list[dict[str, Value]] = [{}]
    for name, knob in knobs.knobs.items():
        settings += [knobs.canonical({name: value}) for value in knob.others(nearest=quick)]
    return [setting for index, setting in enumerate(settings) if setting not in settings[:index]]


def combinations(
    knobs: Knobs, measured: Sequence[Measurement], count: int, tolerance: float, budget_s: float = 0.0
) -> tuple[list[dict[str, Value]], int]:
    """Returns the most promising settings of several knobs, at most `count`, and the number of possible ones.

    The effect of a knob alone predicts its effect with others. Factors of cost multiply. Increases of the error add up.
    A decrease takes its share of the error that the others left. The promising settings are the front of that
    prediction, then the front of the rest, and so on. Another law takes part, for its speed, if it is the same
    tissue (`is_same_tissue`). It is in at most half of the settings while others are left.
    """
    by_setting = {_frozen(of.setting): of for of in measured if of.errors is not None}
    base = by_setting[_frozen({})]
    assert base.errors is not None
    base_error = base.errors.judged
    worth_at_most = max(_HOPELESS_TOLERANCES * tolerance, 1.5 * base_error)
    base_errors = base.errors.of_tolerance
    choices: list[list[_Turn]] = []
    for name, knob in knobs.knobs.items():
        alone = []
        for value in knob.others():
            of = by_setting.get(_frozen(knobs.canonical({name: value})))
            if of is None or of.errors is None or of.errors.judged > worth_at_most:
                continue
            if not is_same_tissue(of, measured, tolerance):
                continue
            changes = np.subtract(of.errors.of_tolerance, base_errors)
            if name == "law":
                changes = np.maximum(changes, 0)  # another law gets no credit for being closer to the reference
            alone.append(_Turn({name: value}, math.log(of.cost_s / base.cost_s), changes))
        # Keeps values that are cheaper or more accurate than the scene.
        alone = [of for of in alone if of.log_cost < -_SCATTER or of.changes.min() < 0]
        alone.sort(key=lambda of: min(of.log_cost, 0.0) + min(float(of.changes.min()) / max(base_error, 1e-9), 0.0))
        choices.append([_Turn({}, 0.0, np.zeros(len(base_errors))), *alone[: _VALUES_A_KNOB - 1]])
    while math.prod(len(of) for of in choices) > _PRODUCT_LIMIT:
        longest = max(choices, key=len)
        longest.pop()
    settings: dict[tuple[tuple[str, Value], ...], tuple[dict[str, Value], float, float]] = {}
    for parts in itertools.product(*choices):
        setting = knobs.canonical({name: value for of in parts for name, value in of.setting.items()})
        if len(setting) > 1 and _frozen(setting) not in by_setting and not _asks_equilibria_more_often(setting, knobs):
            error = _together(base_errors, [of.changes for of in parts])
            settings[_frozen(setting)] = (setting, sum(of.log_cost for of in parts), error)
    total = len(settings)
    dearest = math.log(max(_DEAREST, budget_s / base.cost_s))
    candidates = [of for of in settings.values() if of[1] <= dearest]
    # A law that is as accurate and a little faster would be in every combination, and users who keep their own law
    # would get none. Their settings get half of the places, or as many as there are.
    own, other = ([of for of in candidates if ("law" in of[0]) is changed] for changed in (False, True))
    of_own = max(count - count // 2, count - len(other))
    chosen = _promising(own, of_own)
    chosen += _promising(other, count - len(chosen))
    return chosen, total


def _promising(candidates: list[tuple[dict[str, Value], float, float]], count: int) -> list[dict[str, Value]]:
    """Returns at most `count` settings of (setting, cost, error): the front, then the front of the rest, and so on."""
    chosen: list[dict[str, Value]] = []
    while candidates and len(chosen) < count:
        front = _spread(pareto([(cost, error) for _, cost, error in candidates]), count - len(chosen))
        chosen += [candidates[index][0] for index in front]
        taken = set(front)
        candidates = [of for index, of in enumerate(candidates) if index not in taken]
    return chosen


@dataclass(frozen=True)
class _Turn:
    """Effect of one knob alone: logarithm of its factor of cost, changes of `Errors.of_tolerance`."""

    setting: dict[str, Value]
    log_cost: float
    changes: FloatArray


def _asks_equilibria_more_often(setting: Setting, knobs: Knobs) -> bool:
    """Tells whether a setting computes equilibria more often than the scene. That only costs time, because an
    equilibrium does not depend on the one before."""
    if knobs.value(setting, "integrator") != "quasi_static" or "dt_s" not in setting:
        return False
    return float(setting["dt_s"]) < float(knobs.knobs["dt_s"].own)


def _together(base: Sequence[float], changes: Sequence[FloatArray]) -> float:
    """Predicts the worst error of several knobs together. If decreases were added, errors would fall below zero, and
    expensive settings would promise no more than cheap ones."""
    each = np.stack(changes)
    own = np.asarray(base)
    left = own * np.prod(1 + np.minimum(each, 0) / np.maximum(own, 1e-300), axis=0)
    return float((left + np.maximum(each, 0).sum(axis=0)).max())


def is_same_tissue(of: Measurement, measured: Sequence[Measurement], tolerance: float) -> bool:
    """Tells whether a setting has the scene's law, or one that alone changes the result by less than the tolerance. If
    such a law changes more and the error is still small, it only cancels the error of the mesh for this load.
    """
    law = of.setting.get("law")
    if law is None:
        return True
    return any(one.setting == {"law": law} and one.errors and one.moved <= tolerance for one in measured)


def is_close_by_chance(of: Measurement, measured: Sequence[Measurement], knobs: Knobs) -> bool:
    """Tells whether the same setting, solved better, is farther from the reference. The solver's error then cancels an
    error of mesh or time step for this load."""
    if of.errors is None:
        return False

    def solves(one: Measurement) -> tuple[tuple[str, Value], ...]:
        return _frozen({name: value for name, value in one.setting.items() if name not in SOLVE_KNOBS})

    ours = knobs.effort(of.setting)
    return any(
        other.errors is not None
        and other.errors.judged > _BY_CHANCE * of.errors.judged
        and solves(other) == solves(of)
        and all(theirs >= own for theirs, own in zip(knobs.effort(other.setting), ours, strict=True))
        for other in measured
    )


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Returns the indices of the points (cost, error) that no cheaper point matches, the cheapest first."""
    order = sorted(range(len(points)), key=lambda index: points[index])
    front = []
    best = math.inf
    for index in order:
        if points[index][1] < _WORTHWHILE * best or best == math.inf:
            front.append(index)
            best = points[index][1]
    return front


def front(measured: Sequence[Measurement]) -> list[Measurement]:
    """Returns the measurements that no other beats in cost and error, the cheapest first; without failed ones."""
    usable = [of for of in measured if of.errors is not None and math.isfinite(of.errors.judged)]
    return [usable[index] for index in pareto([(of.cost_s, of.errors.judged) for of in usable if of.errors])]


def fastest_within(measured: Sequence[Measurement], tolerance: float, knobs: Knobs) -> list[Measurement]:
    """Returns the recommendable settings within the tolerance, the fastest first."""
    return [of for of in _recommendable(measured, tolerance, knobs) if of.errors and of.errors.judged <= tolerance]


def most_accurate_within(
    measured: Sequence[Measurement], budget_s: float, tolerance: float, knobs: Knobs
) -> list[Measurement]:
    """Returns the recommendable settings within the budget, the most accurate first. `tolerance`: for another law."""
    return [of for of in reversed(_recommendable(measured, tolerance, knobs)) if of.cost_s <= budget_s]


def _recommendable(measured: Sequence[Measurement], tolerance: float, knobs: Knobs) -> list[Measurement]:
    """Returns the front of the settings that are the same tissue and not close by chance."""
    return front(
        [
            of
            for of in measured
            if is_same_tissue(of, measured, tolerance) and not is_close_by_chance(of, measured, knobs)
        ]
    )


def next_after(
    failed: Measurement, again: Measurement, candidates: Sequence[Measurement], budget_s: float
) -> Measurement | None:
    """Returns the candidate that replaces one that failed in its second run, `again`: the next one within the budget
    even if the machine stays as slow as in that run."""
    slowdown = max(again.cost_s / failed.cost_s, 1.0)  # also 1 if the run stopped, which says nothing about times
    return next((of for of in candidates[candidates.index(failed) + 1 :] if slowdown * of.cost_s <= budget_s), None)


def _spread(indices: list[int], count: int) -> list[int]:
    """Picks at most `count` of them, evenly."""
    if len(indices) <= count:
        return indices
    return [indices[round(of)] for of in np.linspace(0, len(indices) - 1, count)]


def _frozen(setting: Setting) -> tuple[tuple[str, Value], ...]:
    return tuple(sorted(setting.items()))
