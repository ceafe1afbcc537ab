"""Sharp ridges that cross hold each other, with nodes far from the crossing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tensormass as tm

SIZE_M = (0.1, 0.02, 0.02)
WEIGHT_N = 1000 * 9.81 * float(np.prod(SIZE_M))
HALF_DIAGONAL_M = SIZE_M[1] / np.sqrt(2)


def bar(cells: int, *, yaw: float, on_a_ridge: bool, middle_m: tuple[float, float, float]) -> tm.VolumeMesh:
    """A bar of square section along x, turned by `yaw` about z, around its middle."""
    mesh = tm.grid([cells, 1, 1], list(SIZE_M), shape="hexahedron", origin_m=[-s / 2 for s in SIZE_M])
    x, y, z = mesh.nodes.T
    if on_a_ridge:
        y, z = (y - z) / np.sqrt(2), (y + z) / np.sqrt(2)
    nodes = np.stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z], axis=1)
    return replace(mesh, nodes=nodes + middle_m)


def crossed(
    *, yaw: float, upper_on_a_ridge: bool, gap_m: float, cells: tuple[int, int], rails_m: tuple[float, ...] = (0.0,)
) -> tuple[tm.Scene, np.ndarray]:
    """Bars with a ridge upward at z = 0, and one across them. Returns which nodes of the lower bars are held."""
    scene = tm.Scene("ridges")
    numbers: dict[str, Any] = {"young_modulus_pa": 1e5, "poisson_ratio": 0.3, "density_kg_per_m3": 1000.0}
    held = np.zeros(0, bool)
    for i, place_m in enumerate(rails_m):
        lower = bar(cells[0], yaw=0, on_a_ridge=True, middle_m=(0, place_m, -HALF_DIAGONAL_M))
        held = lower.nodes[:, 2] < -HALF_DIAGONAL_M + 1e-9
        scene.add_body(f"lower{i}", lower, law="stable_neo_hookean", **numbers, fixed_nodes=held)
    half_m = HALF_DIAGONAL_M if upper_on_a_ridge else SIZE_M[2] / 2
    upper = bar(cells[1], yaw=yaw, on_a_ridge=upper_on_a_ridge, middle_m=(0.0013, 0.0021, gap_m + half_m))
    scene.add_body("upper", upper, law="stable_neo_hookean", **numbers)
    scene.message.gravity_m_per_s2.z = -9.81
    for body in scene.message.bodies:
        body.rayleigh_stiffness_s = 0.002
        body.rayleigh_mass_per_s = 2
    scene.set_solver(precision="double", cg_tolerance=1e-9, cg_max_iterations=5000)
    return scene, held


def carried_n(handle: tm.SceneHandle, body: str, held: np.ndarray) -> float:
    """What a lower bar carries besides itself."""
    return float(handle.fields(body, ["reaction_force"])["reaction_force"][held, 2].sum()) - WEIGHT_N


@pytest.mark.parametrize("rate_hz", [60, 1000])
@pytest.mark.parametrize("cells", [(3, 5), (3, 16), (1, 1)])
@pytest.mark.parametrize("upper_on_a_ridge", [True, False])
def test_a_ridge_carries_the_bar_that_falls_on_it(
    server: tm.Server, upper_on_a_ridge: bool, cells: tuple[int, int], rate_hz: int
) -> None:
    gap_m = 0.01
    scene, held = crossed(yaw=1.2, upper_on_a_ridge=upper_on_a_ridge, gap_m=gap_m, cells=cells)
    scene.fix("upper", np.ones(4 * (cells[1] + 1), bool), axes="xy")  # alone it would roll off
    scene.add_body_contact("upper", "lower0", distance_m=5e-4)
    scene.set_stepping(dt_s=1 / rate_hz)
    with server.load(scene, lockstep=True) as handle:
        start_m = handle.positions("upper")[:, 2].mean()
        handle.step(2 * rate_hz)
        assert carried_n(handle, "lower0", held) == pytest.approx(WEIGHT_N, rel=1e-3)
        assert start_m - gap_m - handle.positions("upper")[:, 2].mean() == pytest.approx(0, abs=0.002)


@pytest.mark.parametrize("iterations", [1, 20])
def test_a_bar_on_a_ridge_rests_with_bdf2(server: tm.Server, iterations: int) -> None:
    """Bars of one cell chattered at 60 Hz by 3.5 times the weight, until BDF2 started anew where forces jump."""
    scene, held = crossed(yaw=1.2, upper_on_a_ridge=True, gap_m=0.01, cells=(1, 1))
    scene.fix("upper", np.ones(8, bool), axes="xy")
    scene.add_body_contact("upper", "lower0", distance_m=5e-4)
    scene.set_solver(
        precision="double",
        integrator="bdf2",
        newton_max_iterations=iterations,
        cg_tolerance=1e-9,
        cg_max_iterations=5000,
    )
    scene.set_stepping(dt_s=1 / 60)
    load_n = []
    with server.load(scene, lockstep=True) as handle:
        handle.step(240)
        for _ in range(30):
            handle.step()
            load_n.append(carried_n(handle, "lower0", held))
    assert load_n == pytest.approx([WEIGHT_N] * 30, rel=1e-3)


def test_a_bar_rests_on_two_rails(server: tm.Server) -> None:
    """Only its rims cross the rails. Friction holds it, and each rail carries a part of its weight by the lever."""
    rails_m = (-0.02, 0.03)
    scene, held = crossed(yaw=np.pi / 2, upper_on_a_ridge=False, gap_m=0.001, cells=(3, 1), rails_m=rails_m)
    for i in range(2):
        scene.add_body_contact("upper", f"lower{i}", friction_coefficient=0.5, distance_m=5e-4)
    scene.set_stepping(dt_s=1 / 240)
    with server.load(scene, lockstep=True) as handle:
        handle.step(960)
        before = handle.positions("upper")
        own = [carried_n(handle, f"lower{i}", held) for i in range(2)]
        handle.step(240)
        assert np.abs(handle.positions("upper") - before).max() < 1e-6
        middle_m = float(before[:, 1].mean())
    assert sum(own) == pytest.approx(WEIGHT_N, rel=1e-4)
    assert own[1] == pytest.approx(WEIGHT_N * (middle_m - rails_m[0]) / (rails_m[1] - rails_m[0]), rel=0.01)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_a_press_on_ridges_has_an_equilibrium(server: tm.Server, friction: float) -> None:
    """Both bars carry the same force, and it grows with the depth."""
    forces = []
    for depth_m in (0.002, 0.004):
        scene, held = crossed(yaw=1.0, upper_on_a_ridge=True, gap_m=0.0, cells=(4, 5))
        scene.message.ClearField("gravity_m_per_s2")
        scene.add_body_contact("upper", "lower0", friction_coefficient=friction, distance_m=5e-4)
        top = bar(5, yaw=1.0, on_a_ridge=True, middle_m=(0, 0, 0)).nodes[:, 2] > 1e-9
        scene.prescribe("upper", [0, 0, -depth_m], top)
        scene.set_solver(precision="double", integrator="quasi_static", cg_tolerance=1e-10, cg_max_iterations=5000)
        scene.set_stepping(dt_s=1)
        with server.load(scene, lockstep=True) as handle:
            handle.step(3)
            above = handle.fields("upper", ["reaction_force"])["reaction_force"][top].sum(axis=0)
            below = handle.fields("lower0", ["reaction_force"])["reaction_force"][held].sum(axis=0)
        assert np.allclose(above, -below, atol=1e-5 * np.abs(below).max())
        forces.append(below[2])
    assert 0 < 1.5 * forces[0] < forces[1]
