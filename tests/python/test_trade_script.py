"""The test run of `tensormass trade` against a scene that moves by a formula."""

from __future__ import annotations

import itertools
import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from test_meshes import mixed_mesh

import tensormass as tm
from tensormass._src.fields import Fields
from tensormass._src.mesh_geometry import signed_volumes
from tensormass._src.meshes import FloatArray
from tensormass._src.packing import body_mesh
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_tools.trade import energy
from tensormass_tools.trade import recorder as recorder_module
from tensormass_tools.trade.energy import EnergyMeter
from tensormass_tools.trade.recorder import Recorder, node_volumes
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.script import Script, check_same_scene, rest_nodes

SCENE = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.01}
bodies:
  - name: block
    mesh:
      grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 4, cells_y: 2, cells_z: 2, shape: hexahedron}
      scale: 0.1
      translation_m: {z: 0.5}
    law: {hooke: {young_modulus_pa: 5000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
tools:
  - name: probe
    spherical_probe: {radius_m: 0.01, tip_offset_m: {z: -0.02}}
    position_m: {x: 0.05, y: 0.05, z: 0.7}
"""
# Time of a step that is a call of its own, relative to the others.
CALL_FACTOR = 1.5
STIFFNESS_N_PER_M = 100.0


class FormulaServer:
    """Stretches all bodies along z by 1 % · (1 − cos 2π 5 t); the tool hangs on a spring at its start."""

    def __init__(self, fault_at_step: int = 0, step_s: float = 1e-3) -> None:
        self.fault_at_step = fault_at_step
        self.step_s = step_s
        self.loaded: list[FormulaScene] = []
        #: Names of scenes that begin a run.
        self.runs: list[str] = []

    def version(self) -> control_pb2.GetVersionResponse:
        return control_pb2.GetVersionResponse(backend="cpu")

    def load(self, scene: scene_pb2.Scene, *, lockstep: bool) -> FormulaScene:
        assert lockstep
        assert scene.name not in [of.name for of in self.loaded if not of.unloaded]
        self.loaded.append(FormulaScene(scene, self))
        return self.loaded[-1]


def stretch(time_s: float) -> float:
    return 0.01 * (1 - math.cos(2 * math.pi * 5 * time_s))


class FormulaScene:
    def __init__(self, scene: scene_pb2.Scene, server: FormulaServer) -> None:
        self.name = scene.name
        self._scene = scene
        self._fault_at_step = server.fault_at_step
        self._step_s = server.step_s
        self._runs = server.runs
        self._step = 0
        self._times = tm.DurationHistogram()
        self.steps_ever = self.most_steps = 0
        self.busy_s = 0.0
        self._tool = self._start = np.array([scene.tools[0].position_m.z]) if scene.tools else np.zeros(1)
        self.unloaded = False
        self.report = control_pb2.SceneReport(bytes_total=1000)

    def positions(self, body: str) -> FloatArray:
        (of,) = (of for of in self._scene.bodies if of.name == body)
        rest = rest_nodes(of, body_mesh(of).nodes)
        return rest * [1, 1, 1 + stretch(self._step * self._scene.stepping.dt_s)]

    def fields(self, body: str) -> Fields:
        return Fields(self._step, 0.0, {}, 0.0, 0.0, 0.7)

    def move_tool(self, name: str, position_m: FloatArray) -> None:
        self._tool = position_m[2:]

    def step(self, count: int = 1) -> stream_pb2.SceneStatus:
        if self._step == 0:
            self._runs.append(self.name)
        self._step += count
        self.steps_ever += count
        self.busy_s += 1e-3 + count * self._step_s
        self.most_steps = max(self.most_steps, self._step)
        # The last step of a call also checks the elements and gathers a frame.
        self._time(CALL_FACTOR * self._step_s, 1)
        self._time(self._step_s, count - 1)
        status = stream_pb2.SceneStatus(step=self._step, min_det_f=1)
        status.unconverged_steps = 1
        if self._step == self._fault_at_step:
            status.fault = "left the numbers"
        for tool in self._scene.tools:
            feedback = status.tools.add(tool=tool.name)
            feedback.position_m.z = self._tool[0]
            feedback.force_n.z = STIFFNESS_N_PER_M * (self._start[0] - self._tool[0])
        return status

    def follow(self, name: str, poses: list[tuple[FloatArray, None, tuple[()]]]) -> stream_pb2.SceneStatus:
        timed = self._times
        for position_m, _, _ in poses:
            self.move_tool(name, position_m)
            status = self.step()
            if status.fault:
                break
        self._times = timed
        self._time(self._step_s, len(poses))
        return status

    def _time(self, step_s: float, count: int) -> None:
        self._times += tm.DurationHistogram.from_bounds([(step_s, count)] if count else [])

    def step_times(self) -> tm.DurationHistogram:
        return self._times

    def reset(self) -> None:
        self._step = 0
        self.busy_s += 0.05

    def topology(self) -> stream_pb2.Topology:
        return stream_pb2.Topology(bodies=[stream_pb2.BodySurface(vertex_count=5)])

    def unload(self) -> None:
        self.unloaded = True


def scene_of(text: str = SCENE) -> scene_pb2.Scene:
    return SceneFile.parse(text, Path(), "scene").message()


def record(
    scene: scene_pb2.Scene, base: scene_pb2.Scene, script: Script, server: FormulaServer | None = None
) -> Recording:
    return Recorder(server or FormulaServer(), base, script).record(scene)  # type: ignore[arg-type]


def measure(
    scenes: list[scene_pb2.Scene], server: FormulaServer, limit_s: float = 60
) -> list[Recording | tm.TensormassError]:
    base = scenes[-1]
    return Recorder(server, base, Script.of(base)).measure(scenes, limit_s)  # type: ignore[arg-type]


def recorded(scenes: list[scene_pb2.Scene], server: FormulaServer, limit_s: float = 60) -> list[Recording]:
    """Measures scenes, none of them stopped by a guard."""
    found = measure(scenes, server, limit_s)
    kept = [of for of in found if isinstance(of, Recording)]
    assert len(kept) == len(found), found
    return kept


def test_the_tip_goes_to_the_surface_by_the_shortest_way() -> None:
    script = Script.of(scene_of(), None)
    # The tip starts at z = 0.68, the surface is at 0.6.
    assert script.travel_m == pytest.approx((0, 0, -0.075))
    assert Script.of(scene_of(), None, 1).travel_m == pytest.approx((0, 0, -0.08))
    assert script.start_m == (0.05, 0.05, 0.7)
    for half in (0.5**0.5, 3.0):  # a quaternion of any length
        turned = scene_of(SCENE + f"    orientation: {{w: {half}, x: 0, y: {half}, z: 0}}\n")
        # Turned by a quarter about y, the tip is at (−0.02, 0, 0) from the tool.
        assert Script.of(turned, None, 1).travel_m == pytest.approx((0.025 - 0.03, 0, -0.1))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("dt_s: 0.01", "dt_s: 0.5", "0.5 does not divide the 0.02 s"),
        ("dt_s: 0.01", "dt_s: 0.012", "0.012 does not divide"),  # 0.024 s would be taken for 0.02
        ("- name: block", "- name: other", "bodies are other, those of the scene that is measured block"),
        ("- name: probe", "- name: needle", "has no 'probe'"),
    ],
)
def test_another_scene_is_refused_by_the_script(old: str, new: str, said: str) -> None:
    own = scene_of()
    with pytest.raises(tm.InvalidArgumentError, match=said):
        check_same_scene(scene_of(SCENE.replace(old, new)), own, Script.of(own))
    for dt_s in ("0.02", "0.0066667"):
        check_same_scene(scene_of(SCENE.replace("dt_s: 0.01", f"dt_s: {dt_s}")), own, Script.of(own))


def test_a_motion_is_not_put_through_a_script_of_one_step() -> None:
    moving = SCENE[: SCENE.index("tools:")]
    own = scene_of(moving + "solver: {integrator: quasi_static}\n")
    check_same_scene(own, own, Script.of(own))
    with pytest.raises(tm.InvalidArgumentError, match="take quasi_static"):
        check_same_scene(scene_of(moving), own, Script.of(own))


@pytest.mark.parametrize(
    "edit", [("cells_x: 4", "cells_x: 7"), ("hexahedron", "quadratic_tetrahedron"), ("0.01}", "0.005}")]
)
def test_all_settings_are_looked_at_in_the_same_points_and_times(edit: tuple[str, str]) -> None:
    base = scene_of()
    script = Script.of(base, 0.4)
    changed = scene_of(SCENE.replace("dt_s: 0.01}", "dt_s: 0.005}") if edit[0] == "0.01}" else SCENE.replace(*edit))
    server = FormulaServer()
    got = record(changed, base, script, server)
    (displacement,) = got.displacement
    points = rest_nodes(base.bodies[0], body_mesh(base.bodies[0]).nodes)
    times = script.sample_s * np.arange(1, script.sample_count + 1)
    assert displacement.shape == (20, len(points), 3)
    expected = points[:, 2] * np.array([[stretch(t)] for t in times])
    np.testing.assert_allclose(displacement[:, :, 2], expected, atol=1e-12)
    np.testing.assert_allclose(displacement[:, :, :2], 0, atol=1e-12)
    np.testing.assert_allclose(got.volume[0], [1 + stretch(t) for t in times], rtol=1e-9)
    assert got.force.shape == (20, 3)
    pressed = [0.7 - script.pose(t)[2] for t in times]  # position of the tool at the end of the step
    np.testing.assert_allclose(got.force[:, 2], STIFFNESS_N_PER_M * np.array(pressed), atol=1e-12)
    spring_j = STIFFNESS_N_PER_M * 0.075**2 / 2  # energy of the spring at the deepest point
    assert got.work_j == pytest.approx(spring_j, rel=1e-6)
    assert got.free_times_s[-1] == pytest.approx(0.35 * script.duration_s)
    assert got.outside_share == 0
    assert got.min_det_f == pytest.approx(0.7)
    assert got.costs.step_count == round(0.4 / changed.stepping.dt_s)
    assert got.costs.frame_bytes == 60
    assert got.costs.step_energy_j is None
    assert server.loaded[0].unloaded


def test_points_stand_for_all_of_the_volume() -> None:
    mesh = mixed_mesh()
    assert node_volumes(mesh).sum() == pytest.approx(signed_volumes(mesh).sum())
    assert node_volumes(mesh).min() > 0


def test_only_the_last_few_meshes_are_remembered() -> None:
    base = scene_of()
    recorder = Recorder(FormulaServer(), base, Script.of(base))  # type: ignore[arg-type]
    volumes = [body_mesh(scene_of(SCENE.replace("cells_x: 4", f"cells_x: {n}")).bodies[0]) for n in range(1, 7)]
    taken = [recorder.interpolations([volume]) for volume in volumes]
    assert recorder.interpolations([volumes[-1]]) is taken[-1]
    assert recorder.interpolations([volumes[2]]) is taken[2]
    assert recorder.interpolations([volumes[1]]) is not taken[1]


def test_equilibrium_is_timed_more_than_once_and_counted_once() -> None:
    text = SCENE[: SCENE.index("tools:")] + "solver: {integrator: quasi_static}\n"
    server = FormulaServer()
    (got,) = recorded([scene_of(text)], server)
    assert got.displacement[0].shape[0] == got.costs.step_count == got.unconverged_steps == 1
    assert got.costs.timed_steps == 500
    assert server.loaded[0].steps_ever == 501


def test_scenes_are_timed_in_turns_until_each_has_enough_steps() -> None:
    short, long = scene_of(SCENE.replace("dt_s: 0.01}", "dt_s: 0.02}")), scene_of()
    server = FormulaServer()
    got = recorded([short, long], server)
    assert [of.costs.step_count for of in got] == [80, 160]
    assert [of.costs.timed_steps for of in got] == [560, 1120]  # seven runs each
    assert [of.displacement[0].shape[0] for of in got] == [80, 80]
    assert server.runs == ["trade_0", "trade_1"] * 8  # the first run of each is recorded, not timed
    assert all(of.unloaded for of in server.loaded)


def test_a_scene_that_stops_does_not_keep_others_from_being_timed() -> None:
    server = FormulaServer(fault_at_step=120)
    stopped, timed = measure([scene_of(), scene_of(SCENE.replace("dt_s: 0.01}", "dt_s: 0.02}"))], server)
    assert isinstance(stopped, tm.FailedPreconditionError)
    assert isinstance(timed, Recording)
    assert timed.costs.timed_steps == 560
    assert all(of.unloaded for of in server.loaded)


def test_scenes_timed_for_comparison_take_turns_and_come_last(monkeypatch: pytest.MonkeyPatch) -> None:
    server = FormulaServer()
    Meter(server, monkeypatch)
    scene, own = scene_of(), scene_of(SCENE.replace("dt_s: 0.01}", "dt_s: 0.02}"))
    got, of_own = Recorder(server, scene, Script.of(scene)).measure([scene], 60, beside=[own])  # type: ignore[arg-type]
    assert server.runs[:14] == ["trade_0", "trade_1"] * 7
    assert isinstance(got, Recording)
    assert isinstance(of_own, Recording)
    assert [got.costs.timed_steps, of_own.costs.timed_steps] == [1120, 560]
    assert got.costs.step_energy_j is not None
    assert of_own.costs.step_energy_j is None


def test_timing_ends_where_it_takes_too_long() -> None:
    server = FormulaServer()
    (got,) = recorded([scene_of()], server, limit_s=0)
    assert got.costs.timed_steps == got.costs.step_count == 160
    assert server.loaded[0].steps_ever == 320


def test_timed_steps_hold_no_check_and_no_frame_of_their_own() -> None:
    server = FormulaServer()
    (got,) = recorded([scene_of()], server)
    steps = server.loaded[0].step_times()
    assert got.costs.step_p50_s == got.costs.step_p99_s == pytest.approx(server.step_s, rel=1 / 32)
    assert steps.max_s == pytest.approx(CALL_FACTOR * server.step_s, rel=1 / 32), (
        "those of the recorded run were longer"
    )


def test_a_daemon_that_ended_is_not_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(self: FormulaScene) -> None:
        raise tm.UnavailableError("the daemon is gone")

    monkeypatch.setattr(FormulaScene, "reset", gone)
    with pytest.raises(tm.UnavailableError):
        measure([scene_of()], FormulaServer())


class Meter(EnergyMeter):
    """100 W while the first scene is busy, whose time is the run's; the counter moves ten times a second."""

    def __init__(self, server: FormulaServer, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(wanted=False)
        self._server = server
        self.watts = 100.0
        monkeypatch.setattr(energy, "time", types.SimpleNamespace(monotonic=lambda: server.loaded[0].busy_s))
        monkeypatch.setattr(recorder_module, "EnergyMeter", lambda wanted: self)

    @property
    def readable(self) -> bool:
        return True

    def read_j(self) -> float:
        return self.watts * 0.1 * (self._server.loaded[0].busy_s // 0.1)


@pytest.mark.parametrize("one_step", [False, True])
def test_energy_is_counted_of_steps_alone(monkeypatch: pytest.MonkeyPatch, one_step: bool) -> None:
    server = FormulaServer(step_s=0.1 if one_step else 1e-3)
    meter = Meter(server, monkeypatch)
    text = SCENE[: SCENE.index("tools:")] + "solver: {integrator: quasi_static}\n" if one_step else SCENE
    scene = scene_of(text)
    recorder = Recorder(server, scene, Script.of(scene, None))  # type: ignore[arg-type]
    (got,) = recorder.measure([scene], 60)
    assert isinstance(got, Recording)
    # With the way back to the start it would be a third more, or half.
    assert got.costs.step_energy_j == pytest.approx(100 * server.step_s, rel=0.1)
    assert server.loaded[0].most_steps == got.costs.step_count  # never farther than the script goes
    assert recorder.record(scene).costs.step_energy_j is None
    server.loaded.clear()
    meter.watts = 0.0
    (got,) = recorder.measure([scene], 60)
    assert isinstance(got, Recording)
    assert got.costs.step_energy_j is None


def test_a_scene_that_stops_while_energy_is_counted_is_still_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    server = FormulaServer()
    Meter(server, monkeypatch)
    scene = scene_of()
    step = FormulaScene.step

    def stopping(self: FormulaScene, count: int = 1) -> stream_pb2.SceneStatus:
        if count > 1:  # the script itself goes step by step
            raise tm.FailedPreconditionError("left its bounds")
        return step(self, count)

    monkeypatch.setattr(FormulaScene, "step", stopping)
    (got,) = recorded([scene], server)
    assert got.costs.step_energy_j is None
    assert got.costs.step_count == 160


def test_the_meter_reads_joules_where_it_can(monkeypatch: pytest.MonkeyPatch) -> None:
    nvml = types.SimpleNamespace(
        nvmlInit=lambda: None,
        nvmlDeviceGetHandleByIndex=lambda index: index,
        nvmlDeviceGetTotalEnergyConsumption=lambda device: 2500,  # mJ
    )
    monkeypatch.setitem(sys.modules, "pynvml", nvml)
    assert EnergyMeter(wanted=True).read_j() == 2.5
    assert not EnergyMeter(wanted=False).readable
    monkeypatch.setitem(sys.modules, "pynvml", None)  # no such package
    assert not EnergyMeter(wanted=True).readable


def test_the_meter_counts_from_one_move_to_another(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count()
    monkeypatch.setattr(energy, "time", types.SimpleNamespace(monotonic=lambda: 0.4 * next(clock)))
    meter = EnergyMeter(wanted=False)

    def count(readings_j: list[float]) -> energy.Count | None:
        readings = itertools.chain(readings_j, itertools.repeat(readings_j[-1]))
        monkeypatch.setattr(meter, "read_j", lambda: next(readings))
        return meter.count((runs, 10 * runs) for runs in itertools.count(1))

    # Moves after the second run and the fifth; what is under way before and after them is not counted.
    assert count([1.0, 1.0, 3.0, 3.0, 3.0, 7.0, 7.0]) == energy.Count(4.0, 3, 30)
    assert count([1.0, 3.0]) is None
    assert count([1.0]) is None


def test_a_scene_that_stops_is_an_error_and_is_unloaded() -> None:
    server = FormulaServer(fault_at_step=3)
    with pytest.raises(tm.FailedPreconditionError, match="left the numbers"):
        record(scene_of(), scene_of(), Script.of(scene_of(), None), server)
    assert server.loaded[0].unloaded
