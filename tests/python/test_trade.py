"""`tensormass trade`, what needs no daemon: knobs, interpolation, measures, choice of settings, store."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from trade_parts import BLOCK, knobs_of, recording

import tensormass as tm
from tensormass._src import grids, meshes
from tensormass._src.scene_file import SceneFile
from tensormass._src.shapes import SHAPES
from tensormass.v1 import edit_pb2, scene_pb2
from tensormass_tools import presets
from tensormass_tools.trade.interpolation import Interpolation
from tensormass_tools.trade.knobs import Knobs, Setting
from tensormass_tools.trade.measures import Errors, compare, oscillation, richardson
from tensormass_tools.trade.script import Script

FILE_OF_TETRAHEDRA = BLOCK.replace(
    "grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 3, shape: hexahedron}", "file: a.msh"
)
ORDERS = ("as_given", "quadratic")

# --- knobs ------------------------------------------------------------------------------------------------------------


def test_a_grid_has_every_knob_and_the_scene_is_unchanged(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.knobs.keys() >= {"resolution", "shape", "quadrature", "law", "dt_s", "integrator", "precision"}
    assert knobs.without.keys() >= {"preconditioner", "stream codec"}
    changed = knobs.apply({"resolution": 0.5, "law": "hencky", "dt_s": 0.01, "cg_tolerance": 0.1}).message()
    grid = changed.bodies[0].mesh.grid
    assert (grid.cells_x, grid.cells_y, grid.cells_z) == (2, 2, 2)
    assert changed.bodies[0].law.hencky.young_modulus_pa == 5000
    assert changed.bodies[0].law.prony[0].share == 0.2  # a modifier is not the law
    assert changed.stepping.dt_s == 0.01
    assert changed.solver.cg_tolerance == 0.1
    assert knobs.apply({}).fields == yaml.safe_load(BLOCK)


def test_only_a_step_that_is_linearized_once_has_a_lag(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    lag: Setting = {"tangent_lag_steps": 8}
    assert knobs.canonical(lag) == lag
    assert knobs.apply(lag).message().solver.tangent_lag_steps == 8
    for iterates in ({"newton_max_iterations": 2}, {"integrator": "quasi_static"}):
        assert knobs.canonical({**iterates, **lag}) == iterates
    knobs.choose(["tangent_lag_steps"])
    assert knobs.canonical(lag) == lag
    lagged = knobs_of(BLOCK.replace("solver: {", "solver: {tangent_lag_steps: 16, "), tmp_path)
    assert lagged.canonical({"newton_max_iterations": 2}) == {"newton_max_iterations": 2, "tangent_lag_steps": 1}
    newton = knobs_of(BLOCK.replace("solver: {", "solver: {newton_max_iterations: 5, "), tmp_path)
    assert "Newton" in newton.without["tangent_lag_steps"]


def test_tools_take_the_contact_method(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    assert knobs.knobs["contact_method"].own == "penalty"
    changed = knobs.apply({"contact_method": "augmented_lagrangian"}).message()
    assert [tool.contact_method for tool in changed.tools] == [edit_pb2.CONTACT_METHOD_AUGMENTED_LAGRANGIAN]
    nothing = BLOCK[: BLOCK.index("tools:")] + BLOCK[BLOCK.index("solver:") :]
    assert knobs_of(nothing, tmp_path).without["contact_method"] == "the scene has no tools"


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


def test_missing_knobs_have_a_reason(tmp_path: Path) -> None:
    meshes_of = grids.grid([1, 1, 1], [1, 1, 1])
    tm.write_mesh(tmp_path / "a.msh", meshes_of)
    knobs = knobs_of(FILE_OF_TETRAHEDRA, tmp_path)
    assert "comes from a file" in knobs.without["resolution"]
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


@pytest.mark.parametrize(("own", "same"), [("full", "reduced"), ("reduced", "full")])
def test_full_and_reduced_quadrature_of_linear_tetrahedra_are_the_same(tmp_path: Path, own: str, same: str) -> None:
    tm.write_mesh(tmp_path / "a.msh", grids.grid([1, 1, 1], [1, 1, 1]))
    knobs = knobs_of(FILE_OF_TETRAHEDRA.replace("quadrature: selective", f"quadrature: {own}"), tmp_path)
    assert knobs.canonical({"quadrature": same}) == {}
    assert knobs.canonical({"quadrature": "selective"}) == {"quadrature": "selective"}
    assert knobs.canonical({"quadrature": same, "element_order": "quadratic"})["quadrature"] == same
    selective = knobs_of(FILE_OF_TETRAHEDRA, tmp_path)
    assert selective.canonical({"quadrature": own}) == {"quadrature": "full"}


def test_tetrahedra_of_any_mesh_can_be_quadratic(tmp_path: Path) -> None:
    tm.write_mesh(tmp_path / "a.msh", grids.grid([1, 1, 1], [1, 1, 1]))
    knobs = knobs_of(FILE_OF_TETRAHEDRA, tmp_path)
    assert (knobs.knobs["element_order"].own, knobs.knobs["element_order"].values) == ("as_given", ORDERS)
    assert "element_order" in knobs.refinable
    assert knobs.canonical({"element_order": "as_given"}) == {}
    body = knobs.apply({"element_order": "quadratic"}).message().bodies[0]
    assert body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC
    assert body.quadrature == scene_pb2.QUADRATURE_SELECTIVE

    text = FILE_OF_TETRAHEDRA.replace("    quad", "    element_order: quadratic\n    quad")
    own = knobs_of(text, tmp_path)
    assert own.knobs["element_order"].own == "quadratic"
    assert own.canonical({"quadrature": "full"}) == {"quadrature": "full"}
    linear = {"element_order": "as_given"}
    body = own.apply(linear).message().bodies[0]
    assert body.element_order == scene_pb2.ELEMENT_ORDER_AS_GIVEN
    assert body.quadrature == scene_pb2.QUADRATURE_SELECTIVE


def test_other_meshes_have_a_reason_why_their_order_is_not_varied(tmp_path: Path) -> None:
    assert "shapes" in knobs_of(BLOCK, tmp_path).without["element_order"]
    tm.write_mesh(tmp_path / "a.msh", grids.grid([1, 1, 1], [1, 1, 1], shape="hexahedron"))
    assert "only linear tetrahedra" in knobs_of(FILE_OF_TETRAHEDRA, tmp_path).without["element_order"]


def test_the_shape_of_a_grid_includes_its_order(tmp_path: Path) -> None:
    text = BLOCK.replace(", shape: hexahedron", "").replace("    quad", "    element_order: quadratic\n    quad")
    knobs = knobs_of(text, tmp_path)
    assert knobs.knobs["shape"].own == "quadratic_tetrahedron"
    body = knobs.apply({"shape": "hexahedron"}).message().bodies[0]
    assert (body.mesh.grid.shape, body.element_order) == (scene_pb2.SHAPE_HEXAHEDRON, 0)


def test_only_fixed_bodies_have_an_equilibrium(tmp_path: Path) -> None:
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
    still = {"integrator": "quasi_static"}
    assert knobs.canonical({**still, "mass": "consistent"}) == still


def test_a_written_scene_needs_nothing_else_and_keeps_the_authors_fields(tmp_path: Path) -> None:
    knobs = Knobs(SceneFile.read("demo"), tmp_path / "meshes")
    out = tmp_path / "elsewhere"
    out.mkdir()
    knobs.write({"resolution": 0.5, "dt_s": 0.02}, out / "fast.yaml", "why\nand how")
    (tmp_path / "meshes" / "liver-graded-0.5.msh").unlink()  # the file has its own
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


def test_force_is_compared_while_the_tool_stays_and_while_it_moves() -> None:
    reference = replace(recording(), force=np.array([[0, 0, 1.0], [0, 0, 2.0], [3.0, 0, 0], [0, 0, 0]]))
    other = replace(reference, force=np.array([[0, 1.5, 0], [0, 0, 2.2], [3.6, 0, 0], [0, 0, 0]]))
    weights = [np.ones(3)]
    first, last = np.array([False, True, False, False]), np.array([False, False, True, False])
    errors = compare(other, reference, weights, [first | last])
    assert errors.force_held == pytest.approx(math.hypot(0.2, 0.6) / math.hypot(2, 3))
    assert errors.force_moving == pytest.approx(0.5)
    assert errors.force_held_shallow is None
    assert errors.force == pytest.approx(math.sqrt(0.5**2 + 0.2**2 + 0.6**2) / math.sqrt(1 + 4 + 9))
    two = compare(other, reference, weights, [first, last])
    assert two.force_held_shallow == pytest.approx(0.1)
    assert two.force_held == pytest.approx(0.2)
    assert two.force_moving == pytest.approx(0.5)
    nothing = compare(other, reference, weights, [np.array([False, False, False, True])])
    assert (nothing.force_held, nothing.force_moving) == (None, errors.force)
    unsaid = compare(other, reference, weights)
    assert (unsaid.force_held, unsaid.force_moving) == (None, None)


def test_the_script_says_when_the_tool_stays_and_how_deep(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None, 0.7)
    assert script.text().startswith("'probe' presses 7 mm deep; 1.6 s from rest")
    (held,) = script.held()
    height = np.array([script.pose(script.sample_s * (k + 1))[2] for k in range(script.sample_count)])
    np.testing.assert_array_equal(held, np.isclose(height, 0.06 - 0.007, rtol=0, atol=1e-12))
    assert 5 < held.sum() < len(held) / 2
    del scene.tools[:]
    assert Script.of(scene).held() == []


def test_the_script_stays_at_two_depths(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    one, two = Script.of(scene, None, 1), Script.of(scene, None, 0.5, 1)
    assert two.text().startswith("'probe' presses 5 and 10 mm deep; 2.2")
    height = np.array([two.pose(two.sample_s * (k + 1))[2] for k in range(two.sample_count)])
    shallow, deep = two.held()
    np.testing.assert_array_equal(shallow, np.isclose(height, 0.06 - 0.005, rtol=0, atol=1e-12))
    np.testing.assert_array_equal(deep, np.isclose(height, 0.06 - 0.01, rtol=0, atol=1e-12))
    assert abs(int(shallow.sum()) - int(one.held()[0].sum())) <= 1
    assert abs(int(deep.sum()) - int(one.held()[0].sum())) <= 1
    np.testing.assert_allclose(two.pose(two.deepest_s), one.pose(one.deepest_s))
    np.testing.assert_allclose(two.pose(0), two.pose(two.duration_s))
    assert (
        np.abs(np.diff(height)).max() < 1.2 * np.abs(np.diff([one.pose(t)[2] for t in np.arange(0, 1.6, 1 / 30)])).max()
    )


def test_errors_of_tiny_values() -> None:
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
    measured = oscillation(times, 0.2 + np.cos(omega * times))
    assert measured == pytest.approx((6, 0), rel=1e-2, abs=1e-3)
    assert oscillation(times, 1 - np.exp(-times)) is None
    assert oscillation(times, 1 + 1e-3 * np.cos(omega * times)) is None  # equilibrium, and what a solver leaves


SIZES = [1.5**-level for level in range(3)]


def bar_of(errors: Sequence[float]) -> tuple[float, float]:
    """Error bar and order of a sequence of results with these errors."""
    return richardson([abs(fine - coarse) for coarse, fine in itertools.pairwise(errors)], 1.5)


@pytest.mark.parametrize("order", [0.5, 0.7, 1.0, 1.4, 2.0, 3.0])
def test_richardson_bounds_the_error_of_a_sequence_with_a_known_limit(order: float) -> None:
    errors = [size**order for size in SIZES]
    bar, used = bar_of(errors)
    assert used == pytest.approx(min(order, 1.0))
    assert errors[-1] <= bar * (1 + 1e-9)
    assert bar == pytest.approx(errors[-1] * (1.5**order - 1) / (1.5**used - 1))


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_richardson_bounds_an_error_whose_order_falls(share: float) -> None:
    # Coarse levels converge fast; a part of low order is left, such as that of a clamped edge.
    errors = [size**4 + share * size**0.8 for size in SIZES]
    bar, _ = bar_of(errors)
    assert errors[-1] <= bar <= 10 * errors[-1]


def test_richardson_does_not_trust_an_erratic_sequence() -> None:
    assert richardson([0.1], 1.5) == pytest.approx((0.2, 1.0))  # first order is assumed
    assert richardson([0.1, 0.2], 1.5)[1] == 0.5  # a sequence that does not converge
    assert richardson([1.0, 1e-9], 1.5)[1] == 1.0  # one that converges by chance


def test_the_tool_presses_in_by_half_its_radius_and_comes_back(tmp_path: Path) -> None:
    scene = knobs_of(BLOCK, tmp_path).message
    script = Script.of(scene, None)
    top = np.array([script.pose(share * script.duration_s) for share in (0, 0.2, 0.7, 1.0)])
    np.testing.assert_allclose(top, [[0.05, 0.05, z] for z in (0.08, 0.08, 0.055, 0.08)])
    assert script.duration_s / script.sample_s == pytest.approx(script.sample_count)
    assert script.free_s == pytest.approx((0.0, 0.35 * script.duration_s))
    scene.ClearField("gravity_m_per_s2")
    assert Script.of(scene).free_s == pytest.approx((0.9 * script.duration_s, script.duration_s))  # let go by the tool
    scene.bodies[0].prescribed.add().schedule.time_s.extend([0.0, 5.0])
    assert Script.of(scene).duration_s == pytest.approx(5.0)
    del scene.bodies[0].prescribed[:]
    del scene.tools[:]
    with pytest.raises(tm.InvalidArgumentError, match="nothing would move"):
        Script.of(scene, None)


def test_solved_better_drops_settings_that_solve_worse(tmp_path: Path) -> None:
    knobs = knobs_of(BLOCK, tmp_path)
    loose: Setting = {"resolution": 0.5, "cg_tolerance": 0.1, "precision": "double"}
    assert knobs.solved_better(loose) == {"resolution": 0.5, "precision": "double"}
    assert knobs.solved_better({"cg_tolerance": 1e-4}) == {"cg_tolerance": 1e-4}
    newton = knobs_of(BLOCK.replace("solver: {", "solver: {newton_max_iterations: 5, "), tmp_path)
    assert newton.solved_better({"newton_tolerance": 1e-2}) == {}
    assert newton.solved_better({"newton_tolerance": 1e-4}) == {"newton_tolerance": 1e-4}
    # Defaults: Newton's method for an equilibrium, one solve for a step in time.
    few: Setting = {"integrator": "quasi_static", "newton_max_iterations": 2}
    assert knobs.solved_better(few) == {"integrator": "quasi_static"}
    assert knobs.solved_better({"newton_max_iterations": 2}) == {"newton_max_iterations": 2}


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


def test_the_demo_fits_its_backend() -> None:
    own = tm.Scene.from_file("demo").message
    on_gpu = presets.read_for_backend("demo", "cuda")
    assert on_gpu is not None
    assert on_gpu.message.bodies[0].mesh.ByteSize() > 3 * own.bodies[0].mesh.ByteSize()
    assert on_gpu.message.stepping.dt_s == 1 / 960
    assert presets.read_for_backend("demo", "cpu") is None  # the file fits
    assert presets.read_for_backend("beam", "cuda") is None
    with pytest.raises(tm.NotFoundError, match="no such file"):
        presets.read_for_backend("nothing", "cuda")


def test_grading_and_resolution_mesh_an_organ_together(tmp_path: Path) -> None:
    knobs = Knobs(SceneFile.read("demo"), tmp_path)
    settings: list[Setting] = [{"resolution": 0.5, "grading": "uniform"}, {"grading": "uniform", "resolution": 0.5}]
    names = [Path(knobs.apply(setting).fields["bodies"][0]["mesh"]["file"]).name for setting in settings]
    assert names == ["liver-uniform-0.5.msh"] * 2
    graded = knobs.apply({"resolution": 0.5}).fields["bodies"][0]["mesh"]["file"]
    assert Path(graded).name == "liver-graded-0.5.msh"
    assert Knobs(SceneFile.read("beam"), tmp_path).without["grading"].startswith("only the built-in liver")
