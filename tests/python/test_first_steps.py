"""The first steps of a scene, measured in a daemon."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

import tensormass as tm
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_tools import first_steps
from tensormass_tools.first_steps import measure
from tensormass_tools.fitting import Measured
from tensormass_tools.hand import HandScript

BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 5, cells_y: 5, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.015}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
"""


def scene(text: str) -> scene_pb2.Scene:
    return tm.Scene.from_yaml(text).message


def test_steps_are_measured_and_leave_nothing_behind(server: tm.Server) -> None:
    found = measure(server, scene(BLOCK), None, 1.0)
    assert found is not None
    assert 0 < found.p50_s <= found.p99_s
    assert found.period_s == 0.005
    assert found.elements == 5 * 5 * 3 * 6
    assert server.scenes() == []


def test_a_hand_moves_the_tool(server: tm.Server, tmp_path: Path) -> None:
    script = tmp_path / "hand.yaml"
    script.write_text("""
tool: probe
poses:
  - {time_s: 0, position_m: {x: 0.05, y: 0.05, z: 0.08}}
  - {time_s: 10, position_m: {x: 0.05, y: 0.05, z: 0.06}}
""")
    assert measure(server, scene(BLOCK), HandScript.read(script), 1.0) is not None
    script.write_text(script.read_text().replace("tool: probe", "tool: nobody"))
    assert measure(server, scene(BLOCK), HandScript.read(script), 1.0) is None


def test_a_scene_that_stops_or_is_refused_has_no_measure(server: tm.Server) -> None:
    stops = BLOCK + "solver: {cg_max_iterations: 1, cg_tolerance: 1.0e-9, floor_tolerance: 1.0e-9}\n"
    assert measure(server, scene(stops), None, 1.0) is None
    refused = BLOCK.replace("density_kg_per_m3: 1000", "density_kg_per_m3: -1")
    assert measure(server, scene(refused), None, 1.0) is None
    assert server.scenes() == []


def test_one_step_to_equilibrium_has_no_measure(server: tm.Server) -> None:
    assert measure(server, tm.Scene.from_file("cantilever").message, None, 1.0) is None


# --- with a fake daemon and clock -------------------------------------------------------------------------------------


class Steps:
    """A daemon whose steps take given times. It is its own handle, and its clock is the only one."""

    def __init__(self, times_s: Callable[[int], float], fault_at: int = 0) -> None:
        self.made = self.resets = 0
        self.now_s = 0.0
        self.report = control_pb2.SceneReport(bodies=[control_pb2.BodyReport(element_count=450)])
        self._times_s = times_s
        self._fault_at = fault_at

    @contextlib.contextmanager
    def load(self, _scene: scene_pb2.Scene, *, lockstep: bool) -> Iterator[Steps]:
        assert lockstep
        yield self

    def move_tool(self, *_pose: object) -> None:
        pass

    def step(self, count: int) -> stream_pb2.SceneStatus:
        assert count == 1
        self.made += 1
        self.now_s += self._times_s(self.made)
        return stream_pb2.SceneStatus(fault="it left its bounds" if self.made == self._fault_at else "")

    def reset(self) -> None:
        self.resets += 1

    def measured(self, monkeypatch: pytest.MonkeyPatch) -> Measured | None:
        clock = SimpleNamespace(perf_counter=lambda: self.now_s, monotonic=lambda: self.now_s)
        monkeypatch.setattr(first_steps, "time", clock)
        slow_motion = scene(BLOCK.replace("dt_s: 0.005", "dt_s: 0.02"))
        return measure(cast(tm.Server, self), slow_motion, None, 0.5)


#: Steps of a press of 0.8 s.
PATH = 40


def test_a_path_that_leaves_room_is_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps(lambda _: 0.009)
    measured = steps.measured(monkeypatch)
    assert measured is not None
    assert (measured.p50_s, measured.p99_s) == pytest.approx((0.009, 0.009))
    assert (measured.period_s, measured.elements) == (0.02, 450)
    assert (steps.made, steps.resets) == (PATH, 0)


def test_steps_that_something_else_disturbed_are_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps(lambda number: 0.1 if number in (5, PATH + 20) else 0.009)
    found = steps.measured(monkeypatch)
    assert found is not None
    assert found.p99_s == pytest.approx(0.009)
    assert (steps.made, steps.resets) == (2 * PATH, 1)


def test_steps_that_are_always_slow_are_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps(lambda number: 0.1 if number % PATH in (5, 6) else 0.009)
    found = steps.measured(monkeypatch)
    assert found is not None
    assert found.p99_s == pytest.approx(0.1)
    assert steps.made == 2 * PATH, "a second pass shows that nothing else disturbed them"


def test_a_busy_machine_is_measured_until_nothing_disturbs(monkeypatch: pytest.MonkeyPatch) -> None:
    disturbed = [(1, 2), (2, 3), (3,)]  # places in each five steps, by pass
    steps = Steps(lambda number: 0.05 if (number - 1) % 5 in disturbed[(number - 1) // PATH] else 0.009)
    found = steps.measured(monkeypatch)
    assert found is not None
    assert found.p99_s == pytest.approx(0.009)
    assert steps.made == 3 * PATH


def test_a_scene_that_is_much_too_slow_is_left_early(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = Steps(lambda _: 0.03)
    found = steps.measured(monkeypatch)
    assert found is not None
    assert found.need() == pytest.approx(1.5)
    assert steps.made < PATH


def test_a_scene_that_stops_in_the_last_step_has_no_measure(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Steps(lambda _: 0.009, fault_at=PATH).measured(monkeypatch) is None
