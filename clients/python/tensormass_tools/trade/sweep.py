"""Which settings to measure, and which of the measured ones are worth having."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tensormass._src.meshes import FloatArray
from tensormass_tools.trade.knobs import SOLVE_KNOBS, Knobs, Setting
from tensormass_tools.trade.scene_edits import Value
from tensormass_tools.trade.store import Measurement

# Of one knob, values that go into combinations: the scene's own and the best of the others.
_VALUES_A_KNOB = 4
_PRODUCT_LIMIT = 400_000
# What takes longer than this many times the scene, and than the budget, is not measured.
_DEAREST = 50.0
# A value whose error is above this many tolerances is not promising at any price.
_HOPELESS_TOLERANCES = 5.0
# Times that differ by less are the same.
_SCATTER = 0.02
# A dearer point is on the front only if its error is below this share of that of the cheaper one: times scatter.
_WORTHWHILE = 0.99
# How much farther from the reference a setting has to be if it is solved better, to show that it was close by chance.
_BY_CHANCE = 1.05


def at_one_speed(measured: Sequence[Measurement]) -> list[Measurement]:
    """The same with costs as they would be had the machine been equally fast all the time: each was timed in turns with
    the scene as it is, the first of them, and costs as many times what that does by the median of all its turns."""
    turns = [of for of in measured if of.own_p50_s > 0]
    if not turns:
        return list(measured)
    p50_s, p99_s = (float(np.median(of)) for of in zip(*((of.own_p50_s, of.own_p99_s) for of in turns), strict=True))
    even = [replace(of, cost_s=of.cost_s * p50_s / of.own_p50_s) if of.own_p50_s > 0 else of for of in measured]
    if (costs := even[0].costs) is not None:
        even[0] = replace(even[0], costs=replace(costs, step_p50_s=p50_s, step_p99_s=p99_s))
    return even


def one_at_a_time(knobs: Knobs, quick: bool) -> list[dict[str, Value]]:
    """The scene as it is, then each knob turned alone; `quick`: only to the neighbours of ordered ones."""
    settings: list[dict[str, Value]] = [{}]
    for name, knob in knobs.knobs.items():
        settings += [knobs.canonical({name: value}) for value in knob.others(nearest=quick)]
    return [setting for index, setting in enumerate(settings) if setting not in settings[:index]]


def combinations(
    knobs: Knobs, measured: Sequence[Measurement], count: int, tolerance: float, budget_s: float = 0.0
) -> tuple[list[dict[str, Value]], int]:
    """Settings of several knobs that promise most, at most `count`, and out of how many.

    What a knob did alone predicts what it does with others: factors of cost multiply; what it adds to an error adds,
    and of what it takes away each takes its share of what the others left. The promising are the front of that
    prediction, then the front of the rest, and so on. Another law takes part where it is as good as the same, see
    `is_same_tissue`, for its speed, in at most half of the settings while others are left.
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
                changes = np.maximum(changes, 0)  # closer to the reference is no merit of what it is not
            alone.append(_Turn({name: value}, math.log(of.cost_s / base.cost_s), changes))
        # Useful is what is cheaper or more accurate than the scene.
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
    # A law that is as good and a little faster would be in every combination, and none would be left for whoever keeps
    # his own: those get half, or as many as there are.
    own, other = ([of for of in candidates if ("law" in of[0]) is changed] for changed in (False, True))
    of_own = max(count - count // 2, count - len(other))
    chosen = _promising(own, of_own)
    chosen += _promising(other, count - len(chosen))
    return chosen, total


def _promising(candidates: list[tuple[dict[str, Value], float, float]], count: int) -> list[dict[str, Value]]:
    """At most `count` settings of (setting, cost, error): the front, then the front of the rest, and so on."""
    chosen: list[dict[str, Value]] = []
    while candidates and len(chosen) < count:
        front = _spread(pareto([(cost, error) for _, cost, error in candidates]), count - len(chosen))
        chosen += [candidates[index][0] for index in front]
        taken = set(front)
        candidates = [of for index, of in enumerate(candidates) if index not in taken]
    return chosen


@dataclass(frozen=True)
class _Turn:
    """One knob turned alone: logarithm of the factor of cost, changes of `Errors.of_tolerance`."""

    setting: dict[str, Value]
    log_cost: float
    changes: FloatArray


def _asks_equilibria_more_often(setting: Setting, knobs: Knobs) -> bool:
    """Than the scene: one does not depend on the last, so that smaller steps only cost."""
    if knobs.value(setting, "integrator") != "quasi_static" or "dt_s" not in setting:
        return False
    return float(setting["dt_s"]) < float(knobs.knobs["dt_s"].own)


def _together(base: Sequence[float], changes: Sequence[FloatArray]) -> float:
    """The worst error of turns made together. Were all changes added, errors would fall to nothing and below, and the
    dearer settings promise no more than the cheap ones."""
    each = np.stack(changes)
    own = np.asarray(base)
    left = own * np.prod(1 + np.minimum(each, 0) / np.maximum(own, 1e-300), axis=0)
    return float((left + np.maximum(each, 0).sum(axis=0)).max())


def is_same_tissue(of: Measurement, measured: Sequence[Measurement], tolerance: float) -> bool:
    """Whether the setting's law, if it is another, moves the answer by less than the tolerance when it alone is
    changed. An error that is small although the law moves more only cancels that of the mesh, for this load.
    """
    law = of.setting.get("law")
    if law is None:
        return True
    return any(one.setting == {"law": law} and one.errors and one.moved <= tolerance for one in measured)


def is_close_by_chance(of: Measurement, measured: Sequence[Measurement], knobs: Knobs) -> bool:
    """Whether a measurement that differs only in that it was solved better is farther from the reference: what a step
    leaves unsolved then cancels an error of the mesh or of time, for this load."""
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
    """Indices of the points (cost, error) that no cheaper one matches, the cheapest first."""
    order = sorted(range(len(points)), key=lambda index: points[index])
    front = []
    best = math.inf
    for index in order:
        if points[index][1] < _WORTHWHILE * best or best == math.inf:
            front.append(index)
            best = points[index][1]
    return front


def front(measured: Sequence[Measurement]) -> list[Measurement]:
    """Measurements that none beats in cost and error, the cheapest first; without those that broke."""
    usable = [of for of in measured if of.errors is not None and math.isfinite(of.errors.judged)]
    return [usable[index] for index in pareto([(of.cost_s, of.errors.judged) for of in usable if of.errors])]


def fastest_within(measured: Sequence[Measurement], tolerance: float, knobs: Knobs) -> list[Measurement]:
    """The front of what can be recommended that is that accurate, the fastest first."""
    return [of for of in _recommendable(measured, tolerance, knobs) if of.errors and of.errors.judged <= tolerance]


def most_accurate_within(
    measured: Sequence[Measurement], budget_s: float, tolerance: float, knobs: Knobs
) -> list[Measurement]:
    """The front of what can be recommended that is that fast, the most accurate first. `tolerance`: of what is
    another law."""
    return [of for of in reversed(_recommendable(measured, tolerance, knobs)) if of.cost_s <= budget_s]


def _recommendable(measured: Sequence[Measurement], tolerance: float, knobs: Knobs) -> list[Measurement]:
    """The front of what is the same tissue, and close for another reason than chance."""
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
    """What takes the place of a candidate that failed in its second run, `again`: the next that is within the budget
    although the machine be as slow as that run had it."""
    slowdown = max(again.cost_s / failed.cost_s, 1.0)  # 1 too if it stopped: that says nothing of times
    return next((of for of in candidates[candidates.index(failed) + 1 :] if slowdown * of.cost_s <= budget_s), None)


def _spread(indices: list[int], count: int) -> list[int]:
    """At most `count` of them, evenly."""
    if len(indices) <= count:
        return indices
    return [indices[round(of)] for of in np.linspace(0, len(indices) - 1, count)]


def _frozen(setting: Setting) -> tuple[tuple[str, Value], ...]:
    return tuple(sorted(setting.items()))
