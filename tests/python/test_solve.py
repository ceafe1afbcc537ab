"""`tensormass solve` with a real daemon: forces balance, files hold what was computed, and what failed is said."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from conftest import Recorder, full_disk
from test_meshes import mixed_mesh

import tensormass as tm
from tensormass._shared import processes
from tensormass._src import grids, mesh_files, mesh_repair, meshes
from tensormass._src.fields import FIELD_NAMES, NODE_FIELDS
from tensormass.v1 import control_pb2, finding_pb2, stream_pb2
from tensormass_tools.cli import main
from tensormass_tools.output import Warnings

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

# A clamped bar of hexahedra along x; `%` is where a test writes the rest of the body and of the scene.
BAR = """
name: bar
bodies:
  - name: bar
    mesh: {grid: {size_m: {x: 1, y: 0.1, z: 0.1}, cells_x: 20, cells_y: 2, cells_z: 2, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 1.0e+6, poisson_ratio: 0.3}}
    density_kg_per_m3: 1000
    sets:
      - {name: wall, regions: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 0.001, y: 1, z: 1}}}]}
      - {name: tip, regions: [{box: {min_m: {x: 0.999, y: -1, z: -1}, max_m: {x: 2, y: 1, z: 1}}}]}
    fixed: [{set: wall}]
    %s
solver: {precision: double, integrator: quasi_static, cg_max_iterations: 2000, cg_tolerance: 1.0e-5, %s}
%s
"""
TRACTION = "loads: [{region: {set: tip}, traction_pa: {z: -10}}]"


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as server:
        yield server


@pytest.fixture
def solve(server: tm.Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Solved]:
    """Solves a scene's text or file in the module's daemon."""

    def solve(scene: str, *options: str, files: dict[str, meshes.VolumeMesh] | None = None) -> Solved:
        if "\n" in scene:
            for name, mesh in (files or {}).items():
                mesh_files.write_mesh(tmp_path / name, mesh)
            (tmp_path / "scene.yaml").write_text(scene)
            scene = str(tmp_path / "scene.yaml")
        out = tmp_path / "result.vtu"
        status = main(["solve", scene, "--out", str(out), "--server", server.address, "--json", *options])
        said = json.loads(capsys.readouterr().out)
        assert server.scenes() == []  # nothing is left behind
        return Solved(status, said, out)

    return solve


class Solved:
    def __init__(self, status: int, said: dict[str, Any], out: Path) -> None:
        self.status = status
        self.said = said
        self.out = out

    @property
    def vtu(self) -> meshio.Mesh:
        return meshio.read(self.out)


def test_a_cantilever_bends_as_the_beam_formula_says_and_the_wall_holds_the_load(
    solve: Callable[..., Solved],
) -> None:
    solved = solve(BAR % (TRACTION + "\n    quadrature: selective", "newton_tolerance: 1.0e-9", ""))
    assert (solved.status, solved.said["steps"], solved.said["warnings"]) == (0, 1, [])
    body = solved.said["bodies"][0]
    load_n, length_m, side_m, young_pa = 10 * 0.1**2, 1.0, 0.1, 1e6
    inertia_m4 = side_m**4 / 12
    deflection_m = load_n * length_m**3 / (3 * young_pa * inertia_m4)
    assert body["max_displacement_m"] == pytest.approx(deflection_m, rel=0.1)  # two elements over the height
    np.testing.assert_allclose(body["reaction_sum_n"], [0, 0, load_n], atol=1e-8 * load_n)
    assert body["elastic_energy_j"] == pytest.approx(load_n * body["max_displacement_m"] / 2, rel=0.05)
    assert solved.said["newton_residual"] <= 1e-9


def test_the_file_holds_every_field_on_the_mesh_at_rest(solve: Callable[..., Solved], server: tm.Server) -> None:
    text = BAR % (TRACTION, "newton_tolerance: 1.0e-9", "")
    solved = solve(text)
    assert solved.status == 0
    vtu = solved.vtu
    grid = grids.grid([20, 2, 2], [1.0, 0.1, 0.1], shape="hexahedron")
    np.testing.assert_allclose(vtu.points, grid.nodes, atol=1e-12)
    np.testing.assert_array_equal(vtu.cells[0].data, grid.blocks[0].nodes)
    assert set(vtu.point_data) == set(NODE_FIELDS)
    assert set(vtu.cell_data) == {"body", *FIELD_NAMES} - NODE_FIELDS
    handle = server.load(tm.Scene.from_yaml(text), lockstep=True)
    try:
        handle.step()
        fields = handle.fields("bar", FIELD_NAMES)
    finally:
        handle.unload()
    for name in FIELD_NAMES:
        expected = fields[name]
        if name == "cauchy_stress":
            expected = expected[:, [0, 1, 2, 5, 3, 4]]  # the order of VTK's symmetric tensors
        data = vtu.point_data[name] if name in NODE_FIELDS else vtu.cell_data[name][0]
        np.testing.assert_allclose(data, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    # Tension above, pressure below, and the shear that carries a load towards -z from the wall to the tip.
    xx, xz = fields["cauchy_stress"][:, 0], fields["cauchy_stress"][:, 4]
    height = grid.nodes[grid.blocks[0].nodes].mean(axis=1)[:, 2]
    assert (xx[height > 0.05] > 0).all()
    assert (xx[height < 0.05] < 0).all()
    assert xz.mean() == pytest.approx(-10, rel=0.01)


def test_only_the_fields_asked_for_are_written(solve: Callable[..., Solved]) -> None:
    vtu = solve(BAR % (TRACTION, "", ""), "--fields", "displacement, det_f").vtu
    assert set(vtu.point_data) == {"displacement"}
    assert set(vtu.cell_data) == {"body", "det_f"}


def test_a_bar_is_twisted_in_as_many_steps_as_its_schedule_takes(solve: Callable[..., Solved], tmp_path: Path) -> None:
    grid = grids.grid([8, 4, 4], [0.4, 0.1, 0.1], shape="hexahedron", origin_m=[0.0, -0.05, -0.05])
    angle = np.pi / 3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) - np.eye(2)
    prescribed = []
    for node in np.flatnonzero(grid.nodes[:, 0] > 0.399):
        y, z = turn @ grid.nodes[node, 1:]
        region = f"{{nodes: {{indices: [{node}]}}}}"
        schedule = "{time_s: [0, 1], factor: [0, 1]}"
        prescribed.append(f"{{region: {region}, x_m: 0, y_m: {y:.17g}, z_m: {z:.17g}, schedule: {schedule}}}")
    text = f"""
        name: twisted
        bodies:
          - name: bar
            mesh: {{file: bar.vtu}}
            law: {{stable_neo_hookean: {{young_modulus_pa: 1000, poisson_ratio: 0.4}}}}
            density_kg_per_m3: 1000
            fixed: [{{box: {{min_m: {{x: -1, y: -1, z: -1}}, max_m: {{x: 0.001, y: 1, z: 1}}}}}}]
            prescribed: [{", ".join(prescribed)}]
        stepping: {{dt_s: 0.25}}
        solver: {{integrator: quasi_static, newton_tolerance: 1.0e-8, cg_max_iterations: 1000, cg_tolerance: 1.0e-4}}
    """
    solved = solve(text, "--every", "2", files={"bar.vtu": grid})
    assert (solved.status, solved.said["steps"], solved.said["simulated_time_s"]) == (0, 4, 1.0)
    u = solved.vtu.point_data["displacement"]
    end = grid.nodes[:, 0] > 0.399
    np.testing.assert_allclose(u[end, 1:], grid.nodes[end, 1:] @ turn.T, atol=1e-12)
    # The middle turns by half of the angle, and the reactions at both ends hold each other.
    middle = (np.abs(grid.nodes[:, 0] - 0.2) < 1e-9) & (np.abs(grid.nodes[:, 1:]).max(axis=1) > 0.049)
    x, moved = grid.nodes[middle, 1:], (grid.nodes + u)[middle, 1:]
    turned = np.arctan2(x[:, 0] * moved[:, 1] - x[:, 1] * moved[:, 0], (x * moved).sum(axis=1))
    np.testing.assert_allclose(turned, angle / 2, rtol=0.02)
    force = solved.vtu.point_data["reaction_force"]
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-6 * np.abs(force).max())
    torque = np.cross(grid.nodes + u, force)[:, 0]
    assert torque[end].sum() > 0
    assert torque.sum() == pytest.approx(0, abs=1e-6 * torque[end].sum())
    # The series: every second step, and where it began.
    series = ElementTree.parse(tmp_path / "result.pvd").getroot().iter("DataSet")
    times = {entry.get("file"): float(entry.get("timestep", "nan")) for entry in series}
    assert times == {"result_000000.vtu": 0.0, "result_000002.vtu": 0.5, "result_000004.vtu": 1.0}
    assert not meshio.read(tmp_path / "result_000000.vtu").point_data["displacement"].any()
    half, whole = (meshio.read(tmp_path / f"result_00000{n}.vtu").point_data["displacement"] for n in (2, 4))
    np.testing.assert_array_equal(whole, u)
    np.testing.assert_allclose(half[end], u[end] / 2, atol=1e-12)


def test_a_mixed_mesh_is_stretched_evenly(solve: Callable[..., Solved]) -> None:
    box = mixed_mesh()
    kept = np.ones(box.element_count, bool)
    kept[-2:] = False  # the bar without what stands on its end
    bar = mesh_repair.compact(box, kept)
    walls = {"wall": bar.nodes[:, 0] == 0, "tip": bar.nodes[:, 0] == 3}
    walls |= {"low_y": bar.nodes[:, 1] == 0, "low_z": bar.nodes[:, 2] == 0}
    bar = meshes.VolumeMesh.from_arrays(bar.nodes, [(s.name, e) for s, e in bar.blocks], sets=walls)
    text = """
        name: stretched
        bodies:
          - name: bar
            mesh: {file: bar.vtu}
            law: {mooney_rivlin: {c10_pa: 1000, c01_pa: 500, bulk_modulus_pa: 20000}}
            density_kg_per_m3: 1000
            prescribed:
              - {region: {set: wall}, x_m: 0}
              - {region: {set: low_y}, y_m: 0}
              - {region: {set: low_z}, z_m: 0}
              - {region: {set: tip}, x_m: 0.6}
        solver: {integrator: quasi_static, newton_tolerance: 1.0e-10, cg_max_iterations: 1000, cg_tolerance: 1.0e-6}
    """
    solved = solve(text, files={"bar.vtu": bar})
    assert solved.status == 0
    u = solved.vtu.point_data["displacement"]
    across = u[walls["tip"] & (bar.nodes[:, 1] == 1), 1].mean()
    assert across < -0.05
    np.testing.assert_allclose(u, bar.nodes * [0.2, across, across], atol=1e-8)
    assert {block.type for block in solved.vtu.cells} == {"hexahedron", "pyramid", "wedge"}
    stress = np.concatenate(solved.vtu.cell_data["cauchy_stress"])
    np.testing.assert_allclose(stress, np.broadcast_to(stress[0], stress.shape), atol=1e-6 * stress[0, 0])
    np.testing.assert_allclose(stress[:, 1:], 0, atol=1e-6 * stress[0, 0])
    pull_n = np.abs(solved.vtu.point_data["reaction_force"][walls["tip"], 0].sum())
    assert pull_n == pytest.approx(stress[0, 0] * (1 + across) ** 2, rel=1e-8)


def test_every_element_has_its_own_stiffness(solve: Callable[..., Solved]) -> None:
    grid = grids.grid([2, 1, 1], [2.0, 1.0, 1.0], shape="hexahedron")
    mesh = meshes.VolumeMesh.from_arrays(
        grid.nodes,
        [("hexahedron", grid.blocks[0].nodes)],
        sets={"wall": grid.nodes[:, 0] == 0, "tip": grid.nodes[:, 0] == 2, "all": np.arange(12)},
        element_fields={"young_modulus_pa": [1000.0, 4000.0]},
    )
    text = """
        name: springs
        bodies:
          - name: springs
            mesh: {file: springs.vtu}
            law: {hooke: {young_modulus_pa: 1, poisson_ratio: 0}}
            density_kg_per_m3: 1000
            fixed: [{set: wall}]
            prescribed: [{region: {set: all}, y_m: 0, z_m: 0}]
            loads: [{region: {set: tip}, force_n: {x: 10}}]
        solver: {integrator: quasi_static, cg_tolerance: 1.0e-9}
    """
    solved = solve(text, files={"springs.vtu": mesh})
    assert solved.status == 0
    moved = solved.vtu.point_data["displacement"][:, 0]
    np.testing.assert_allclose(moved, np.tile([0, 10 / 1000, 10 / 1000 + 10 / 4000], 4), rtol=1e-6)


def test_bodies_share_a_file_and_are_told_apart(solve: Callable[..., Solved]) -> None:
    body = """
          - name: %s
            mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 1, cells_y: 1, cells_z: 1, shape: %s}, scale: 0.1,
                   translation_m: {x: %d}}
            law: {hooke: {young_modulus_pa: 1000, poisson_ratio: 0.3}}
            density_kg_per_m3: 1000
            fixed: [{nodes: {indices: [0, 1, 2, 3]}}]"""
    text = (
        "\nname: two\nbodies:"
        + body % ("left", "wedge", 0)
        + body % ("right", "pyramid", 5)
        + "\ngravity_m_per_s2: {z: -9.81}"
    )
    solved = solve(text, "--steps", "3")
    assert (solved.status, solved.said["steps"]) == (0, 3)
    vtu = solved.vtu
    assert [(block.type, len(block.data)) for block in vtu.cells] == [("wedge", 2), ("pyramid", 6)]
    assert [data.tolist() for data in vtu.cell_data["body"]] == [[0] * 2, [1] * 6]
    for block, low in zip(vtu.cells, (0.0, 5.0), strict=True):
        at = vtu.points[block.data.reshape(-1)]
        np.testing.assert_allclose([at[:, 0].min(), at[:, 0].max()], [low, low + 0.1], atol=1e-9)
    assert [body["name"] for body in solved.said["bodies"]] == ["left", "right"]


# --- time -------------------------------------------------------------------------------------------------------------

DYNAMIC = TRACTION + "\n    rayleigh_stiffness_s: 0.02\n    rayleigh_mass_per_s: 5"


def test_a_dynamic_scene_goes_on_until_it_is_at_rest_where_equilibrium_is(solve: Callable[..., Solved]) -> None:
    still = solve(BAR % (TRACTION, "", ""))
    moving = solve((BAR % (DYNAMIC, "", "stepping: {dt_s: 0.02}")).replace("quasi_static", "implicit_euler"))
    assert moving.status == 0
    assert 50 <= moving.said["steps"] < 1000
    assert moving.said["steps"] % 10 == 0
    expected = still.said["bodies"][0]["max_displacement_m"]
    assert moving.said["bodies"][0]["max_displacement_m"] == pytest.approx(expected, rel=1e-3)
    assert moving.said["bodies"][0]["kinetic_energy_j"] < 1e-8 * moving.said["bodies"][0]["elastic_energy_j"]


def test_seconds_and_steps_say_how_long(solve: Callable[..., Solved]) -> None:
    text = (BAR % (DYNAMIC, "", "stepping: {dt_s: 0.02}")).replace("quasi_static", "bdf2")
    assert solve(text, "--seconds", "0.1").said["steps"] == 5
    assert solve(text, "--seconds", "0.11").said["steps"] == 6
    assert solve(text, "--steps", "7").said["simulated_time_s"] == pytest.approx(0.14)


def test_a_scene_of_the_same_name_in_the_daemon_is_another_and_stays(server: tm.Server, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(BAR % (TRACTION, "", ""))
    theirs = server.load(tmp_path / "scene.yaml", lockstep=True)
    try:
        command = ["solve", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "x.vtu"), "--server", server.address]
        assert main(command) == 0
        assert [(status.scene, status.step) for status in server.scenes()] == [(theirs.name, 0)]
    finally:
        theirs.unload()


def test_a_scene_that_does_not_come_to_rest_is_written_with_a_warning(
    solve: Callable[..., Solved], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tensormass_tools.solve_steps.REST_LIMIT_S", 1.0)
    text = "\nname: falling\nbodies:\n  - name: b\n    mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, "
    text += "cells_x: 1, cells_y: 1, cells_z: 1}}\n    law: {hooke: {young_modulus_pa: 1000, poisson_ratio: 0.3}}\n"
    text += "    density_kg_per_m3: 1000\ngravity_m_per_s2: {z: -1}\nstepping: {dt_s: 0.1}\n"
    solved = solve(text)
    assert solved.status == 1
    assert "not at rest after 1 s, the kinetic energy is 1.0e+00 of its peak" in solved.said["warnings"][0]
    np.testing.assert_allclose(solved.vtu.point_data["velocity"], [[0, 0, -1]] * 8, atol=0.01)
    assert solve(text, "--allow-unconverged").status == 0


# --- what fails -------------------------------------------------------------------------------------------------------


def test_a_step_that_did_not_converge_is_refused_unless_allowed(solve: Callable[..., Solved]) -> None:
    text = BAR % (TRACTION.replace("-10", "-100"), "newton_max_iterations: 2, newton_tolerance: 1.0e-15", "")
    refused = solve(text)
    assert refused.status == 1
    assert refused.said["kind"] == "NotConvergedError"
    assert "step 1 of 1: scene" in refused.said["error"]
    assert "of the forces, above newton_tolerance = 1e-15" in refused.said["error"]
    assert "of the load" in refused.said["error"]
    assert not refused.out.exists()
    allowed = solve(text, "--allow-unconverged", "--steps", "2")
    assert allowed.status == 0
    assert any("did not converge" in warning for warning in allowed.said["warnings"])
    assert allowed.out.exists()


def test_a_linear_solve_that_was_cut_off_is_refused_too(solve: Callable[..., Solved]) -> None:
    text = (BAR % (TRACTION, "", "")).replace("quasi_static", "implicit_euler")
    refused = solve(text.replace("cg_max_iterations: 2000", "cg_max_iterations: 3"), "--steps", "5")
    assert refused.status == 1
    assert "step 1 of 5 did not converge: a residual of" in refused.said["error"]
    assert "after 3 conjugate-gradient iterations, above cg_tolerance 1e-05; raise cg" in refused.said["error"]


def test_the_files_before_a_step_that_did_not_converge_are_named(solve: Callable[..., Solved]) -> None:
    text = (BAR % (TRACTION, "", "")).replace("quasi_static", "implicit_euler")
    refused = solve(text.replace("cg_max_iterations: 2000", "cg_max_iterations: 3"), "--steps", "5", "--every", "1")
    listing = refused.out.with_suffix(".pvd")
    assert f". {listing} lists 1 state before it, --out is not written; with --all" in refused.said["error"]
    assert listing.exists()
    assert not refused.out.exists()


@pytest.mark.parametrize(("preset", "limit"), [("fast", "cg_max_iterations"), ("accurate", "newton_max_iterations")])
def test_the_limits_of_a_preset_are_reported_and_not_a_failure(
    solve: Callable[..., Solved], preset: str, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tensormass_tools.presets.all_presets", lambda: {"beam": {preset: {limit: 2}}})
    solved = solve("beam", "--steps", "2", "--preset", preset)
    assert (solved.status, solved.said["unconverged_steps"]) == (0, 2)
    (warning,) = (text for text in solved.said["warnings"] if "did not converge" in text)
    assert f"--preset {preset} asks for no more: {limit} 2 (1 more steps like this, " in warning
    assert solved.out.exists()


def test_a_grid_beyond_the_limits_is_refused_by_the_daemon_and_not_cut_here(solve: Callable[..., Solved]) -> None:
    refused = solve((BAR % (TRACTION, "", "")).replace("cells_x: 20", "cells_x: 4000000000"))
    assert refused.status == 1
    assert "limits::kMaxNodes is" in refused.said["error"]


def test_a_series_that_cannot_be_listed_is_refused_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    listing = tmp_path / "result.pvd"
    listing.mkdir()
    assert main(["solve", "cantilever", "--out", str(tmp_path / "result.vtu"), "--every", "1"]) == 1
    assert capsys.readouterr().err == f"tensormass: --every {listing}: cannot be written\n"


def test_a_full_disk_leaves_the_results_that_are_there(
    solve: Callable[..., Solved], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = BAR % (TRACTION, "", "")
    solve(scene, "--every", "1")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    scene = before["scene.yaml"].decode()
    write_blocks, write_list = mesh_files.write_blocks, ElementTree.ElementTree.write

    def with_little_room(*args: object) -> None:
        with full_disk():
            write_blocks(*args)  # type: ignore[arg-type]

    def without_room(*args: object, **options: object) -> None:
        with full_disk(50):
            write_list(*args, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patched:
        patched.setattr(mesh_files, "write_blocks", with_little_room)
        assert "result.vtu: cannot be written: File too large" in solve(scene).said["error"]
        assert "result_000000.vtu: cannot be written: " in solve(scene, "--every", "1").said["error"]
    with monkeypatch.context() as patched:
        patched.setattr(ElementTree.ElementTree, "write", without_room)
        assert "result.pvd: cannot be written: File too large" in solve(scene, "--every", "1").said["error"]
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_law_beyond_its_range_is_reported(solve: Callable[..., Solved]) -> None:
    text = (BAR % (TRACTION.replace("-10", "-1000"), "", "")).replace("neo_hookean", "hooke")
    solved = solve(text)
    assert solved.status == 0
    assert any("body 'bar': hooke has left its range" in warning for warning in solved.said["warnings"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "result.vtk"], "--out result.vtk: must end in .vtu"),
        (["--out", "none/result.vtu"], "--out none/result.vtu: no folder that can be written to"),
        (["--steps", "0"], "--steps 0: must be positive and at most 1e+09"),
        (["--seconds", "nan"], "--seconds nan: must be positive and at most 1e+09"),
        (["--seconds", "inf"], "--seconds inf: must be positive and at most 1e+09"),
        (["--every", "-1"], "--every -1: must be positive and at most 1e+09"),
        (["--fields", "stress"], "unknown field 'stress'; did you mean 'cauchy_stress'?"),
    ],
)
def test_wrong_options_are_refused_before_anything_starts(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    assert main(["solve", "cantilever", "--out", "result.vtu", *options]) == 1
    assert capsys.readouterr().err == f"tensormass: {message}\n"


CUBE = """
name: cube
bodies:
  - name: cube
    mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 6, cells_y: 6, cells_z: 6}}
    law: {hooke: {young_modulus_pa: 1000, poisson_ratio: 0.3}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 2, y: 2, z: 0.001}}}]
    prescribed: [{region: {box: {min_m: {x: -1, y: -1, z: 0.999}, max_m: {x: 2, y: 2, z: 2}}}, z_m: -1.5}]
solver: {integrator: quasi_static}
"""


def test_inverted_elements_are_reported(solve: Callable[..., Solved]) -> None:
    warnings = solve(CUBE).said["warnings"]
    assert any("body 'cube': elements are inverted, det F down to -" in text for text in warnings)
    warnings = solve(CUBE.replace("-1.5", "-0.5")).said["warnings"]
    assert not any("inverted" in text for text in warnings)


def test_open_settings_are_double_precision_and_solved_to_the_tolerance(solve: Callable[..., Solved]) -> None:
    solved = solve(CUBE)
    assert (solved.status, solved.said["precision"]) == (0, "double")
    assert solve(CUBE, "--precision", "float", "--allow-unconverged").said["precision"] == "float"
    assert solve(CUBE.replace("{integ", "{precision: float, integ"), "--allow-unconverged").said["precision"] == "float"
    # 100 iterations, the default where steps have to keep up with real time, are not enough here.
    tight = CUBE.replace("quasi_static}", "implicit_euler, cg_tolerance: 1.0e-12}\nstepping: {dt_s: 10}")
    solved = solve(tight.replace("cells_z: 6", "cells_z: 12"), "--steps", "1")
    assert solved.status == 0
    assert solved.said["cg_iterations"] > 100


# --- what is printed --------------------------------------------------------------------------------------------------


def test_the_builtin_cantilever_is_solved_by_a_daemon_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cantilever.vtu"
    assert main(["solve", "cantilever", "--out", str(out), "--backend", "cpu"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("cantilever: quasi-static, double, 1 step, 0.01667 s simulated in ")
    assert "Newton iterations, residual " in lines[1]
    assert lines[4].split()[0] == "body"
    name, displacement, reaction = re.split("  +", lines[5])[:3]
    assert name == "beam"
    assert 0.015 < float(displacement.removesuffix(" m")) < 0.025
    assert [float(value) for value in reaction.split(",")] == [0, 0, 0.008]
    assert lines[-1] == f"written: {out}"
    assert len(meshio.read(out).cells[0].data) == 20 * 4 * 4


def test_a_finding_whose_numbers_change_is_one_warning() -> None:
    def left(body: str, strain: str) -> finding_pb2.Finding:
        return finding_pb2.Finding(
            code="FINDING_CODE_LAW_RANGE", body=body, message=f"strain {strain} in {body}", remedy="take another law"
        )

    warnings = Warnings()
    first, second, other = left("b1", "0.2"), left("b1", "3"), left("b2", "3")
    assert warnings.take(stream_pb2.SceneStatus(findings=[first])) == ["strain 0.2 in b1; take another law"]
    assert warnings.take(stream_pb2.SceneStatus(findings=[second])) == []
    assert warnings.take(stream_pb2.SceneStatus(findings=[second, other])) == ["strain 3 in b2; take another law"]
    assert warnings.latest() == ["strain 3 in b1; take another law", "strain 3 in b2; take another law"]
    assert warnings.latest(without=(finding_pb2.FINDING_CODE_LAW_RANGE,)) == []


def test_the_status_names_newton_only_where_it_iterates(
    recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]
) -> None:
    fake, server = recorder
    status = stream_pb2.SceneStatus(scene="s", newton_iterations=4, newton_residual=3e-9)
    fake.replies["ListScenes"] = control_pb2.ListScenesResponse(scenes=[status, stream_pb2.SceneStatus(scene="t")])
    assert main(["status", "--server", server.address]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "Newton 4 to 3e-09" in lines[-2]
    assert "Newton" not in lines[-1]
