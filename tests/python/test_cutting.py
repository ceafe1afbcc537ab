"""Bodies that are cut while they step, through the whole daemon: SDK, readers that join late, snapshots, refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

import tensormass as tm

SIZE_M = (0.06, 0.03, 0.03)
#: A blade along y that goes down through the middle of the block.
ABOVE, BELOW = [[0.031, -1, 0.1], [0.031, 1, 0.1]], [[0.031, -1, -0.1], [0.031, 1, -0.1]]
HALF = [[0.031, -1, 0.0151], [0.031, 1, 0.0151]]


def block(*, cutting: bool = True) -> tm.Scene:
    """A block that is held at one end and sags under its weight."""
    mesh = tm.grid([8, 4, 4], SIZE_M, shape="tetrahedron")
    scene = tm.Scene("block")
    scene.add_body(
        "block",
        mesh,
        law="stable_neo_hookean",
        young_modulus_pa=2e4,
        poisson_ratio=0.45,
        density_kg_per_m3=1000,
        fixed_nodes=mesh.nodes[:, 0] < 1e-9,
    )
    scene.body("block").rayleigh_mass_per_s = 20
    scene.message.gravity_m_per_s2.z = -9.81
    scene.message.solver.cg_max_iterations = 400
    if cutting:
        scene.message.editing.cutting.SetInParent()
    return scene


def expect_closed(frame: tm.Frame) -> None:
    """Fails if an edge of the surface has not as many triangles in one direction as in the other."""
    faces = frame.triangles("block")
    assert faces.max() < len(frame.vertices("block"))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward, back = edges[edges[:, 0] < edges[:, 1]], edges[edges[:, 0] > edges[:, 1]][:, ::-1]
    assert (np.sort(forward.view("u4,u4"), axis=0) == np.sort(back.copy().view("u4,u4"), axis=0)).all()


def test_a_block_that_is_cut_through_falls_apart(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.step(30)
        sagging = scene.positions("block")
        before = scene.frame()
        scene.cut("block", [ABOVE, HALF])
        np.testing.assert_allclose(scene.positions("block"), sagging, atol=1e-7)
        scene.step(30)
        opened = scene.positions("block")
        assert opened[:, 2].min() < sagging[:, 2].min() - 1e-4, "what is half cut sags more"
        expect_closed(scene.frame())
        scene.cut("block", [HALF, BELOW])
        scene.step(60)
        fallen = scene.positions("block")
        nodes = tm.grid([8, 4, 4], SIZE_M, shape="tetrahedron").nodes
        free, held = nodes[:, 0] > 0.035, nodes[:, 0] < 0.02
        assert (fallen[free, 2] < opened[free, 2] - 0.3).all(), "a second of fall in air that brakes"
        assert np.abs(fallen[held] - opened[held]).max() < 0.01
        frame = scene.frame()
        expect_closed(frame)
        assert len(frame.triangles("block")) > len(before.triangles("block"))
        scene.reset()
        np.testing.assert_allclose(scene.positions("block"), nodes, atol=1e-7)
        assert len(scene.frame().triangles("block")) == len(before.triangles("block"))
        scene.step(30)
        np.testing.assert_allclose(scene.positions("block"), sagging, atol=1e-7)


def test_events_and_fields_tell_of_a_cut(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        whole = scene.fields("block", ["displacement", "elastic_energy"])
        scene.cut("block", [ABOVE, HALF])
        scene.step(5)
        event = next(one for one in scene.events(timeout_s=60) if one.kind == "cut")
        assert event.value == pytest.approx(SIZE_M[1] * SIZE_M[2] / 2, rel=0.25)
        fields = scene.fields("block", ["displacement", "elastic_energy"])
        for name in ("displacement", "elastic_energy"):
            assert fields[name].shape == whole[name].shape, "by node and element of the mesh as loaded"


def test_a_snapshot_is_of_the_scene_with_its_cuts(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.step(10)
        scene.cut("block", [ABOVE, HALF])
        scene.step(10)
        end = scene.positions("block")
        snapshot = scene.snapshot()
        scene.step(5)
        later = scene.positions("block")
        scene.restore(snapshot)
        np.testing.assert_array_equal(scene.positions("block"), end)
        scene.step(5)
        np.testing.assert_array_equal(scene.positions("block"), later)


def opening_per_force(server: tm.Server, crack_m: float, arm_m: float, width_m: float, cells_of_arm: int) -> float:
    """Opening of a double cantilever beam of hexahedra per force at its ends [m/N], E = 1 MPa and ν = 0. The blade goes
    through the middle of elements, and half of one further: those at its front are whole."""
    cells = 2 * cells_of_arm + 1
    size = 2 * arm_m / cells
    count = round(2 * crack_m / size)
    length, force_n = count * size, 1e-4
    mesh = tm.grid([count, cells, 2], (length, 2 * arm_m, width_m), shape="hexahedron")
    scene = tm.Scene("beam")
    scene.add_body(
        "beam",
        mesh,
        law="hooke",
        young_modulus_pa=1e6,
        poisson_ratio=0.0,
        density_kg_per_m3=1000,
        fixed_nodes=mesh.nodes[:, 0] < 1e-9,
    )
    scene.set_solver(integrator="quasi_static", precision="double", cg_max_iterations=20_000, cg_tolerance=1e-9)
    scene.message.editing.cutting.SetInParent()
    scene.message.streams.frame_rate_hz = 0
    ends = []
    for y_m, sign in ((2 * arm_m, 1), (0.0, -1)):
        load = scene.body("beam").loads.add()
        load.force_n.y = sign * force_n
        for bound, away in ((load.region.box.min_m, -1e-6), (load.region.box.max_m, 1e-6)):
            bound.x, bound.y, bound.z = length + away, y_m + away, math.copysign(1, away)
        ends.append((mesh.nodes[:, 0] > length - 1e-6) & (abs(mesh.nodes[:, 1] - y_m) < 1e-6))
    front = length - crack_m - size / 2
    with server.load(scene, lockstep=True) as handle:
        handle.cut("beam", [[[x, arm_m, z] for z in (-1, 1)] for x in (1, front)])
        handle.step()
        moved = handle.positions("beam")[:, 1] - mesh.nodes[:, 1]
    return float(moved[ends[0]].mean() - moved[ends[1]].mean()) / force_n


@pytest.mark.parametrize("crack_m", [0.05, 0.06])
def test_a_double_cantilever_beam_opens_as_beams_on_a_foundation_do(server: tm.Server, crack_m: float) -> None:
    arm_m, width_m = 0.005, 0.002
    # Kanninen, Int. J. Fracture 9 (1973): the arms turn a little where they join.
    expected = 8 * (crack_m + 0.64 * arm_m) ** 3 / (1e6 * width_m * arm_m**3)
    coarse, fine = (opening_per_force(server, crack_m, arm_m, width_m, cells) / expected - 1 for cells in (3, 6))
    assert abs(fine) < 0.03
    assert abs(fine) < abs(coarse)


@pytest.mark.parametrize(
    ("body", "blade", "error", "words"),
    [
        ("none", [ABOVE, HALF], tm.NotFoundError, "no body 'none'"),
        ("block", [ABOVE, ABOVE], tm.InvalidArgumentError, "crosses no edge"),
        ("block", [ABOVE], tm.InvalidArgumentError, "1 positions"),
        ("block", [[ABOVE[0]], [HALF[0]]], tm.InvalidArgumentError, "3 numbers"),
        ("block", [ABOVE, [[np.nan] * 3] * 2], tm.InvalidArgumentError, "not a number"),
        ("block", [ABOVE, [[1e300] * 3] * 2], tm.InvalidArgumentError, "blade"),
    ],
)
def test_refuses_in_words(
    server: tm.Server, body: str, blade: list[list[list[float]]], error: type[Exception], words: str
) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.step(2)
        before = scene.positions("block")
        with pytest.raises(error, match=words):
            scene.cut(body, blade)
        np.testing.assert_array_equal(scene.positions("block"), before)
        scene.step()


def test_a_scene_says_that_it_may_be_cut(server: tm.Server) -> None:
    with (
        server.load(block(cutting=False), lockstep=True) as scene,
        pytest.raises(tm.FailedPreconditionError, match=r"load it with scene\.editing\.cutting"),
    ):
        scene.cut("block", [ABOVE, HALF])
