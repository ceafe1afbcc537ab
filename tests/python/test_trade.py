"""`tensormass trade`, what needs no daemon: knobs, interpolation, measures, choice of settings, store."""

from __future__ import annotations

import argparse
import contextlib
import errno
import itertools
import json
import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from unittest.mock import ANY

import numpy as np
import pytest
import yaml

import tensormass as tm
from tensormass import meshes, presets
from tensormass.cli import main
from tensormass.meshes import FloatArray
from tensormass.scene import SceneFile
from tensormass.shapes import SHAPES
from tensormass.trade import command, reference, report, sweep
from tensormass.trade.command import parse_share, parse_time_s
from tensormass.trade.interpolation import Interpolation
from tensormass.trade.knobs import Knobs, Setting
from tensormass.trade.measures import Errors, compare, oscillation, richardson
from tensormass.trade.script import Costs, Recording, Script
from tensormass.trade.store import Machine, Measurement, Store, key_of
from tensormass.v1 import scene_pb2

BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
bodies:
  - name: block
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 3, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}, prony: [{share: 0.2, relaxation_time_s: 0.1}]}
    density_kg_per_m3: 1000
    quadrature: selective
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - {name: probe, spherical_probe: {radius_m: 0.01}, position_m: {x: 0.05, y: 0.05, z: 0.08}}
solver: {cg_tolerance: 0.01}
"""
MACHINE = Machine("cpu", "some processor", None, "1", "abc")
COSTS = Costs(1e-3, 2e-3, 3e-3, 10, 20, 5, 0.1)


def knobs_of(text: str, folder: Path) -> Knobs:
    return Knobs(SceneFile.parse(text, folder, "scene.yaml"), folder / "meshes")


# --- knobs ------------------------------------------------------------------------------------------------------------


def test_a_grid_has_every_knob_and_the_scene_stays_as_it_is(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.knobs.keys() >= {"resolution", "shape", "quadrature", "law", "dt_s", "integrator", "precision"}
    assert knobs.without.keys() >= {"preconditioner", "contact", "stream codec"}
    changed = knobs.apply({"resolution": 0.5, "law": "hencky", "dt_s": 0.01, "cg_tolerance": 0.1}).scene().message
    grid = changed.bodies[0].mesh.grid
    assert (grid.cells_x, grid.cells_y, grid.cells_z) == (2, 2, 2)
    assert changed.bodies[0].law.hencky.young_modulus_pa == 5000
    assert changed.bodies[0].law.prony[0].share == 0.2  # a modifier is not the law
    assert changed.stepping.dt_s == 0.01
    assert changed.solver.cg_tolerance == 0.1
    assert knobs.apply({}).fields == yaml.safe_load(BLOCK)


def test_laws_are_exchanged_by_their_stiffness_for_small_strains(tmp_path: Path) -> None:
    # μ = 2 (C10 + C01) = 1500 Pa, K = 5000 Pa -> E = 9 K μ / (3 K + μ).
    rivlin = BLOCK.replace(
        "neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}",
        "mooney_rivlin: {c10_pa: 500, c01_pa: 250, bulk_modulus_pa: 5000}",
    )
    law = knobs_of(rivlin, tmp_path).apply({"law": "hooke"}).scene().message.bodies[0].law.hooke
    assert law.young_modulus_pa == pytest.approx(9 * 5000 * 1500 / (15000 + 1500))
    assert law.poisson_ratio == pytest.approx((15000 - 3000) / (2 * (15000 + 1500)))


def test_what_cannot_be_chosen_says_why(tmp_path: Path) -> None:
    meshes_of = meshes.grid([1, 1, 1], [1, 1, 1])
    tm.write_mesh(tmp_path / "a.msh", meshes_of)
    text = BLOCK.replace(
        "grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 3, shape: hexahedron}",
        "file: a.msh",
    )
    knobs = knobs_of(text, tmp_path)
    assert "comes from a file" in knobs.without["resolution"]
    assert "one point" in knobs.without["quadrature"]
    with pytest.raises(tm.InvalidArgumentError, match="comes from a file"):
        knobs.choose(["resolution"])
    with pytest.raises(tm.InvalidArgumentError, match="did you mean 'cg_tolerance'"):
        knobs.choose(["cg_tolerence"])
    numbered = BLOCK.replace("fixed: [{box", "fixed: [{nodes: {indices: [1]}}, {box")
    assert "node numbers" in knobs_of(numbered, tmp_path).without["resolution"]
    still = BLOCK.replace("solver: {", "solver: {integrator: quasi_static, ")
    assert "equilibrium" in knobs_of(still, tmp_path).without["integrator"]


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path: Path) -> None:
    text = BLOCK.replace("cells_x: 4, cells_y: 4", 'cells_x: "4", cells_y: 4e0').replace("0.01}\n", "1e-2}\n")
    text += 'stepping: {dt_s: 1e-2, rate_hz: "1e2"}\n'
    text = text.replace("radius_m: 0.01}", 'radius_m: 0.01}, max_speed_m_per_s: "Infinity"')
    knobs = knobs_of(text, tmp_path)
    assert knobs.message == SceneFile.parse(text, tmp_path, "scene.yaml").scene().message
    changed = knobs.apply({"resolution": 2.0, "dt_s": 0.02})
    grid = changed.scene().message.bodies[0].mesh.grid
    assert (grid.cells_x, grid.cells_y) == (8, 8)
    assert changed.fields["stepping"] == {"dt_s": 0.02, "rate_hz": 50.0}
    assert changed.scene().message.tools == knobs.message.tools
    knobs.write({}, tmp_path / "same.yaml", "")
    assert tm.Scene.from_file(tmp_path / "same.yaml").message == knobs.message


def test_bodies_that_share_a_mesh_by_an_alias_are_refined_once(tmp_path: Path) -> None:
    head, body, tail = BLOCK[: (at := BLOCK.index("  - name"))], BLOCK[at : (end := BLOCK.index("tools:"))], BLOCK[end:]
    first = body.replace("mesh: {", "mesh: &mesh {")
    mesh = first[first.index("&mesh") : first.index("\n    law")]
    second = first.replace(mesh, "*mesh").replace("name: block", "name: second")
    changed = knobs_of(head + first + second + tail, tmp_path).apply({"resolution": 2.0}).scene().message
    assert [of.mesh.grid.cells_x for of in changed.bodies] == [8, 8]


def test_settings_of_no_effect_are_left_out(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.canonical({"cg_tolerance": 0.01, "law": "neo_hookean"}) == {}
    assert knobs.canonical({"quadrature": "full", "shape": "tetrahedron"}) == {"shape": "tetrahedron"}
    tetrahedra = knobs.apply({"shape": "tetrahedron"}).scene().message.bodies[0]
    assert tetrahedra.quadrature == scene_pb2.QUADRATURE_UNSPECIFIED


def test_a_written_scene_runs_as_it_is_and_keeps_what_its_author_said(tmp_path: Path) -> None:
    knobs = Knobs(SceneFile.read("demo"), tmp_path / "meshes")
    out = tmp_path / "elsewhere"
    out.mkdir()
    knobs.write({"resolution": 0.5, "dt_s": 0.02}, out / "fast.yaml", "why\nand how")
    (tmp_path / "meshes" / "liver-0.5.msh").unlink()  # the file has its own
    assert (out / "fast.yaml").read_text().startswith("# why\n# and how\nname: demo\n")
    written, own = tm.Scene.from_file(out / "fast.yaml").message, tm.Scene.from_file("demo").message
    assert written.stepping.dt_s == 0.02
    assert len(written.bodies[0].mesh.packed.elements[0].nodes) < len(own.bodies[0].mesh.packed.elements[0].nodes) / 4
    assert written.bodies[0].skin == own.bodies[0].skin
    assert written.bodies[0].fixed == own.bodies[0].fixed
    assert written.tools == own.tools


def test_a_written_scene_finds_the_meshes_of_the_user(tmp_path: Path) -> None:
    tm.write_mesh(tmp_path / "a.msh", meshes.grid([1, 1, 1], [1, 1, 1]))
    text = BLOCK[: BLOCK.index("grid:")] + "file: a.msh}" + BLOCK[BLOCK.index("}}\n    law") + 2 :]
    knobs = knobs_of(text, tmp_path)
    (tmp_path / "out").mkdir()
    knobs.write({"precision": "double"}, tmp_path / "out" / "x.yaml", "")
    assert yaml.safe_load((tmp_path / "out" / "x.yaml").read_text())["bodies"][0]["mesh"]["file"] == "../a.msh"
    assert tm.Scene.from_file(tmp_path / "out" / "x.yaml").message.bodies == knobs.message.bodies


# --- interpolation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_linear_fields_are_taken_exactly(shape: str) -> None:
    random = np.random.default_rng(1)
    mesh = meshes.grid([5, 3, 2], [0.1, 0.02, 0.03], shape=shape, origin_m=[-0.05, 0, 1])
    points = np.array([-0.05, 0, 1]) + random.random((200, 3)) * [0.1, 0.02, 0.03]
    matrix = random.random((3, 3))
    taken = Interpolation(mesh, points)
    assert taken.outside_count == 0
    np.testing.assert_allclose(taken(mesh.nodes @ matrix + 1), points @ matrix + 1, atol=1e-12)
    own_nodes = Interpolation(mesh, mesh.nodes)
    values = random.random((len(mesh.nodes), 2))
    np.testing.assert_allclose(own_nodes(values), values, atol=1e-9)


def test_points_outside_are_extrapolated_and_counted() -> None:
    mesh = meshes.grid([2, 2, 2], [1, 1, 1])
    points = np.array([[0.5, 0.5, 0.5], [1.05, 0.5, 0.5], [0.5, 3.0, 0.5]])
    taken = Interpolation(mesh, points)
    assert taken.outside_count == 2
    np.testing.assert_allclose(taken(mesh.nodes), points, atol=1e-12)


# --- measures ---------------------------------------------------------------------------------------------------------


def recording(scale: float = 1.0, force_scale: float = 1.0, turn_rad: float = 0.0) -> Recording:
    """Two samples of one body of three points."""
    displacement: FloatArray = scale * np.array([np.full((3, 3), 0.5), np.eye(3)])
    force = force_scale * np.array([[0, 0, 1.0], [0, 2 * math.sin(turn_rad), 2 * math.cos(turn_rad)]])
    times = np.linspace(0, 1, 200)
    swing = np.exp(-scale * times) * np.cos(2 * math.pi * 5 * times)
    volume = np.array([[1.0, 1.0 + 0.01 * scale]])
    return Recording([displacement], volume, force, 3.0 * force_scale, times, swing, 6, 0.0, 0, 0.9, COSTS)


def test_errors_are_shares_of_the_reference() -> None:
    weights = [np.array([1.0, 2.0, 3.0])]
    same = compare(recording(), recording(), weights)
    assert same == Errors(0, 0, 0, 0, 0, 0, 0, 0)
    errors = compare(recording(1.1, 0.8, 0.3), recording(), weights)
    assert errors.displacement == pytest.approx(0.1)
    assert errors.worst_node == pytest.approx(0.1)
    assert errors.volume == pytest.approx(0.001)
    assert errors.force == pytest.approx(0.2)
    assert errors.work == pytest.approx(0.2)
    assert errors.force_angle_rad == pytest.approx(0.3 * 2 / 3)  # the other sample, of half the force, points alike
    assert errors.judged == errors.force


def test_frequency_and_damping_of_a_swing() -> None:
    times = np.linspace(0, 1, 400)
    rate, omega = 3.0, 2 * math.pi * 6
    measured = oscillation(times, 0.2 + np.exp(-rate * times) * np.cos(omega * times))
    assert measured is not None
    assert measured[0] == pytest.approx(6, rel=1e-2)
    assert measured[1] == pytest.approx(rate / math.hypot(rate, omega), rel=1e-2)
    assert oscillation(times, 1 - np.exp(-times)) is None
    assert oscillation(times, 1 + 1e-3 * np.cos(omega * times)) is None  # equilibrium, and what a solver leaves


def test_richardson_finds_order_and_error() -> None:
    # u(h) = 1 + h²: the error of the finest is h².
    sizes = [1.5**-level for level in range(3)]
    differences = [abs(b**2 - a**2) for a, b in itertools.pairwise(sizes)]
    error, order = richardson(differences, 1.5)
    assert (error, order) == (pytest.approx(sizes[-1] ** 2), pytest.approx(2))
    assert richardson([0.1], 1.5) == (pytest.approx(0.2), 1.0)  # first order is assumed
    assert richardson([0.1, 0.2], 1.5)[1] == 0.5  # a sequence that does not converge is not trusted
    assert richardson([1.0, 1e-9], 1.5)[1] == 2.0  # nor is one that converges by chance


def test_the_tool_presses_in_by_half_its_radius_and_comes_back(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None)
    top = np.array([script.pose(share * script.duration_s) for share in (0, 0.2, 0.7, 1.0)])
    np.testing.assert_allclose(top, [[0.05, 0.05, z] for z in (0.08, 0.08, 0.055, 0.08)])
    assert script.duration_s / script.sample_s == pytest.approx(script.sample_count)
    del scene.tools[:]
    scene.ClearField("gravity_m_per_s2")
    with pytest.raises(tm.InvalidArgumentError, match="nothing would move"):
        Script.of(scene, None)


# --- which settings ---------------------------------------------------------------------------------------------------


def measurement(setting: Setting, cost_s: float, error: float, failure: str = "") -> Measurement:
    errors = None if failure else Errors(error, error, 0)
    return Measurement(
        repr(setting), dict(setting), MACHINE, 6, errors, None if failure else COSTS, cost_s=cost_s, failure=failure
    )


def test_the_front_and_the_picks() -> None:
    measured = [
        measurement({}, 3.0, 0.03),
        measurement({"a": 1}, 1.0, 0.2),
        measurement({"a": 2}, 2.0, 0.3),  # beaten
        measurement({"a": 3}, 9.0, 0.001),
        measurement({"a": 4}, 0.0, 0.0, failure="refused"),
    ]
    assert [of.cost_s for of in sweep.front(measured)] == [1.0, 3.0, 9.0]
    fastest, accurate = sweep.fastest_within(measured, 0.05), sweep.most_accurate_within(measured, 5.0, 0.05)
    assert fastest is measured[0]
    assert accurate is measured[0]
    assert sweep.fastest_within(measured, 1e-4) is None
    assert sweep.most_accurate_within(measured, 0.5, 0.05) is None


def test_combinations_are_those_that_promise_most(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    knobs.choose(["resolution", "law", "cg_tolerance"])
    singles = sweep.one_at_a_time(knobs, quick=False)
    assert singles[0] == {}
    assert len(singles) == 1 + 4 + 5 + 3
    assert len(sweep.one_at_a_time(knobs, quick=True)) == 1 + 2 + 5 + 2
    effects = {"resolution": {0.5: (0.2, 0.02), 2.0: (8.0, -0.02)}, "cg_tolerance": {0.1: (0.5, 0.001)}}
    effects["law"] = {"hooke": (0.1, 0.5)}  # cheap, but hopeless
    measured = []
    for setting in singles:
        factor, change = 1.1, 0.5  # dearer and worse than the scene: not worth a combination
        for name, value in setting.items():
            factor, change = effects.get(name, {}).get(value, (factor, change))  # type: ignore[call-overload]
        measured.append(measurement(setting, factor if setting else 1.0, 0.03 + (change if setting else 0.0)))
    chosen, possible = sweep.combinations(knobs, measured, 10, tolerance=0.02)
    assert possible == 2
    assert chosen == [{"resolution": 0.5, "cg_tolerance": 0.1}, {"resolution": 2.0, "cg_tolerance": 0.1}]
    assert sweep.combinations(knobs, measured, 0, tolerance=0.02) == ([], 2)


def test_combinations_go_to_the_accurate_end_and_not_beyond_what_anybody_waits_for(tmp_path: Path) -> None:
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
    assert chosen == [{"dt_s": 2 * own, "integrator": "quasi_static"}]  # type: ignore[operator]


def test_another_law_is_chosen_only_where_it_is_as_good_as_the_same() -> None:
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
    assert sweep.fastest_within(measured, 0.02) is like
    assert sweep.most_accurate_within(measured, 5.0, 0.02) is like
    assert sweep.fastest_within([own, unlike, both], 0.02) is own


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


# --- store ------------------------------------------------------------------------------------------------------------


def test_results_survive_and_half_a_line_is_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path)
    kept = [measurement({}, 1.0, 0.1), replace(measurement({"law": "hooke"}, 0.0, 0.0, failure="no"), warnings=["w"])]
    for of in kept:
        store.put(of)
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "half')
    again = Store(tmp_path)
    assert [again.get(of.key) for of in kept] == kept
    again.put(measurement({"law": "hencky"}, 1.0, 0.1))  # goes on a line of its own
    assert Store(tmp_path).get(repr({"law": "hencky"})) is not None
    (tmp_path / "results.jsonl").write_text("{}\n")
    with pytest.raises(tm.InvalidArgumentError, match=r"results.jsonl:1: not a measurement"):
        Store(tmp_path)


def test_recordings_survive_and_half_of_one_is_forgotten(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.keep("a", recording(1.5))
    again = store.recording("a")
    assert again is not None
    assert compare(again, recording(1.5), [np.ones(3)]) == Errors(0, 0, 0, 0, 0, 0, 0, 0)
    assert again.costs == COSTS
    file = tmp_path / "recordings" / "a.npz"
    file.write_bytes(file.read_bytes()[:100])
    assert store.recording("a") is None


def test_a_key_holds_scene_script_and_machine(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None)
    key = key_of(scene, script, MACHINE, "r")
    assert key == key_of(scene, script, MACHINE, "r")
    assert key != key_of(scene, script, replace(MACHINE, device="another"), "r")
    assert key != key_of(scene, script, replace(MACHINE, build="def"), "r")
    assert key != key_of(scene, replace(script, duration_s=9.0), MACHINE, "r")
    scene.solver.cg_tolerance = 0.5
    assert key != key_of(scene, script, MACHINE, "r")


# --- words ------------------------------------------------------------------------------------------------------------


def test_times_and_shares() -> None:
    assert parse_time_s("1ms") == pytest.approx(1e-3)
    assert parse_time_s("500us") == pytest.approx(5e-4)
    assert parse_share("2%") == pytest.approx(0.02)
    assert parse_share("0.02") == pytest.approx(0.02)
    for text in ("1", "-1ms", "ms", "nanms"):
        with pytest.raises(argparse.ArgumentTypeError, match="not a time"):
            parse_time_s(text)
    with pytest.raises(argparse.ArgumentTypeError, match="not a share"):
        parse_share("two")


@pytest.mark.parametrize("option", ["--seconds", "--press", "--reference-seconds", "--budget", "--tolerance"])
@pytest.mark.parametrize("value", ["inf", "nan", "0", "-1", "1e308", "1e-400", "much"])
def test_options_that_are_no_positive_numbers_are_refused(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["trade", "none.yaml", f"{option}={value}" + ("s" if option == "--budget" else "")])
    assert ended.value.code == 2
    assert f"argument {option}: '{value}" in capsys.readouterr().err


def test_the_help_names_only_scenes_that_are_taken(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["trade", "--help"])
    help_text = " ".join(capsys.readouterr().out.split())
    assert "scene a scene file (.yaml), or a built-in scene (beam, " in help_text
    assert "mesh file" not in help_text


def test_presets_apply_and_others_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "FILE", tmp_path / "presets.yaml")
    presets.FILE.write_text("cantilever: {fast: {resolution: 0.5, shape: tetrahedron}}\n")
    grid = presets.read_scene("cantilever", "fast").message.bodies[0].mesh.grid
    assert (grid.cells_x, grid.shape) == (10, scene_pb2.SHAPE_TETRAHEDRON)
    assert presets.read_scene("cantilever", None).message == tm.Scene.from_file("cantilever").message
    with pytest.raises(tm.InvalidArgumentError, match="cantilever has fast"):
        presets.read_scene("cantilever", "accurate")
    with pytest.raises(tm.InvalidArgumentError, match="measured for cantilever, not for beam"):
        presets.read_scene("beam", "fast")


def test_the_committed_presets_are_settings_of_their_scenes(tmp_path: Path) -> None:
    for scene, of_scene in presets.all_presets().items():
        knobs = Knobs(SceneFile.read(scene), tmp_path)
        for setting in of_scene.values():
            assert knobs.canonical(setting) == setting


# --- the whole, with a daemon of one formula --------------------------------------------------------------------------


class Formula:
    """Stands for a recorder: displacement (1 + error) u, error = (h² + dt²) / 100, both against the scene's own."""

    def __init__(self, scene: scene_pb2.Scene, script: Script, broken_law: str = "") -> None:
        self.weights = [np.ones(2)]
        self.runs = 0
        #: The run that ends the daemon.
        self.last_run = 0
        self.felt = True
        self._cells = scene.bodies[0].mesh.grid.cells_x
        self._own_dt_s = script.sample_s / 2
        self._broken_law = broken_law

    def record(self, scene: scene_pb2.Scene, *, energy: bool = False) -> Recording:
        self.runs += 1
        if self.runs == self.last_run:
            raise tm.UnavailableError("the daemon is gone")
        if scene.bodies[0].law.WhichOneof("kind") == self._broken_law:
            raise tm.FailedPreconditionError("left the numbers")
        cells = scene.bodies[0].mesh.grid.cells_x
        dt = (scene.stepping.dt_s or self._own_dt_s) / self._own_dt_s
        error = 0.01 * (self._cells / cells) ** 2 + 0.01 * dt**2
        costs = replace(COSTS, step_p50_s=1e-3 * (cells / self._cells) ** 3, wall_s=(cells / self._cells) ** 3 / dt)
        u = (1 + error) * np.ones((2, 2, 3))
        force = self.felt * (1 + error / 2) * np.array([[0, 0, 1.0], [0, 0, 2]])
        empty = np.empty(0)
        return Recording([u], np.ones((1, 2)), force, 1.0, empty, empty, cells**3, 0.0, 0, 0.9, costs)


def test_the_reference_is_refined_until_its_own_error_is_a_third_of_the_tolerance(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK.replace("cells_x: 4", "cells_x: 40"), tmp_path)
    script = Script.of(knobs.message, None)
    formula, said = Formula(knobs.message, script), list[str]()

    def find(tolerance: float, limit_s: float) -> reference.Reference:
        return reference.find(
            knobs, script, formula, Store(tmp_path), MACHINE, tolerance=tolerance, limit_s=limit_s, say=said.append
        )  # type: ignore[arg-type]

    found = find(0.02, 1e9)
    assert found.ended == "below a third of the tolerance"
    assert found.order == pytest.approx(2, abs=0.2)
    true_error = found.recording.displacement[0].max() - 1
    assert found.displacement_error == pytest.approx(true_error, rel=0.25)
    assert found.displacement_error < 0.02 / 3
    assert len(said) == len(found.levels) == formula.runs
    before = formula.runs
    assert find(0.02, 1e9) == replace(found, recording=ANY)  # taken from the folder
    assert formula.runs == before
    finer = find(0.002, 1e9)
    assert len(finer.levels) > len(found.levels)
    assert formula.runs == len(finer.levels)
    limited = find(1e-9, 30.0)
    assert "--reference-seconds 30" in limited.ended
    assert limited.error > 1e-9


class FakeServer:
    """Accepts every scene; all else only the recorder, which is `Formula`, would ask it."""

    def inspect(self, scene: scene_pb2.Scene) -> None:
        pass


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, broken_law: str = "") -> Formula:
    """In place of a daemon; the scene is in block.yaml."""
    (folder / "block.yaml").write_text(BLOCK)
    scene = knobs_of(BLOCK, folder).message
    formula = Formula(scene, Script.of(scene, None), broken_law)
    monkeypatch.setattr(command, "launch", lambda **_: contextlib.nullcontext(FakeServer()))
    monkeypatch.setattr(command, "Recorder", lambda *_: formula)
    monkeypatch.setattr(Machine, "of", lambda *_: MACHINE)
    return formula


def run_on(folder: Path, *options: str) -> int:
    """A short run; results in out/."""
    short = ["--knobs", "dt_s", "--combinations", "0", "--tolerance", "5%"]
    return main(["trade", str(folder / "block.yaml"), "--out", str(folder / "out"), *short, *options])


def test_a_run_is_resumed_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    out = tmp_path / "out"
    run = ["trade", str(tmp_path / "block.yaml"), "--out", str(out), "--knobs", "resolution,dt_s", "--json"]
    assert main([*run, "--tolerance", "3%"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert {tuple(of["setting"]) for of in first["measurements"]} >= {(), ("resolution",), ("resolution", "dt_s")}
    assert first["not_varied"]["law"] == "not asked for"
    assert first["fastest"]["errors"]["displacement"] <= 0.03
    assert first["fastest"]["cost_s"] < first["measurements"][0]["cost_s"] * 4
    runs = formula.runs
    (out / "results.jsonl").write_text("".join((out / "results.jsonl").read_text().splitlines(keepends=True)[:-2]))
    assert main([*run, "--tolerance", "3%"]) == 0
    assert json.loads(capsys.readouterr().out) == first
    # The two lines that were taken away, and the two files that are always run again.
    assert formula.runs == runs + 4
    assert first["confirmed"].keys() == {"fastest", "most_accurate"}
    assert first["confirmed"]["fastest"]["errors"] == first["fastest"]["errors"]
    monkeypatch.setattr(Machine, "of", lambda *_: replace(MACHINE, device="another"))
    assert main([*run, "--tolerance", "3%"]) == 0
    assert formula.runs == 2 * runs + 4  # nothing is taken from another machine
    capsys.readouterr()

    page = (out / "report.html").read_text()
    assert page.count("<circle") == len(first["measurements"])
    assert "http" not in page  # nothing is fetched
    ElementTree.fromstring(page[page.index("<svg") : page.index("</svg>") + 6])
    fastest = SceneFile.read(out / "fastest.yaml").scene().message
    assert fastest.tools == knobs_of(BLOCK, tmp_path).message.tools
    (tmp_path / "mine.yaml").write_text(BLOCK.replace("cells_x: 4", "cells_x: 2"))
    assert main([*run[:-1], "--tolerance", "0.0001%", "--confirm", str(tmp_path / "mine.yaml")]) == 1
    printed = capsys.readouterr().out
    assert "most_accurate.yaml, read and run again: confirmed: " in printed
    assert "mine.yaml, read and run again: displacement " in printed  # of which nothing was promised
    mine = json.loads((out / "trade.json").read_text())["confirmed"]["mine"]
    assert mine["element_count"] == 2**3
    assert mine["errors"]["displacement"] > 2 * first["measurements"][0]["errors"]["displacement"]
    assert "none is that accurate" in printed
    assert not (out / "fastest.yaml").exists()


def test_what_a_file_does_not_reach_again_is_not_confirmed() -> None:
    promised = measurement({"a": 1}, 1.0, 0.02)
    assert report.is_confirmed(promised, measurement({}, 1.4, 0.0201))
    assert not report.is_confirmed(promised, measurement({}, 1.6, 0.02))
    assert not report.is_confirmed(promised, measurement({}, 0.5, 0.021))
    assert not report.is_confirmed(promised, measurement({}, 0.0, 0.0, failure="stopped"))


def test_a_setting_that_breaks_is_a_result_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch, broken_law="hencky")
    options = ["--knobs", "law", "--combinations", "0", "--reference-seconds", "1", "--tolerance", "5%"]
    main(["trade", str(tmp_path / "block.yaml"), "--out", str(tmp_path / "out"), *options])
    assert "law hencky could not be run: left the numbers" in capsys.readouterr().out


def test_the_scene_as_it_is_is_run_before_its_reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    formula.last_run = 1
    monkeypatch.delattr(reference, "find")
    assert run_on(tmp_path) == 1


def test_a_refused_scene_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)

    def refuse(_self: FakeServer, scene: scene_pb2.Scene) -> None:
        raise tm.InvalidArgumentError(f"scene.name: {scene.name} is none")

    monkeypatch.setattr(FakeServer, "inspect", refuse)
    (tmp_path / "block.yaml").write_text(BLOCK.replace("name: block\ngravity", "name: ../../x\ngravity"))
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    monkeypatch.chdir(inner)
    assert main(["trade", str(tmp_path / "block.yaml")]) == 1
    assert "scene.name: ../../x is none" in capsys.readouterr().err
    assert sorted(of.name for of in tmp_path.rglob("*")) == ["a", "b", "block.yaml"]
    assert formula.runs == 0


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("none.yaml", None, "none.yaml: no such file"),
        ("long.yaml", BLOCK + "stepping: {dt_s: 0.5}\n", "long.yaml: stepping.dt_s: 0.5 does not divide"),
        ("two.yaml", BLOCK.replace("- name: block", "- name: other"), "two.yaml: bodies are other, those of"),
        ("out/fastest.yaml", None, "fastest.yaml: the command writes this file itself"),
    ],
)
def test_what_is_to_be_confirmed_is_read_first(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    text: str | None,
    said: str,
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    if text is not None:
        (tmp_path / name).write_text(text)
    assert run_on(tmp_path, "--confirm", str(tmp_path / name)) == 1
    error = capsys.readouterr().err
    assert "--confirm" in error
    assert said in error
    assert formula.runs == 0
    assert not (tmp_path / "out").exists()


def test_what_the_daemon_refuses_to_confirm_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)
    (tmp_path / "mine.yaml").write_text(BLOCK.replace("name: block\ngravity", "name: mine\ngravity"))

    def refuse_mine(_self: FakeServer, scene: scene_pb2.Scene) -> None:
        if scene.name == "mine":
            raise tm.InvalidArgumentError("scene.solver: no")

    monkeypatch.setattr(FakeServer, "inspect", refuse_mine)
    assert run_on(tmp_path, "--confirm", str(tmp_path / "mine.yaml")) == 1
    assert f"--confirm {tmp_path / 'mine.yaml'}: scene.solver: no" in capsys.readouterr().err


def test_files_of_the_same_name_are_kept_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)
    files = [tmp_path / folder / "fastest.yaml" for folder in ("a", "b")]
    for cells, file in enumerate(files, 1):
        file.parent.mkdir()
        file.write_text(BLOCK.replace("cells_x: 4", f"cells_x: {cells}"))
    assert run_on(tmp_path, "--confirm", *map(str, files)) == 0
    confirmed = json.loads((tmp_path / "out" / "trade.json").read_text())["confirmed"]
    counts = {name: of["element_count"] for name, of in confirmed.items()}
    assert counts == {"fastest": 64, "most_accurate": 64, str(files[0]): 1, str(files[1]): 8}
    printed = capsys.readouterr().out
    assert "\nfastest.yaml, read and run again: confirmed: " in printed
    assert f"\n{files[0]}, read and run again: displacement " in printed


def test_what_was_measured_is_reported_though_the_daemon_ends_while_it_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path) == 0
    result = json.loads((tmp_path / "out" / "trade.json").read_text())
    (tmp_path / "out" / "trade.json").unlink()
    (tmp_path / "out" / "report.html").unlink()
    formula.last_run = formula.runs + 1  # all but the confirmation is there
    assert run_on(tmp_path) == 1
    kept = json.loads((tmp_path / "out" / "trade.json").read_text())
    assert kept == {**result, "confirmed": {}}
    assert "One knob at a time" in (tmp_path / "out" / "report.html").read_text()


def test_a_tool_that_touches_nothing_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    formula = stand_in(tmp_path, monkeypatch)
    assert run_on(tmp_path) == 0
    said = "touches nothing in the reference"
    assert said not in "".join(capsys.readouterr())
    formula.felt = False
    assert run_on(tmp_path, "--press", "0.4") == 0  # another script: measured anew
    printed, error = capsys.readouterr()
    assert f"warning: 'probe' {said}" in error
    assert f"  'probe' {said}" in printed
    assert said in (tmp_path / "out" / "report.html").read_text()


def test_a_full_disk_is_said_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stand_in(tmp_path, monkeypatch)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(np, "savez_compressed", full)
        assert run_on(tmp_path) == 1
    assert f"--out {tmp_path / 'out'}: cannot be written to: No space left" in capsys.readouterr().err
    assert run_on(tmp_path) == 0
    before = (tmp_path / "out" / "trade.json").read_text()
    write_text = Path.write_text

    def full_at_the_end(path: Path, text: str, encoding: str) -> None:
        write_text(path, text[:10], encoding)
        if "trade.json" in path.name:
            full()
        write_text(path, text, encoding)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "write_text", full_at_the_end)
        assert run_on(tmp_path) == 1
    assert (tmp_path / "out" / "trade.json").read_text() == before  # not half of another
