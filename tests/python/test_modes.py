"""`tensormass modes`: against beam theory, against the server's statics and free vibrations, and what it refuses."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

import tensormass as tm
from tensormass.v1 import scene_pb2
from tensormass_tools import modes_solver
from tensormass_tools.cli import main
from tensormass_tools.modes_matrices import Matrices, matrices
from tensormass_tools.modes_solver import lowest_modes

pytest.importorskip("skfem", reason="scikit-fem is not installed")

YOUNG_PA, DENSITY = 1e6, 1000.0
LENGTH_M, SIDE_M = 1.0, 0.05
SHAPES = ("tetrahedron", "quadratic_tetrahedron", "hexahedron")
BY_SHAPE = [
    ("tetrahedron", "full", "lumped"),
    ("tetrahedron", "full", "consistent"),
    ("quadratic_tetrahedron", "full", "lumped"),
    ("quadratic_tetrahedron", "full", "consistent"),
    ("quadratic_tetrahedron", "selective", "lumped"),
    ("hexahedron", "full", "lumped"),
    ("hexahedron", "selective", "consistent"),
]


def bar(
    shape: str = "hexahedron",
    cells: tuple[int, int, int] = (20, 2, 2),
    size_m: tuple[float, float, float] = (LENGTH_M, SIDE_M, SIDE_M),
    *,
    clamped: bool = True,
    distorted: float = 0.0,
    **options: Any,  # noqa: ANN401
) -> tm.Scene:
    """Makes a bar along x, clamped at x = 0.

    Args:
        distorted: share of a cell by which inner nodes are moved, so that elements are not alike.
    """
    mesh = tm.grid(cells, size_m, shape=shape)
    nodes = mesh.nodes.copy()
    if distorted:
        distorted *= 0.3 if shape == "quadratic_tetrahedron" else 1  # edges that bend more fold the element
        nodes += distorted * np.divide(size_m, cells) * np.random.default_rng(1).uniform(-1, 1, nodes.shape)
    blocks = [(block.shape.name, block.nodes) for block in mesh.blocks]
    settings = {"law": "hooke", "young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.0, "density_kg_per_m3": DENSITY}
    return tm.Scene.from_mesh(
        tm.VolumeMesh.from_arrays(nodes, blocks),
        name="bar",
        body="bar",
        fixed_nodes=mesh.nodes[:, 0] == 0 if clamped else None,
        **{**settings, **options},
    )


def matrices_of(scene: tm.Scene) -> Matrices:
    return matrices(scene.message.bodies[0])


# --- theory -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "cells", "quadrature", "tolerance"),
    [
        ("quadratic_tetrahedron", (20, 1, 1), "full", 0.005),
        ("hexahedron", (80, 4, 4), "selective", 0.01),
    ],
)
def test_a_cantilever_bends_at_the_frequencies_of_euler_and_bernoulli(
    shape: str, cells: tuple[int, int, int], quadrature: str, tolerance: float
) -> None:
    """f = (β L)² / (2 π L²) √(E I / (ρ A)). The slender bar's shear takes 0.3 % off the first, 2 % off the second."""
    found = lowest_modes(matrices_of(bar(shape, cells, quadrature=quadrature)), 4).frequency_hz
    beta = np.array([1.8751041, 4.6940911])
    exact = beta**2 / (2 * np.pi * LENGTH_M**2) * np.sqrt(YOUNG_PA * SIDE_M**2 / 12 / DENSITY)
    np.testing.assert_allclose(found[:2], exact[0], rtol=tolerance)
    np.testing.assert_allclose(found[2:], exact[1], rtol=0.025)
    assert (found[2:] < exact[1]).all(), "shear and rotary inertia make it slower"


@pytest.mark.parametrize("shape", SHAPES)
def test_a_guided_bar_swings_along_its_axis_at_the_frequency_of_a_rod(shape: str) -> None:
    """f = √(E / ρ) / (4 L) for a bar that is clamped at one end and only moves along its axis."""
    scene = bar(shape)
    count = len(scene.message.bodies[0].mesh.packed.node_positions) // 24
    scene.fix("bar", np.arange(count), axes="yz")
    found = lowest_modes(matrices_of(scene), 2).frequency_hz
    exact = np.sqrt(YOUNG_PA / DENSITY) / (4 * LENGTH_M)
    assert found[0] == pytest.approx(exact, rel=0.001)
    assert found[1] == pytest.approx(3 * exact, rel=0.005)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_free_body_has_six_rigid_motions(shape: str) -> None:
    scene = bar(shape, (6, 2, 2), clamped=False)
    modes = lowest_modes(matrices_of(scene), 8)
    assert modes.frequency_hz[:6].tolist() == [0] * 6
    assert modes.frequency_hz[6] > 1
    np.testing.assert_allclose(modes.effective_mass_kg[:6].sum(axis=0), modes.mass_kg, rtol=1e-6)
    assert modes.mass_kg == pytest.approx(DENSITY * LENGTH_M * SIDE_M**2)


@pytest.mark.parametrize(("shape", "quadrature", "mass"), BY_SHAPE)
def test_shapes_are_mass_orthonormal_and_diagonalize_the_stiffness(shape: str, quadrature: str, mass: str) -> None:
    of = matrices_of(bar(shape, (10, 2, 2), distorted=0.1, poisson_ratio=0.3, quadrature=quadrature, mass=mass))
    modes = lowest_modes(of, 10)
    vectors = modes.shapes.reshape(10, -1)
    squares = (2 * np.pi * modes.frequency_hz) ** 2
    np.testing.assert_allclose(vectors @ (of.mass @ vectors.T), np.eye(10), atol=1e-9)
    np.testing.assert_allclose(vectors @ (of.stiffness @ vectors.T), np.diag(squares), atol=1e-7 * squares[-1])
    assert not vectors[:, ~of.free].any()


@pytest.mark.parametrize("clamped", [True, False])
def test_the_iteration_finds_the_modes_of_a_dense_solver(monkeypatch: pytest.MonkeyPatch, clamped: bool) -> None:
    of = matrices_of(bar("hexahedron", (10, 3, 3), poisson_ratio=0.4, clamped=clamped))
    assert of.free.sum() > modes_solver._DENSE
    iterated = lowest_modes(of, 12)
    monkeypatch.setattr(modes_solver, "_DENSE", 10_000)
    dense = lowest_modes(of, 12)
    np.testing.assert_allclose(iterated.frequency_hz, dense.frequency_hz, rtol=1e-8)
    np.testing.assert_array_equal(lowest_modes(of, 12).shapes, dense.shapes)


def test_a_mode_that_does_not_solve_the_problem_is_refused() -> None:
    of = matrices_of(bar(cells=(4, 1, 1)))
    stiffness, mass = of.stiffness[of.free][:, of.free], of.mass[of.free][:, of.free]
    squares, vectors = modes_solver._dense(stiffness, mass, 2, 0.0)
    modes_solver._check(stiffness, mass, squares, vectors)
    with pytest.raises(tm.NotConvergedError, match="mode 2 has a residual of"):
        modes_solver._check(stiffness, mass, squares * [1, 1.1], vectors)


def test_all_modes_together_move_the_mass_of_the_free_nodes() -> None:
    of = matrices_of(bar(cells=(3, 1, 1)))
    modes = lowest_modes(of, int(of.free.sum()))
    free_kg = of.mass.diagonal()[of.free].reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(modes.effective_mass_kg.sum(axis=0), free_kg)


LAWS: dict[str, dict[str, Any]] = {
    **{law: {"young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.25} for law in ("hooke", "corotational", "hencky")},
    **{law: {"young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.25} for law in ("neo_hookean", "stable_neo_hookean")},
    # Shear modulus 0.4 MPa and bulk modulus 2/3 MPa.
    "mooney_rivlin": {"c10_pa": 1.5e5, "c01_pa": 0.5e5, "bulk_modulus_pa": YOUNG_PA / 1.5},
    "ogden": {"mu_pa": 2e5, "alpha": 4.0, "bulk_modulus_pa": YOUNG_PA / 1.5},
}


@pytest.mark.parametrize("law", LAWS)
def test_laws_of_equal_small_strain_moduli_have_equal_modes(law: str) -> None:
    def frequencies(law: str, constants: dict[str, float]) -> np.ndarray:
        options: dict[str, Any] = {"young_modulus_pa": None, "poisson_ratio": None, "constants": constants}
        return lowest_modes(matrices_of(bar(cells=(6, 1, 1), law=law, **options)), 5).frequency_hz

    expected = frequencies("st_venant_kirchhoff", {"young_modulus_pa": YOUNG_PA, "poisson_ratio": 0.25})
    np.testing.assert_allclose(frequencies(law, LAWS[law]), expected, rtol=1e-10)


def test_scale_and_translation_are_applied() -> None:
    """Frequencies go with one over the length, and regions are those of the moved body."""
    scene, large = bar(cells=(6, 1, 1)), bar(cells=(6, 1, 1))
    mesh = large.message.bodies[0].mesh
    mesh.scale, mesh.translation_m.y = 10, 3
    mode, of_large = (lowest_modes(matrices_of(of), 3) for of in (scene, large))
    np.testing.assert_allclose(of_large.frequency_hz, mode.frequency_hz / 10)
    assert of_large.mass_kg == pytest.approx(1000 * mode.mass_kg)


# --- the server -------------------------------------------------------------------------------------------------------


def two_tissues(scene: tm.Scene) -> None:
    """Stiffens the half of the bar beyond x = 0.5 m, and gives each element a Poisson's ratio of its own."""
    body = scene.message.bodies[0]
    part = body.law_regions.add()
    part.region.box.min_m.CopyFrom(scene_pb2.Vector3(x=0.5, y=-1, z=-1))
    part.region.box.max_m.CopyFrom(scene_pb2.Vector3(x=2, y=1, z=1))
    part.law.CopyFrom(tm.law_message("hooke", {"young_modulus_pa": 3 * YOUNG_PA, "poisson_ratio": 0.1}))
    (block,) = body.mesh.packed.elements
    per_element = 4 * {scene_pb2.SHAPE_HEXAHEDRON: 8, scene_pb2.SHAPE_QUADRATIC_TETRAHEDRON: 10}.get(block.shape, 4)
    count = len(block.nodes) // per_element
    body.element_fields.poisson_ratio = np.linspace(0.1, 0.45, count).astype("<f8").tobytes()


@pytest.mark.parametrize(("shape", "quadrature", "mass"), BY_SHAPE)
def test_stiffness_and_mass_are_those_of_the_server(server: tm.Server, shape: str, quadrature: str, mass: str) -> None:
    """The displacement under gravity, in equilibrium: K u = M g."""
    scene = bar(shape, (6, 2, 2), distorted=0.1, poisson_ratio=0.3, quadrature=quadrature, mass=mass)
    two_tissues(scene)
    # Lumped masses of bent elements depend on the quadrature rule. Those with straight edges follow below.
    bent = (shape, mass) == ("quadratic_tetrahedron", "lumped")
    check_equilibrium(server, scene, 1e-4 if bent else 1e-7)


def test_added_nodes_are_stiff_and_fixed_as_those_of_the_server(server: tm.Server) -> None:
    """The wall is a list of nodes without the added ones, the end a named box, and the middle a sphere."""
    scene = bar("tetrahedron", (6, 2, 2), distorted=0.1, poisson_ratio=0.3, element_order="quadratic")
    body = scene.message.bodies[0]
    end = body.sets.add(name="end").regions.add().box
    end.min_m.CopyFrom(scene_pb2.Vector3(x=LENGTH_M - 0.05, y=-1, z=-1))
    end.max_m.CopyFrom(scene_pb2.Vector3(x=2, y=1, z=1))
    scene.fix("bar", "end", axes="yz")
    ball = body.prescribed.add(z_m=0).region.sphere
    ball.center_m.x, ball.radius_m = LENGTH_M / 2, 0.06
    check_equilibrium(server, scene, 1e-7)


def check_equilibrium(server: tm.Server, scene: tm.Scene, tolerance: float) -> None:
    of = matrices_of(scene)
    gravity = np.array([0.3, -0.2, 0.1])
    scene.message.gravity_m_per_s2.CopyFrom(scene_pb2.Vector3(x=0.3, y=-0.2, z=0.1))
    scene.set_solver(integrator="quasi_static", precision="double", cg_tolerance=1e-12, newton_tolerance=1e-11)
    with server.load(scene, lockstep=True) as handle:
        (record,) = handle.steps(1)
        assert record.converged
        moved = handle.fields("bar", ["displacement"])["displacement"]
        rest = handle.positions("bar") - moved
    np.testing.assert_allclose(of.mesh.nodes, rest, atol=1e-9)
    expected = np.zeros(moved.size)
    force = of.mass @ np.tile(gravity, len(moved))
    free = of.free
    import scipy.sparse.linalg  # part of the extra `modes`

    expected[free] = scipy.sparse.linalg.spsolve(of.stiffness[free][:, free].tocsc(), force[free])
    np.testing.assert_allclose(moved.reshape(-1), expected, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize(("shape", "quadrature", "mass"), [BY_SHAPE[0], BY_SHAPE[2], BY_SHAPE[6]])
def test_a_free_vibration_has_the_frequency_of_its_mode(
    server: tm.Server, shape: str, quadrature: str, mass: str
) -> None:
    """Released in the second mode's shape, the bar swings in it. BDF2 with 200 steps a period is 0.03 % too slow."""
    scene = bar(shape, (5, 2, 1), distorted=0.1, poisson_ratio=0.3, quadrature=quadrature, mass=mass)
    of = matrices_of(scene)
    modes = lowest_modes(of, 3)
    shape_of_mode, frequency = modes.shapes[1], modes.frequency_hz[1]
    scene.set_initial_state("bar", displacement_m=1e-3 * shape_of_mode)
    scene.set_solver(integrator="bdf2", precision="double", cg_tolerance=1e-10, cg_max_iterations=2000)
    dt_s = 1 / (200 * frequency)
    scene.set_stepping(dt_s=dt_s)
    weights = of.mass @ shape_of_mode.reshape(-1)
    with server.load(scene, lockstep=True) as handle:
        rest = of.mesh.nodes
        coordinate = np.array([weights @ (handle.positions("bar") - rest).reshape(-1) for _ in handle.steps(460)])
    at = np.flatnonzero(coordinate[:-1] * coordinate[1:] < 0)
    crossings_s = dt_s * (at + coordinate[at] / (coordinate[at] - coordinate[at + 1]))
    half_periods = np.diff(crossings_s)
    assert len(half_periods) >= 3
    assert 1 / (2 * half_periods.mean()) == pytest.approx(frequency, rel=1e-3)


# --- the command ------------------------------------------------------------------------------------------------------

BAR = """
name: bar
bodies:
  - name: bar
    mesh: {grid: {size_m: {x: 1, y: 0.1, z: 0.1}, cells_x: 8, cells_y: 1, cells_z: 1, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 1.0e+6, poisson_ratio: 0.3}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2
    rayleigh_stiffness_s: 0.001
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 0.001, y: 1, z: 1}}}]
  - name: free
    mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 1, cells_y: 1, cells_z: 1}}
    law: {hooke: {young_modulus_pa: 1.0e+6, poisson_ratio: 0.3}, prony: [{share: 0.1, relaxation_time_s: 1}]}
    density_kg_per_m3: 1000
"""
Ran = tuple[int, str, str]


@pytest.fixture
def modes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Runs the command on the text of a scene: exit status, standard output, standard error."""

    def run(text: str, *options: str) -> Ran:
        (tmp_path / "scene.yaml").write_text(text)
        status = main(["modes", str(tmp_path / "scene.yaml"), *options])
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


def test_the_command_prints_each_body_with_its_modes(modes: Callable[..., Ran]) -> None:
    status, out, _ = modes(BAR, "--count", "7")
    assert status == 0
    assert "bar, body bar: 36 nodes, 96 free directions, 10 kg" in out
    assert out.count("rigid") == 6
    assert "body 'free': the instantaneous moduli are taken" in out


def test_json_has_frequencies_damping_and_effective_masses(modes: Callable[..., Ran]) -> None:
    _, out, _ = modes(BAR, "--count", "7", "--json")
    summary = json.loads(out)
    assert [body["name"] for body in summary["bodies"]] == ["bar", "free"]
    first = summary["bodies"][0]["modes"][0]
    scene = tm.Scene.from_yaml(BAR)
    expected = lowest_modes(matrices_of(scene), 7)
    assert first["frequency_hz"] == pytest.approx(expected.frequency_hz[0])
    assert first["effective_mass_kg"] == pytest.approx(expected.effective_mass_kg[0].tolist())
    angular = 2 * np.pi * first["frequency_hz"]
    assert first["damping_ratio"] == pytest.approx(2 / (2 * angular) + 0.001 * angular / 2)
    assert summary["bodies"][1]["modes"][0]["damping_ratio"] is None


def test_a_body_with_fewer_modes_has_all_of_them(modes: Callable[..., Ran], tmp_path: Path) -> None:
    fixed = BAR + "    fixed: [{nodes: {indices: [0, 1, 2, 3, 4, 5]}}]\n"
    _, out, _ = modes(fixed, "--count", "8", "--json", "--export", str(tmp_path / "modes.vtu"))
    summary = json.loads(out)
    assert [len(body["modes"]) for body in summary["bodies"]] == [8, 6]
    assert "body 'free': has no more than 6 modes, one for each free direction of a node" in summary["warnings"]
    last = meshio.read(tmp_path / "modes.vtu").point_data["mode_008"]
    assert np.abs(last[:36]).max() > 0
    assert not last[36:].any()
    _, out, _ = modes(fixed.replace("5]", "5, 6, 7]"), "--json")
    assert json.loads(out)["bodies"][1]["modes"] == []


def test_a_vtu_file_has_the_shapes_of_all_bodies(modes: Callable[..., Ran], tmp_path: Path) -> None:
    status, out, _ = modes(BAR, "--count", "2", "--export", str(tmp_path / "modes.vtu"))
    assert status == 0
    assert out.endswith(f"written: {tmp_path / 'modes.vtu'}\n")
    mesh = meshio.read(tmp_path / "modes.vtu")
    expected = [lowest_modes(matrices(body), 2).shapes for body in tm.Scene.from_yaml(BAR).message.bodies]
    assert set(mesh.point_data) == {"mode_001", "mode_002"}
    np.testing.assert_allclose(mesh.point_data["mode_002"], np.concatenate([of[1] for of in expected]), atol=1e-12)
    assert [len(values) for values in mesh.cell_data["body"]] == [8, 6]


def test_an_npz_file_has_arrays_of_each_body(modes: Callable[..., Ran], tmp_path: Path) -> None:
    modes(BAR, "--count", "3", "--export", str(tmp_path / "modes.npz"))
    with np.load(tmp_path / "modes.npz") as arrays:
        assert set(arrays) == {f"{b}/{of}" for b in ("bar", "free") for of in ("frequency_hz", "shapes", "positions")}
        assert arrays["bar/shapes"].shape == (3, 36, 3)
        assert arrays["bar/positions"].shape == (36, 3)
        assert arrays["bar/frequency_hz"][0] > 0


PYRAMIDS = BAR.replace("shape: hexahedron", "shape: pyramid")
LAW = "neo_hookean: {young_modulus_pa: 1.0e+6, poisson_ratio: 0.3}"
FIBRES = "transversely_isotropic: {young_modulus_pa: 1.0e+6, poisson_ratio: 0.3, fibre_modulus_pa: 1}"
STIFF = "mooney_rivlin: {c10_pa: 1, c01_pa: 1, bulk_modulus_pa: 1.0e+9}"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        (PYRAMIDS, (), "body 'bar': modes of a pyramid are not computed; take tetrahedron, quadratic_tetrahedron, hex"),
        (
            BAR.replace("rayleigh_mass_per_s: 2", "quadrature: reduced"),
            (),
            "body 'bar': with quadrature: reduced, bending modes of a hexahedron have no stiffness; take selective",
        ),
        (
            BAR.replace("hexahedron", "tetrahedron").replace("rayleigh_mass_per_s: 2", "quadrature: selective"),
            (),
            "body 'bar': with quadrature: selective, modes of linear tetrahedra are not computed; take full",
        ),
        (
            BAR.replace(LAW, FIBRES),
            (),
            "body 'bar'.law: transversely_isotropic is not isotropic, and modes are computed for isotropic laws",
        ),
        (BAR.replace(LAW, STIFF), (), "mooney_rivlin is stiffer in volume than Poisson's ratio 0.4999 is"),
        (BAR.replace(LAW, ""), (), "body 'bar'.law: has no law; give one of hooke, "),
        (BAR.replace("poisson_ratio: 0.3", "poisson_ratio: 0.5"), (), "body 'bar': poisson_ratio: expected a number"),
        (BAR.replace("density_kg_per_m3: 1000", "density_kg_per_m3: 0"), (), "density_kg_per_m3: expected a positive"),
        (BAR.replace("x: 0.001", "x: -0.5"), (), r"body 'bar'.fixed[0]: no node of the body lies in the region"),
        (BAR, ("--count", "0"), "--count 0: must be 1 to 1000"),
        (BAR, ("--export", "modes.txt"), "--export modes.txt: must end in .vtu or .npz"),
        (BAR, ("--export", "none/modes.vtu"), "--export none/modes.vtu: no folder that can be written to"),
        ("name: empty\n", (), "has no bodies"),
    ],
)
def test_what_cannot_be_computed_is_refused(
    modes: Callable[..., Ran], text: str, options: tuple[str, ...], message: str
) -> None:
    status, out, err = modes(text, *options)
    assert (status, out) == (1, "")
    assert message in err


def test_an_inverted_element_is_refused() -> None:
    scene = bar("tetrahedron", (2, 1, 1))
    packed = scene.message.bodies[0].mesh.packed
    nodes = np.frombuffer(packed.elements[0].nodes, "<u4").reshape(-1, 4).copy()
    nodes[3] = nodes[3, [1, 0, 2, 3]]
    packed.elements[0].nodes = nodes.tobytes()
    with pytest.raises(tm.InvalidArgumentError, match="element 3 is flat or inverted"):
        matrices_of(scene)


def test_quadratic_tetrahedra_must_share_the_middles_of_their_edges() -> None:
    mesh = tm.grid([1, 1, 1], [1, 1, 1], shape="quadratic_tetrahedron")
    (block,) = mesh.blocks
    elements = block.nodes.copy()
    shared = np.bincount(elements[:, 4:].reshape(-1)).argmax()
    nodes = np.concatenate([mesh.nodes, mesh.nodes[[shared]] + 0.01])
    elements[0][elements[0] == shared] = len(nodes) - 1
    torn = tm.VolumeMesh.from_arrays(nodes, [("quadratic_tetrahedron", elements)])
    with pytest.raises(tm.InvalidArgumentError, match="have different nodes in the middle of a shared edge"):
        matrices_of(tm.Scene.from_mesh(torn))


def test_without_the_packages_the_command_says_what_to_install(
    modes: Callable[..., Ran], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "skfem", None)
    status, _, err = modes(BAR)
    assert status == 1
    assert "modes needs scikit-fem and SciPy" in err
    assert "pip install 'tensormass[modes]'" in err
