"""How `tensormass solve` goes from step to step, and what it says of them: by statuses of a test's own."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import pytest

import tensormass as tm
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools.solve_steps import Solution
from tensormass_tools.solve_text import _vector

DT_S = 0.1


class Steps:
    """Stands for a scene's handle and for the writer of its results; nothing in it moves."""

    bodies: tuple[str, ...] = ("beam",)
    files = ()
    so_far = "Nothing is written"

    def __init__(self, statuses: Iterable[stream_pb2.SceneStatus]) -> None:
        self._statuses = enumerate(statuses, 1)

    def step(self) -> stream_pb2.SceneStatus:
        number, status = next(self._statuses)
        status.step = number
        status.simulated_time_s = number * DT_S
        return status

    def fields(self, body: str) -> SimpleNamespace:
        return SimpleNamespace(kinetic_energy_j=0.0)

    def write(self) -> list[Any]:
        self.bodies = ()
        return []


def compute(
    statuses: Iterable[stream_pb2.SceneStatus], scene: scene_pb2.Scene | None = None, **options: object
) -> dict[str, Any]:
    args: Any = SimpleNamespace(
        **{"steps": None, "seconds": None, "every": None, "preset": None, "allow_unconverged": False, **options}
    )
    scene = scene or scene_pb2.Scene()
    scene.stepping.dt_s = DT_S
    steps: Any = Steps(statuses)
    return Solution(args, scene, steps, steps).compute()


def still() -> Iterable[stream_pb2.SceneStatus]:
    return (stream_pb2.SceneStatus() for _ in itertools.count())


@pytest.mark.parametrize(("seconds", "steps"), [(3 * 0.1, 3), (0.3, 3), (0.31, 4), (0.01, 1)])
def test_seconds_are_made_of_whole_steps_but_for_rounding(seconds: float, steps: int) -> None:
    assert 3 * 0.1 / DT_S > 3  # as numbers go
    assert compute(still(), seconds=seconds)["steps"] == steps


def test_rest_is_looked_for_more_than_once_and_not_before_the_schedules_end() -> None:
    assert compute(still())["steps"] == 50
    scene = scene_pb2.Scene()
    scene.bodies.add().prescribed.add().schedule.time_s.extend([0.0, 7.5])
    assert compute(still(), scene)["steps"] == 80


def unconverged() -> list[stream_pb2.SceneStatus]:
    """The first and the third of three steps."""
    residuals = [(0.5, 1), (1e-9, 1), (0.2, 2)]
    return [
        stream_pb2.SceneStatus(newton_iterations=5, newton_residual=residual, unconverged_steps=count)
        for residual, count in residuals
    ]


def test_steps_that_did_not_converge_are_counted_and_the_worst_is_named() -> None:
    scene = scene_pb2.Scene(solver=scene_pb2.Solver(newton_max_iterations=5))
    summary = compute(unconverged(), scene, steps=3, allow_unconverged=True)
    assert (summary["unconverged_steps"], summary["newton_residual"], summary["newton_iterations"]) == (2, 0.5, 15)
    (warning,) = summary["warnings"]
    assert warning.startswith("step 1 of 3 did not converge: a residual of 5.0e-01 of the forces after 5 Newton ")
    assert warning.endswith(" (1 more steps like this, 5.0e-01 at most)")
    with pytest.raises(
        tm.NotConvergedError, match=r"^step 1 of 3 did not converge: .*Nothing is written; with --allow"
    ):
        compute(unconverged(), scene, steps=3)


def test_without_a_tolerance_a_solve_that_takes_all_its_iterations_is_done() -> None:
    def cut_off() -> list[stream_pb2.SceneStatus]:
        return [stream_pb2.SceneStatus(cg_iterations=10, cg_relative_residual=0.01)]

    scene = scene_pb2.Scene(solver=scene_pb2.Solver(cg_tolerance=0))
    assert compute(cut_off(), scene, steps=1)["warnings"] == []
    scene.solver.cg_tolerance = 0.001
    with pytest.raises(tm.NotConvergedError, match=r"a residual of 1\.0e-02 .* above cg_tolerance 0\.001"):
        compute(cut_off(), scene, steps=1)


def test_rounding_of_a_vector_is_zero_whatever_its_size() -> None:
    assert _vector([1e-9, -2e-9, 1e-16]) == "1e-09, -2e-09, 0"
    assert _vector([3e9, 1.0, 0.0]) == "3e+09, 0, 0"
    assert _vector([0.0, 0.0, 0.0]) == "0, 0, 0"
