"""`tensormass trade`, what needs no daemon: knobs, interpolation, measures, choice of settings, store."""

from __future__ import annotations

import itertools
import json
import math
import platform
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import full_disk
from trade_parts import BLOCK, COSTS, MACHINE, knobs_of, measurement

import tensormass as tm
from tensormass._src import grids, meshes
from tensormass._src.meshes import FloatArray
from tensormass._src.scene_file import SceneFile
from tensormass._src.shapes import SHAPES
from tensormass.v1 import scene_pb2
from tensormass_tools import presets
from tensormass_tools.trade import sweep
from tensormass_tools.trade.interpolation import Interpolation
from tensormass_tools.trade.knobs import Knobs, Setting
from tensormass_tools.trade.measures import Errors, compare, oscillation, richardson
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Measurement, Store, _host, key_of

# --- knobs ------------------------------------------------------------------------------------------------------------


def test_a_grid_has_every_knob_and_the_scene_stays_as_it_is(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.knobs.keys() >= {"resolution", "shape", "quadrature", "law", "dt_s", "integrator", "precision"}
    assert knobs.without.keys() >= {"preconditioner", "contact", "stream codec"}
    changed = knobs.apply({"resolution": 0.5, "law": "hencky", "dt_s": 0.01, "cg_tolerance": 0.1}).message()
    grid = changed.bodies[0].mesh.grid
    assert (grid.cells_x, grid.cells_y, grid.cells_z) == (2, 2, 2)
    assert changed.bodies[0].law.hencky.young_modulus_pa == 5000
    assert changed.bodies[0].law.prony[0].share == 0.2  # a modifier is not the law
    assert changed.stepping.dt_s == 0.01
    assert changed.solver.cg_tolerance == 0.1
    assert knobs.apply({}).fields == yaml.safe_load(BLOCK)


@pytest.mark.parametrize(
    "own",
    [
        "mooney_rivlin: {c10_pa: 500, c01_pa: 250, bulk_modulus_pa: 5000}",  # μ = 2 (C10 + C01)
        "ogden: {mu_pa: 750, alpha: 4, bulk_modulus_pa: 5000}",  # μ = mu alpha / 2
    ],
)
def test_laws_are_exchanged_by_their_stiffness_for_small_strains(tmp_path: Path, own: str) -> None:
    # μ = 1500 Pa, K = 5000 Pa -> E = 9 K μ / (3 K + μ).
    text = BLOCK.replace("neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}", own)
    law = knobs_of(text, tmp_path).apply({"law": "hooke"}).message().bodies[0].law.hooke
    assert law.young_modulus_pa == pytest.approx(9 * 5000 * 1500 / (15000 + 1500))
    assert law.poisson_ratio == pytest.approx((15000 - 3000) / (2 * (15000 + 1500)))


@pytest.mark.parametrize(
    ("poisson_ratio", "is_exchanged"), [(0.45, True), (0.49985, True), (0.49995, False), (0.49999, False)]
)
def test_a_law_beyond_the_poisson_ratio_that_laws_accept_is_not_exchanged(
    tmp_path: Path, poisson_ratio: float, is_exchanged: bool
) -> None:
    shear_pa = 2 * (500 + 250)
    bulk_pa = 2 * shear_pa * (1 + poisson_ratio) / (3 * (1 - 2 * poisson_ratio))
    own = f"mooney_rivlin: {{c10_pa: 500, c01_pa: 250, bulk_modulus_pa: {bulk_pa!r}}}"
    knobs = knobs_of(BLOCK.replace("neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}", own), tmp_path)
    assert ("law" in knobs.knobs) == is_exchanged
    if is_exchanged:
        law = knobs.apply({"law": "hooke"}).message().bodies[0].law.hooke
        assert law.poisson_ratio == pytest.approx(poisson_ratio)
    else:
        assert "no isotropic law that equals it" in knobs.without["law"]


def test_what_cannot_be_chosen_says_why(tmp_path: Path) -> None:
    meshes_of = grids.grid([1, 1, 1], [1, 1, 1])
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
    uneven = BLOCK.replace("    quadrature:", "    element_fields: {young_modulus_pa: AAAAAAAAAAA=}\n    quadrature:")
    assert "element fields" in knobs_of(uneven, tmp_path).without["resolution"]
    still = BLOCK.replace("solver: {", "solver: {integrator: quasi_static, ")
    assert "equilibrium" in knobs_of(still, tmp_path).without["integrator"]


def test_only_what_is_held_has_an_equilibrium(tmp_path: Path) -> None:
    assert "quasi_static" in knobs_of(BLOCK, tmp_path).knobs["integrator"].values
    body = BLOCK[BLOCK.index("  - name") : BLOCK.index("tools:")]
    free = "\n".join(line for line in body.replace("name: block", "name: free").splitlines() if "fixed:" not in line)
    both = knobs_of(BLOCK.replace("tools:", f"{free}\ntools:"), tmp_path)
    assert len(both.message.bodies) == 2
    assert both.knobs["integrator"].values == ("implicit_euler", "bdf2")


def test_numbers_that_yaml_takes_for_text_are_numbers(tmp_path: Path) -> None:
    text = BLOCK.replace("cells_x: 4, cells_y: 4", 'cells_x: "4", cells_y: 4e0').replace("0.01}\n", "1e-2}\n")
    text += 'stepping: {dt_s: 1e-2, rate_hz: "1e2"}\n'
    text = text.replace("radius_m: 0.01}", 'radius_m: 0.01}, max_speed_m_per_s: "Infinity"')
    knobs = knobs_of(text, tmp_path)
    assert knobs.message == SceneFile.parse(text, tmp_path, "scene.yaml").message()
    changed = knobs.apply({"resolution": 2.0, "dt_s": 0.02})
    grid = changed.message().bodies[0].mesh.grid
    assert (grid.cells_x, grid.cells_y) == (8, 8)
    assert changed.fields["stepping"] == {"dt_s": 0.02, "rate_hz": 50.0}
    assert changed.message().tools == knobs.message.tools
    knobs.write({}, tmp_path / "same.yaml", "")
    assert tm.Scene.from_file(tmp_path / "same.yaml").message == knobs.message


def test_bodies_that_share_a_mesh_by_an_alias_are_refined_once(tmp_path: Path) -> None:
    head, body, tail = BLOCK[: (at := BLOCK.index("  - name"))], BLOCK[at : (end := BLOCK.index("tools:"))], BLOCK[end:]
    first = body.replace("mesh: {", "mesh: &mesh {")
    mesh = first[first.index("&mesh") : first.index("\n    law")]
    second = first.replace(mesh, "*mesh").replace("name: block", "name: second")
    changed = knobs_of(head + first + second + tail, tmp_path).apply({"resolution": 2.0}).message()
    assert [of.mesh.grid.cells_x for of in changed.bodies] == [8, 8]


def test_settings_of_no_effect_are_left_out(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.canonical({"cg_tolerance": 0.01, "law": "neo_hookean"}) == {}
    assert knobs.canonical({"quadrature": "full", "shape": "tetrahedron"}) == {"shape": "tetrahedron"}
    still = {"integrator": "quasi_static"}
    assert knobs.canonical({**still, "mass": "consistent"}) == still
    tetrahedra = knobs.apply({"shape": "tetrahedron"}).message().bodies[0]
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
    tm.write_mesh(tmp_path / "a.msh", grids.grid([1, 1, 1], [1, 1, 1]))
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
    mesh = grids.grid([5, 3, 2], [0.1, 0.02, 0.03], shape=shape, origin_m=[-0.05, 0, 1])
    points = np.array([-0.05, 0, 1]) + random.random((200, 3)) * [0.1, 0.02, 0.03]
    matrix = random.random((3, 3))
    taken = Interpolation(mesh, points)
    assert taken.outside_count == 0
    np.testing.assert_allclose(taken(mesh.nodes @ matrix + 1), points @ matrix + 1, atol=1e-12)
    own_nodes = Interpolation(mesh, mesh.nodes)
    values = random.random((len(mesh.nodes), 2))
    np.testing.assert_allclose(own_nodes(values), values, atol=1e-9)


def test_points_are_found_in_the_block_of_their_element() -> None:
    left, right = (grids.grid([2, 2, 2], [1, 1, 1], shape=shape, origin_m=[x, 0, 0]) for shape, x in MIXED)
    nodes = np.concatenate([left.nodes, right.nodes])
    blocks = [(left.blocks[0].shape.name, left.blocks[0].nodes)]
    blocks.append((right.blocks[0].shape.name, right.blocks[0].nodes + np.uint32(len(left.nodes))))
    points = np.random.default_rng(1).random((100, 3)) * [2, 1, 1]
    taken = Interpolation(meshes.VolumeMesh.from_arrays(nodes, blocks), points)
    assert taken.outside_count == 0
    side = np.concatenate([np.zeros((len(left.nodes), 1)), np.ones((len(right.nodes), 1))])
    np.testing.assert_allclose(taken(side)[:, 0], points[:, 0] > 1, atol=1e-9)


MIXED = (("hexahedron", 0.0), ("tetrahedron", 1.0))


def test_points_outside_are_extrapolated_and_counted() -> None:
    mesh = grids.grid([2, 2, 2], [1, 1, 1])
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
    assert errors.damping == pytest.approx(0.1 / math.hypot(10 * math.pi, 1), rel=0.1)  # it dies away sooner
    assert compare(recording(0.9), recording(), weights).volume == pytest.approx(0.001)


def test_errors_of_what_hardly_is_there() -> None:
    weights = [np.ones(3)]
    reference = recording()
    still = replace(reference, free_m=np.zeros(200))
    assert (compare(still, reference, weights).frequency, compare(still, reference, weights).damping) == (1.0, None)
    assert (compare(reference, still, weights).frequency, compare(reference, still, weights).damping) == (None, None)
    assert compare(reference, recording(0.0), weights).displacement == math.inf
    assert compare(recording(0.0), recording(0.0), weights).displacement == 0
    # The direction counts by the reference's force, and not where that is weak.
    turned = recording(turn_rad=0.3)
    stronger = replace(turned, force=turned.force * [[100.0], [1.0]])
    assert compare(stronger, reference, weights).force_angle_rad == pytest.approx(0.3 * 2 / 3)
    weak = replace(reference, force=np.array([[0, 0, 0.1], [0, 0, 2.0]]))
    aside = replace(reference, force=np.array([[0, 0.1, 0], [0, 0, 2.0]]))
    assert compare(aside, weak, weights).force_angle_rad == 0


def test_frequency_and_damping_of_a_swing() -> None:
    times = np.linspace(0, 1, 400)
    rate, omega = 3.0, 2 * math.pi * 6
    measured = oscillation(times, 0.2 + np.exp(-rate * times) * np.cos(omega * times))
    assert measured is not None
    assert measured[0] == pytest.approx(6, rel=1e-2)
    assert measured[1] == pytest.approx(rate / math.hypot(rate, omega), rel=1e-2)
    # On both sides of some of its turns are equal values.
    assert oscillation(times, 0.2 + np.cos(omega * times)) == (pytest.approx(6, rel=1e-2), pytest.approx(0, abs=1e-3))
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
    assert script.free_s == (0.0, pytest.approx(0.35 * script.duration_s))
    scene.ClearField("gravity_m_per_s2")
    assert Script.of(scene).free_s == pytest.approx((0.9 * script.duration_s, script.duration_s))  # let go by the tool
    scene.bodies[0].prescribed.add().schedule.time_s.extend([0.0, 5.0])
    assert Script.of(scene).duration_s == pytest.approx(5.0)
    del scene.bodies[0].prescribed[:]
    del scene.tools[:]
    with pytest.raises(tm.InvalidArgumentError, match="nothing would move"):
        Script.of(scene, None)


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


def test_costs_are_as_on_a_machine_of_one_speed() -> None:
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


def test_solved_better_is_without_what_is_solved_worse(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    loose = {"resolution": 0.5, "cg_tolerance": 0.1, "precision": "double"}
    assert knobs.solved_better(loose) == {"resolution": 0.5, "precision": "double"}
    assert knobs.solved_better({"cg_tolerance": 1e-4}) == {"cg_tolerance": 1e-4}
    newton = knobs_of(BLOCK.replace("solver: {", "solver: {newton_max_iterations: 5, "), tmp_path)
    assert newton.solved_better({"newton_tolerance": 1e-2}) == {}
    assert newton.solved_better({"newton_tolerance": 1e-4}) == {"newton_tolerance": 1e-4}
    # Newton's method by default where there is an equilibrium, one solve where there is none.
    few = {"integrator": "quasi_static", "newton_max_iterations": 2}
    assert knobs.solved_better(few) == {"integrator": "quasi_static"}
    assert knobs.solved_better({"newton_max_iterations": 2}) == {"newton_max_iterations": 2}


def test_the_next_candidate_is_within_the_budget_on_the_machine_as_it_is_now() -> None:
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
    # Of one that broke when it alone was changed, nobody knows.
    broken = measurement({"law": "unlike"}, 0.0, 0.0, failure="stopped")
    assert not sweep.is_same_tissue(both, [own, broken, both], 0.02)


def test_what_is_close_because_it_is_solved_worse_is_not_recommended(tmp_path: Path) -> None:
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
    # What one side has not, the other gets.
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


def test_older_results_are_read(tmp_path: Path) -> None:
    Store(tmp_path).put(measurement({}, 1.0, 0.1))
    (line,) = (tmp_path / "results.jsonl").read_text().splitlines()
    plain = json.loads(line)
    del plain["machine"]["host"]
    (tmp_path / "results.jsonl").write_text(json.dumps(plain) + "\n")
    assert Store(tmp_path).get(repr({})) == measurement({}, 1.0, 0.1)


def test_a_host_is_told_from_others_and_names_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, other, none = (tmp_path / name for name in ("own", "other", "none"))
    own.write_text("0123456789abcdef0123456789abcdef\n")
    other.write_text("1123456789abcdef0123456789abcdef\n")
    hosts = [_host(of) for of in (own, other, none)]
    assert len({*hosts}) == 3
    assert all(re.fullmatch("[0-9a-f]{8}", of) for of in hosts)
    assert hosts[0] == _host(own)
    own.write_bytes(b"\xff\xfe")
    assert _host(own) == hosts[2]  # as if there were none
    own.write_text("0123456789abcdef0123456789abcdef\n")
    monkeypatch.setattr(platform, "node", lambda: "another")
    assert _host(none) != hosts[2]
    assert _host(own) == hosts[0]


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


def test_a_full_disk_leaves_what_was_measured(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.keep("a", recording(1.5))
    store.put(measurement({}, 1.0, 0.1))
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "half')
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with full_disk(100):
        with pytest.raises(OSError, match="File too large"):
            store.keep("a", recording(2.5))
        with pytest.raises(OSError, match="File too large"):
            Store(tmp_path)  # forgets the half line
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_key_holds_scene_script_and_machine(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None)
    key = key_of(scene, script, MACHINE, "r")
    assert key == key_of(scene, script, MACHINE, "r")
    assert key != key_of(scene, script, replace(MACHINE, device="another"), "r")
    assert key != key_of(scene, script, replace(MACHINE, build="def"), "r")
    assert key != key_of(scene, script, replace(MACHINE, host="0123abcd"), "r")
    assert key != key_of(scene, replace(script, duration_s=9.0), MACHINE, "r")
    scene.solver.cg_tolerance = 0.5
    assert key != key_of(scene, script, MACHINE, "r")


# --- presets ----------------------------------------------------------------------------------------------------------


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
    monkeypatch.chdir(tmp_path)
    Path("cantilever").write_text(BLOCK)  # somebody's own, of that name
    with pytest.raises(
        tm.InvalidArgumentError, match=r"measured for cantilever, not for cantilever; .* your own scene"
    ):
        presets.read_scene("cantilever", "fast")


def test_the_committed_presets_are_settings_of_their_scenes(tmp_path: Path) -> None:
    for scene, of_scene in presets.all_presets().items():
        knobs = Knobs(SceneFile.read(scene), tmp_path)
        for setting in of_scene.values():
            assert knobs.canonical(setting) == setting
