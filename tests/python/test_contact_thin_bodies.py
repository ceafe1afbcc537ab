"""A thin body holds what falls on it."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

import tensormass as tm

EDGE_M, SHEET_M = 0.05, 0.12
SCHEMES: dict[str, tuple[Literal["implicit_euler", "bdf2", "implicit_midpoint"], int]] = {
    "implicit Euler": ("implicit_euler", 1),
    "BDF2": ("bdf2", 1),
    "midpoint": ("implicit_midpoint", 1),
    "implicit Euler with Newton": ("implicit_euler", 20),
    "BDF2 with Newton": ("bdf2", 20),
    "midpoint with Newton": ("implicit_midpoint", 20),
}


def block_over_sheet(thickness_m: float, fall_m: float) -> tuple[tm.Scene, np.ndarray]:
    """A cube over a sheet that is held at its rim. Returns which nodes of the sheet are held."""
    layers = max(1, round(thickness_m / 0.004))
    mesh = tm.grid(
        [12, 12, layers], [SHEET_M, SHEET_M, thickness_m], origin_m=(-SHEET_M / 2, -SHEET_M / 2, -thickness_m)
    )
    held = np.abs(mesh.nodes[:, :2]).max(axis=1) > SHEET_M / 2 - 1e-9
    numbers: dict[str, Any] = {"law": "stable_neo_hookean", "poisson_ratio": 0.4, "density_kg_per_m3": 1000.0}
    scene = tm.Scene("sheet")
    scene.add_body("sheet", mesh, young_modulus_pa=1e5, fixed_nodes=held, **numbers)
    block = tm.grid([4] * 3, [EDGE_M] * 3, origin_m=(-EDGE_M / 2 + 0.0013, -EDGE_M / 2 + 0.0007, fall_m))
    scene.add_body("block", block, young_modulus_pa=2e4, **numbers)
    scene.message.gravity_m_per_s2.z = -9.81
    for body in scene.message.bodies:
        body.rayleigh_stiffness_s = 0.005
    scene.add_body_contact("block", "sheet", friction_coefficient=0.3)
    return scene, held


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("thickness_m", [0.002, 0.005])
def test_a_sheet_holds_a_block_that_falls_on_it(server: tm.Server, thickness_m: float, scheme: str) -> None:
    """At 60 Hz the block moves 23 mm in the step in which it arrives, past the sheet and past the contact's reach."""
    scene, held = block_over_sheet(thickness_m, 0.1)
    integrator, iterations = SCHEMES[scheme]
    scene.set_solver(precision="double", integrator=integrator, newton_max_iterations=iterations)
    scene.set_stepping(dt_s=1 / 60)
    with server.load(scene, lockstep=True) as handle:
        handle.step(120)
        load_n = []
        for _ in range(30):
            handle.step()
            load_n.append(handle.fields("sheet", ["reaction_force"])["reaction_force"][held, 2].sum())
        lowest_m = float(handle.positions("block")[:, 2].min())
    assert lowest_m > -0.02, "the sheet hangs through by 15 mm"
    weight_n = 1000 * 9.81 * EDGE_M**3
    of_sheet_n = 1000 * 9.81 * SHEET_M**2 * thickness_m
    assert np.mean(load_n) - of_sheet_n == pytest.approx(weight_n, rel=0.02)
