"""`tensormass trade` with a real daemon: errors shrink as a scene is refined, and what is written runs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import tensormass as tm
from tensormass._shared import processes
from tensormass_tools.cli import main
from tensormass_tools.trade import reference
from tensormass_tools.trade.store import Machine

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

# A soft block under a probe; small enough for a busy machine.
BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.01}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.08, y: 0.08, z: 0.04}, cells_x: 6, cells_y: 6, cells_z: 4, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_stiffness_s: 0.005
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - {name: probe, spherical_probe: {radius_m: 0.02}, position_m: {x: 0.04, y: 0.04, z: 0.065}}
"""
# Equilibrium in one step.
BAR = """
name: bar
bodies:
  - name: bar
    mesh: {grid: {size_m: {x: 0.1, y: 0.02, z: 0.02}, cells_x: 10, cells_y: 2, cells_z: 2, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 10000, poisson_ratio: 0.3}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 0.001, y: 1, z: 1}}}]
    loads: [{region: {box: {min_m: {x: 0.0999, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 1}}}, traction_pa: {z: -5}}]
solver: {integrator: quasi_static, precision: double, newton_tolerance: 1.0e-6}
"""


def trade(text: str, folder: Path, *options: str) -> dict[str, Any]:
    (folder / "scene.yaml").write_text(text)
    run = ["trade", str(folder / "scene.yaml"), "--backend", "cpu", "--cpu-threads", "1", "--out", str(folder / "out")]
    main([*run, *options])
    return json.loads((folder / "out" / "trade.json").read_text())


def errors_of(result: dict[str, Any], **setting: object) -> dict[str, Any]:
    (found,) = (of["errors"] for of in result["measurements"] if of["setting"] == setting)
    return found


def test_a_pressed_block(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    # The number of levels ends the refinement, and not its time, which a busy machine spends on the first two.
    monkeypatch.setattr(reference, "find", partial(reference.find, most_levels=3))
    options = ("--knobs", "resolution,dt_s,cg_tolerance", "--quick", "--seconds", "0.6", "--tolerance", "10%")
    result = trade(BLOCK, tmp_path, *options, "--reference-seconds", "1000", "--timing-seconds", "0.1")
    said = capsys.readouterr()
    assert "reference, level 2" in said.err
    assert "* on the front" in said.out
    assert "stream codec: one choice, not measured" in said.out

    coarse, own, fine = errors_of(result, resolution=0.7), errors_of(result), errors_of(result, resolution=1.4)
    assert coarse["displacement"] > own["displacement"] > fine["displacement"] > 0
    assert 0 < own["force"] < 1  # it was felt
    assert 0 < own["force_held"] < 1
    assert 0 < own["force_moving"] < 1
    assert own["frequency"] < 0.5  # it swings
    (as_it_is,) = (of for of in result["measurements"] if not of["setting"])
    assert as_it_is["moved"] == 0  # the same run twice, bit by bit
    assert 0 < as_it_is["costs"]["step_p50_s"] <= as_it_is["costs"]["step_p99_s"] < as_it_is["costs"]["wall_s"]
    assert as_it_is["costs"]["latency_p50_s"] > as_it_is["costs"]["step_p50_s"]
    assert result["machine"]["backend"] == "cpu"
    assert any(len(of["setting"]) > 1 for of in result["measurements"])
    assert len(result["reference"]["levels"]) >= 2
    assert result["reference"]["force_error"] > 0

    # The written files were read and run again, with the same result.
    again, promised = result["confirmed"]["most_accurate"], result["most_accurate"]
    assert again["errors"] == promised["errors"]
    assert "most_accurate.yaml, read and run again" in said.out


def test_halving_the_step_halves_its_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # In steps of 10 ms a triangle comes into contact and leaves it within one.
    text = BLOCK.replace("dt_s: 0.01", "dt_s: 0.0025")
    options = ("--knobs", "dt_s", "--quick", "--seconds", "0.6", "--combinations", "0")
    result = trade(text, tmp_path, *options, "--reference-seconds", "0.1", "--timing-seconds", "0.1")
    capsys.readouterr()
    moved = {of["setting"].get("dt_s"): of["moved"] for of in result["measurements"]}
    assert 1.3 < moved[0.005] / moved[0.00125] < 3


def test_a_mesh_of_tetrahedra_is_compared_with_quadratic_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tm.write_mesh(tmp_path / "bar.msh", tm.grid([10, 2, 2], [0.1, 0.02, 0.02]))
    text = BAR[: BAR.index("grid:")] + "file: bar.msh}" + BAR[BAR.index("\n    law") :]
    options = ("--knobs", "element_order,newton_max_iterations", "--combinations", "0", "--timing-seconds", "0.1")
    result = trade(text, tmp_path, *options)
    assert "errors against the same mesh in quadratic tetrahedra" in capsys.readouterr().out
    assert errors_of(result)["displacement"] > 0.2  # linear tetrahedra lock
    assert errors_of(result, element_order="quadratic")["displacement"] < 1e-5


def test_equilibrium_in_one_step(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--knobs", "shape,quadrature,newton_max_iterations", "--combinations", "0", "--tolerance", "5%")
    result = trade(BAR, tmp_path, *options, "--reference-seconds", "5", "--timing-seconds", "0.1")
    capsys.readouterr()
    assert "knows no time" in result["not_varied"]["dt_s"]
    # Known from textbooks for linear tetrahedra, and for hexahedra with full quadrature.
    locked = errors_of(result, shape="tetrahedron")["displacement"]
    assert (
        locked
        > 2 * errors_of(result)["displacement"]
        > errors_of(result, shape="quadratic_tetrahedron")["displacement"]
    )
    assert 0 < result["reference"]["displacement_error"] < errors_of(result)["displacement"]
    assert errors_of(result)["force"] is None
    assert errors_of(result)["frequency"] is None
    assert errors_of(result, newton_max_iterations=1)["displacement"] > errors_of(result)["displacement"]
    # Two iterations reach the load in parts; written files are solved unchanged.
    (capped,) = (of for of in result["measurements"] if of["setting"] == {"newton_max_iterations": 2})
    assert not capped["failure"]
    fastest, out = tmp_path / "out" / "fastest.yaml", tmp_path / "fastest.vtu"
    assert main(["solve", str(fastest), "--out", str(out), "--backend", "cpu", "--cpu-threads", "1"]) == 0


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("dt_s: 0.01", "dt_s: 0", "scene.stepping.dt_s: 0 is not within"),
        ("dt_s: 0.01", 'dt_s: "NaN"', "scene.stepping.dt_s: nan is not within"),
        ("    mesh: {", "    # mesh: {", "body 'tissue'.mesh: no source"),
        (BLOCK[BLOCK.index("bodies:") :], "", "scene.bodies: a scene needs at least one body"),
        ("tools:", "solver: {budget_s: 1, floor_cg_iterations: 1000}\ntools:", "scene.solver.floor_cg_iterations: "),
        # Written files keep the name and must run unchanged.
        ("name: block", "name: my tiny", "scene.name: the name must be"),
        ("name: block", "", "scene.name: the name must be"),
        ("name: block", "name: ../x", "scene.name: the name must be"),
    ],
)
def test_a_refusal_of_the_daemon_comes_first(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    old: str,
    new: str,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.yaml").write_text(BLOCK.replace(old, new, 1))
    assert main(["trade", "scene.yaml", "--backend", "cpu"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"tensormass: {said}")
    assert list(tmp_path.iterdir()) == [tmp_path / "scene.yaml"]


def test_a_daemon_of_another_build_is_another_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    with tm.launch(backend="cpu", zenoh=False) as server:
        machine = Machine.of(server, None)
        monkeypatch.setenv("TENSORMASSD", "/bin/sh")
        assert Machine.of(server, None).build != machine.build
