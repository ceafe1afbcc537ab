"""Guards and indicators through a real daemon. Without build/bin/tensormassd these are skipped."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import full_disk

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import scene_pb2
from tensormass_tools.cli import main
from tensormass_tools.output import state_name, status_line

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.005, lockstep: true}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 5, cells_y: 5, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
"""

Ran = tuple[int, list[dict[str, Any]]]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", zenoh=False) as running:
        yield running


def test_a_guard_stops_a_scene_at_its_last_good_state(server: tm.Server, tmp_path: Path) -> None:
    scene = tm.Scene.from_yaml(BLOCK)
    scene.message.solver.cg_max_iterations = 1
    scene.message.solver.cg_tolerance = 1e-9  # single precision does not reach it, whatever is tried
    scene.message.solver.floor_tolerance = 1e-9
    handle = server.load(scene, name="stopped")
    with pytest.raises(tm.FailedPreconditionError, match="step 1 left its bounds: the linear solve ended at"):
        handle.step()
    status = handle.status()
    assert state_name(status) == "faulted"
    assert (status.step, status.guard_events, status.guard_recoveries) == (0, 1, 0)
    assert handle.frame().step == 0
    with pytest.raises(tm.InvalidArgumentError, match="npz"):
        handle.write_report(tmp_path / "stopped.txt")
    with pytest.raises(tm.InvalidArgumentError, match=r"stopped\.npz: cannot be written: No such file or directory"):
        handle.write_report(tmp_path / "none" / "stopped.npz")
    with np.load(handle.write_report(tmp_path / "stopped.npz")) as report:
        assert json.loads(str(report["status"]))["fault"] == status.fault
        assert report["tissue/displacement"].shape == (6 * 6 * 4, 3)
        assert not report["tissue/displacement"].any()
        assert not report["tissue/velocity"].any()
        again = scene_pb2.Scene.FromString(report["scene"].tobytes())
        assert (again.name, again.bodies[0]) == ("stopped", scene.message.bodies[0])
    with np.load(server.scene("stopped").write_report(tmp_path / "by-another.npz")) as report:
        assert "scene" not in report  # who did not load it does not know it
    before = (tmp_path / "stopped.npz").read_bytes()
    with full_disk(100), pytest.raises(tm.InvalidArgumentError, match=r"stopped\.npz: cannot be written: File too"):
        handle.write_report(tmp_path / "stopped.npz")
    assert (tmp_path / "stopped.npz").read_bytes() == before
    server.load(again, name="again").unload()
    assert state_name(handle.reset()) == "lockstep"


def pressed_block(on_fault: str) -> tm.Scene:
    """A block under a probe, in which a node may move by 0.1 mm in a step."""
    scene = tm.Scene.from_yaml(BLOCK.replace("gravity_m_per_s2: {z: -9.81}\n", ""))
    scene.add_spherical_probe("probe", radius_m=0.01, position_m=(0.05, 0.05, 0.07))
    scene.set_guard(max_move_m=1e-4, on_fault=on_fault)  # type: ignore[arg-type]
    return scene


def test_a_scene_goes_on_where_a_step_cannot_be_made_and_says_so(server: tm.Server) -> None:
    handle = server.load(pressed_block("go_on"), name="goes-on")
    handle.step()
    assert not handle.feedback("probe").recovering
    hand_m = (0.05, 0.05, 0.05)
    handle.move_tool("probe", hand_m)  # as fast as the probe may move, into the block
    records: list[tm.StepRecord] = []
    while not records or not records[-1].recovering:
        records += handle.steps(1)
        assert len(records) < 20
    feedback, status = handle.feedback("probe"), handle.status()
    assert feedback.recovering
    assert feedback.gives_way
    np.testing.assert_allclose(feedback.anchor_m, hand_m)
    assert status.recovering
    assert (status.recoveries, status.recovering_steps) == (1, 1)
    assert "recoveries 1, 1 step" in status_line(status)
    handle.unload()


def test_a_scene_stops_where_a_step_cannot_be_made_if_it_is_told_to(server: tm.Server) -> None:
    handle = server.load(pressed_block("stop"), name="stops")
    handle.move_tool("probe", (0.05, 0.05, 0.05))
    with pytest.raises(tm.FailedPreconditionError, match="left its bounds"):
        handle.step(20)
    assert handle.status().recoveries == 0
    handle.unload()


def run_without_devices(scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], seconds: float) -> Ran:
    """`tensormass run` of a scene's text for so long."""
    (tmp_path / "scene.yaml").write_text(scene)
    options = ("--backend", "cpu", "--no-viewer", "--no-haptic", "--json", "--seconds", str(seconds))
    status = main(["run", str(tmp_path / "scene.yaml"), *options])
    return status, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_run_for_some_seconds_fails_as_soon_as_its_scene_is_stopped_and_leaves_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    stopped = BLOCK + "solver: {cg_max_iterations: 1, cg_tolerance: 1.0e-9, floor_tolerance: 1.0e-9}\n"
    status, (*_, last, error) = run_without_devices(stopped, tmp_path, capsys, 100)
    fault = last["status"]["fault"]
    assert (status, last["status"]["state"]) == (1, "STATE_FAULTED")
    assert error["kind"] == "FailedPreconditionError"
    written = tmp_path / "block-fault.npz"
    assert error["error"] == f"scene 'block' is stopped: {fault}\nits status and state: {written}"
    with np.load(written) as report:
        assert json.loads(str(report["status"]))["fault"] == fault
        assert report["tissue/displacement"].shape == (6 * 6 * 4, 3)
        assert scene_pb2.Scene.FromString(report["scene"].tobytes()).bodies[0].name == "tissue"
    written.unlink()
    written.mkdir()  # in its way
    _, (*_, error) = run_without_devices(stopped, tmp_path, capsys, 100)
    assert error["error"].startswith(
        f"scene 'block' is stopped: {fault}\nno report of it: {written}: cannot be written"
    )


def test_a_run_counts_its_seconds_from_where_the_scene_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    launched_s: list[float] = []

    def launch_late(**options: Any) -> tm.Server:  # noqa: ANN401
        time.sleep(1.0)
        server = tm.launch(**options)
        launched_s.append(time.monotonic())
        return server

    monkeypatch.setattr("tensormass_tools.run.launch", launch_late)
    status, said = run_without_devices(BLOCK, tmp_path, capsys, 0.9)
    assert time.monotonic() - launched_s[0] >= 0.9
    assert status == 0
    assert said[-1]["status"]["step"] > 0


def test_status_says_where_energy_went(server: tm.Server) -> None:
    status = server.load(tm.Scene.from_yaml(BLOCK), name="energy").step(40)
    assert status.work_j > 0
    assert status.elastic_energy_j > 0
    taken = status.work_j - status.kinetic_energy_j - status.elastic_energy_j
    assert status.HasField("dissipated_energy_j")
    assert status.dissipated_energy_j == pytest.approx(taken)
    assert taken > 0
    assert 0 < status.law_range_used < 1
    assert status.guard_events == 0


def test_a_probe_may_dip_fast_and_deep_into_the_demo_organ(server: tm.Server) -> None:
    """With the consistent stiffness under the probe, the organ's coarse elements were thrown within four steps."""
    handle = server.load(tm.Scene.from_file("demo"), lockstep=True, name="pressed")
    handle.step(120)
    handle.move_tool("probe", (-0.03, 0.02, 0.0426))  # 15 mm deep, as fast as the probe may move
    forces_n = []
    for _ in range(60):
        handle.step()
        forces_n.append(float(np.linalg.norm(handle.feedback("probe").force_n)))
    assert handle.status().guard_events == 0
    assert forces_n[-1] > 1
    assert max(forces_n) < 1.5 * forces_n[-1], "no blow on the way"
    handle.unload()
