"""Which settings are measured, and which of them are worth having."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from trade_parts import BLOCK, knobs_of, measurement

from tensormass_tools.trade import sweep
from tensormass_tools.trade.knobs import Knobs, Setting
from tensormass_tools.trade.store import Measurement

# --- which settings ---------------------------------------------------------------------------------------------------


def test_the_front_and_the_picks(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    measured = [
        measurement({}, 3.0, 0.03),
        measurement({"a": 1}, 1.0, 0.2),
        measurement({"a": 2}, 2.0, 0.3),  # beaten
        measurement({"a": 3}, 9.0, 0.001),
        measurement({"a": 4}, 0.0, 0.0, failure="refused"),
    ]
    assert [of.cost_s for of in sweep.front(measured)] == [1.0, 3.0, 9.0]
    fastest, accurate = (
        sweep.fastest_within(measured, 0.05, knobs),
        sweep.most_accurate_within(measured, 5.0, 0.05, knobs),
    )
    assert fastest == [measured[0], measured[3]]
    assert accurate == [measured[0], measured[1]]
    assert sweep.fastest_within(measured, 1e-4, knobs) == []
    assert sweep.most_accurate_within(measured, 0.5, 0.05, knobs) == []
    assert sweep.front([measurement({"a": 5}, 0.5, math.inf), *measured]) == sweep.front(measured)


@pytest.mark.parametrize(
    ("error", "front"), [(0.9895, [0, 1]), (0.99, [0]), (0.9905, [0]), (1.0, [0]), (1.1, [0]), (0.5, [0, 1])]
)
def test_a_dearer_point_is_on_the_front_only_if_it_is_clearly_more_accurate(error: float, front: list[int]) -> None:
    assert sweep.pareto([(1.0, 1.0), (2.0, error)]) == front


def test_costs_are_corrected_for_the_machines_speed() -> None:
    turns = [({}, 3.0, 3.0, 9.0), ({"a": 1}, 1.0, 2.0, 6.0), ({"a": 2}, 8.0, 1.0, 5.0), ({"a": 3}, 7.0, 0.0, 0.0)]
    measured = [
        replace(measurement(setting, cost_s, 0.01), own_p50_s=p50_s, own_p99_s=p99_s)
        for setting, cost_s, p50_s, p99_s in turns
    ]
    even = sweep.at_one_speed(measured)
    assert [of.cost_s for of in even] == pytest.approx([2.0, 1.0, 16.0, 7.0])
    assert even[0].slow_s == pytest.approx(6.0)
    assert [of.costs for of in even[1:]] == [of.costs for of in measured[1:]]
    older = [measurement({}, 3.0, 0.01), measurement({"a": 1}, 1.0, 0.01)]
    assert sweep.at_one_speed(older) == older


def test_the_next_candidate_is_within_the_budget_at_the_present_speed() -> None:
    first, near, far = candidates = [measurement({"a": cost}, cost, 1 / cost) for cost in (10.0, 9.0, 4.0)]

    def follower(failed: Measurement, cost_s: float, budget_s: float, failure: str = "") -> Measurement | None:
        return sweep.next_after(failed, measurement({}, cost_s, 0.1, failure), candidates, budget_s)

    assert follower(first, 11.0, 10.0) is near
    assert follower(first, 12.0, 10.0) is far
    assert follower(first, 30.0, 10.0) is None
    assert follower(first, 5.0, 8.9) is far  # that it was faster once promises nothing
    assert follower(first, 0.0, 10.0, "stopped") is near
    assert follower(near, 11.0, 10.0) is far
    assert follower(far, 4.0, 10.0) is None


def test_of_too_many_some_are_taken_from_end_to_end() -> None:
    assert sweep._spread([*range(10, 20)], 4) == [10, 13, 16, 19]
    assert sweep._spread([1, 2], 4) == [1, 2]


def test_combinations_are_those_that_promise_most(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["resolution", "law", "cg_tolerance"])
    singles = sweep.one_at_a_time(knobs, quick=False)
    assert singles[0] == {}
    assert len(singles) == 1 + 4 + 5 + 3
    assert len(sweep.one_at_a_time(knobs, quick=True)) == 1 + 2 + 5 + 2
    effects: dict[str, dict[object, tuple[float, float]]] = {
        "resolution": {0.5: (0.2, 0.02), 2.0: (8.0, -0.02)},
        "cg_tolerance": {0.1: (0.5, 0.001)},
        "law": {"hooke": (0.1, 0.5)},  # cheap, but hopeless
    }
    measured = []
    for setting in singles:
        factor, change = 1.1, 0.5  # dearer and worse than the scene: not worth a combination
        for name, value in setting.items():
            factor, change = effects.get(name, {}).get(value, (factor, change))
        measured.append(measurement(setting, factor if setting else 1.0, 0.03 + (change if setting else 0.0)))
    chosen, possible = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert possible == 2
    assert chosen == [{"resolution": 0.5, "cg_tolerance": 0.1}, {"resolution": 2.0, "cg_tolerance": 0.1}]
    assert sweep.combinations(knobs, measured, 0, tolerance=0.02) == ([], 2)


def test_combinations_reach_the_accurate_end_but_not_excessive_times(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["resolution", "dt_s", "integrator"])
    half = knobs.knobs["dt_s"].own / 2  # type: ignore[operator]
    finer, shorter, second = {"resolution": 2.0}, {"dt_s": half}, {"integrator": "bdf2"}
    # Each takes more than half of the error away: added up, any two would leave less than nothing.
    measured = [measurement({}, 1.0, 0.03)]
    measured += [measurement(of, cost, 0.01) for of, cost in ((finer, 8.0), (shorter, 2.0), (second, 1.0))]
    chosen, possible = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert possible == len(chosen) == 4
    assert chosen[:2] == [shorter | second, finer | shorter | second]
    measured[1] = measurement(finer, 49.0, 0.01)
    assert finer | shorter | second not in sweep.combinations(knobs, measured, 10, tolerance=0.02)[0]
    assert finer | shorter | second in sweep.combinations(knobs, measured, 10, tolerance=0.02, budget_s=100.0)[0]


def test_equilibria_are_not_asked_for_more_often_than_the_scene_does(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["dt_s", "integrator"])
    own = knobs.knobs["dt_s"].own
    measured = [measurement({}, 1.0, 0.03), measurement({"integrator": "quasi_static"}, 1.0, 0.01)]
    measured += [measurement({"dt_s": own * factor}, 1 / factor, 0.02) for factor in (0.5, 2.0)]  # type: ignore[operator]
    chosen, _ = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert chosen == [{"dt_s": 2 * own, "integrator": "quasi_static"}]


def test_another_law_is_chosen_only_where_it_is_as_good_as_the_same(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)

    def of(setting: Setting, cost_s: float, error: float, moved: float) -> Measurement:
        return replace(measurement(setting, cost_s, error), moved=moved)

    own, like, unlike = (
        of({}, 3.0, 0.01, 0),
        of({"law": "like"}, 2.0, 0.01, 0.01),
        of({"law": "unlike"}, 1.0, 0.01, 0.3),
    )
    # Cancels what the mesh does, for this load.
    both = of({"law": "unlike", "resolution": 0.5}, 0.5, 0.001, 0.01)
    measured = [own, like, unlike, both]
    assert [sweep.is_same_tissue(one, measured, 0.02) for one in measured] == [True, True, False, False]
    assert sweep.fastest_within(measured, 0.02, knobs) == [like]
    assert sweep.most_accurate_within(measured, 5.0, 0.02, knobs) == [like]
    assert sweep.fastest_within([own, unlike, both], 0.02, knobs) == [own]
    # The effect of a law that failed alone is unknown.
    broken = measurement({"law": "unlike"}, 0.0, 0.0, failure="stopped")
    assert not sweep.is_same_tissue(both, [own, broken, both], 0.02)


def test_a_setting_that_is_close_by_chance_is_not_recommended(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)  # cg_tolerance 0.01, float
    coarse = {"resolution": 0.5}
    lucky, tight = measurement({**coarse, "cg_tolerance": 0.1}, 1.0, 0.01), measurement(coarse, 2.0, 0.03)
    own = measurement({}, 4.0, 0.015)
    loose = measurement({"cg_tolerance": 0.1}, 3.0, 0.0145)  # by less than scatter
    measured = [own, loose, tight, lucky, measurement({**coarse, "precision": "double"}, 5.0, 0.0, failure="stopped")]
    assert [sweep.is_close_by_chance(of, measured, knobs) for of in measured] == [False, False, False, True, False]
    assert sweep.fastest_within(measured, 0.02, knobs) == [loose]
    assert sweep.most_accurate_within(measured, 10.0, 0.02, knobs) == [loose, tight]
    # Solved neither better nor worse: fewer iterations, a smaller tolerance.
    other = measurement({**coarse, "cg_tolerance": 0.001, "cg_max_iterations": 25}, 1.0, 0.03)
    assert not sweep.is_close_by_chance(measurement({**coarse, "precision": "double"}, 5.0, 0.01), [other], knobs)
    # An equilibrium takes 50 Newton iterations where nothing is said, not the one of a step in time.
    still = {"integrator": "quasi_static"}
    fewer = measurement({**still, "newton_max_iterations": 5}, 1.0, 0.03)
    assert not sweep.is_close_by_chance(measurement(still, 1.0, 0.01), [fewer], knobs)
    # Solved better and closer is what one pays for.
    assert not sweep.is_close_by_chance(tight, [lucky, tight], knobs)


def test_a_law_that_moves_the_answer_is_not_combined(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["law", "cg_tolerance"])
    measured = [measurement({}, 1.0, 0.03), measurement({"cg_tolerance": 0.1}, 0.5, 0.03)]
    measured += [
        replace(measurement({"law": law}, 0.5, 0.03), moved=moved) for law, moved in (("hooke", 0.3), ("hencky", 0.01))
    ]
    chosen, _ = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert chosen == [{"law": "hencky", "cg_tolerance": 0.1}]
    # No faster, and closer to the reference by chance.
    measured[-1] = replace(measurement({"law": "hencky"}, 0.99, 0.01), moved=0.01)
    assert sweep.combinations(knobs, measured, 10, tolerance=0.02) == ([], 0)


def test_half_of_the_combinations_keep_the_law_though_another_is_faster(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["law", "resolution", "cg_tolerance"])
    settings = [{"resolution": 0.5}, {"resolution": 0.7}, {"cg_tolerance": 0.1}]
    measured = [measurement({}, 1.0, 0.03), *(measurement(setting, 0.5, 0.03) for setting in settings)]
    measured.append(replace(measurement({"law": "hencky"}, 0.9, 0.03), moved=0.01))
    chosen, possible = sweep.combinations(knobs, measured, 4, tolerance=0.02)
    assert possible == 7
    assert ["law" in of for of in chosen] == [False, False, True, True]
    # Places that one side cannot fill go to the other.
    assert len(sweep.combinations(knobs, measured, 6, tolerance=0.02)[0]) == 6
    assert len(sweep.combinations(knobs, measured, 9, tolerance=0.02)[0]) == 7
    assert len(sweep.combinations(knobs, measured[:-1], 2, tolerance=0.02)[0]) == 2


# --- store ------------------------------------------------------------------------------------------------------------


def with_another_law(knobs: Knobs) -> list[Measurement]:
    """The scene, three knobs that halve its cost, and a law that is as good and a little faster. 2 combinations keep
    the law (of two resolutions and a tolerance), 5 have the other one."""
    knobs.choose(["law", "resolution", "cg_tolerance"])
    settings = [{"resolution": 0.5}, {"resolution": 0.7}, {"cg_tolerance": 0.1}]
    measured = [measurement({}, 1.0, 0.03), *(measurement(setting, 0.5, 0.03) for setting in settings)]
    return [*measured, replace(measurement({"law": "hencky"}, 0.9, 0.03), moved=0.01)]


@pytest.mark.parametrize(("count", "own", "other"), [(1, 1, 0), (2, 1, 1), (3, 2, 1), (5, 2, 3), (9, 2, 5)])
def test_the_larger_half_of_the_combinations_keeps_the_law(tmp_path: Path, count: int, own: int, other: int) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    chosen, possible = sweep.combinations(knobs, with_another_law(knobs), count, tolerance=0.02)
    assert possible == 7
    assert ["law" in of for of in chosen] == own * [False] + other * [True]


def test_places_that_another_law_leaves_go_to_the_scenes_own(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    measured = with_another_law(knobs)
    with_law = [of for of in sweep.combinations(knobs, measured, 9, tolerance=0.02)[0] if "law" in of]
    measured += [measurement(of, 0.1, 0.03) for of in with_law]  # measured already: none is left to choose
    chosen, possible = sweep.combinations(knobs, measured, 2, tolerance=0.02)
    assert possible == 2
    assert [dict(of).get("law") for of in chosen] == [None, None]


@pytest.mark.parametrize(
    ("base_error", "error", "is_worthwhile"),
    [
        (0.03, 0.1, True),  # five tolerances
        (0.03, 0.101, False),
        (0.2, 0.299, True),  # half as much again as the scene's own
        (0.2, 0.301, False),
    ],
)
def test_a_value_whose_error_is_hopeless_is_not_combined(
    tmp_path: Path, base_error: float, error: float, is_worthwhile: bool
) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["resolution", "cg_tolerance"])
    measured = [measurement({}, 1.0, base_error), measurement({"cg_tolerance": 0.1}, 0.5, base_error)]
    measured.append(measurement({"resolution": 0.5}, 0.1, error))
    chosen, _ = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert bool(chosen) == is_worthwhile
