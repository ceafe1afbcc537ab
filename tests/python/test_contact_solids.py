"""A cube that is pressed into tissue keeps its force, and no node comes inside, however fine the mesh is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import tensormass as tm

EDGE_M, DEPTH_M, SPEED_M_PER_S = 0.02, 0.006, 0.01
SIZE_M = np.array([0.06, 0.06, 0.03])
START_M = np.array([0.0005, 0.0003, EDGE_M / 2 + 1e-4])
RATE_HZ = 60


def cube_surface() -> tm.TriangleSurface:
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * EDGE_M / 2
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return tm.TriangleSurface.from_arrays(
        corners, np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    )


def press(server: tm.Server, kind: str, cell_m: float, **contact: float | str) -> tuple[float, float, float]:
    """Returns the force [N], its range while the cube holds still as a share of it, and the depth of the deepest node
    in the cube [m]."""
    mesh = tm.grid(
        [round(size / cell_m) for size in SIZE_M],
        list(SIZE_M),
        origin_m=tuple(-SIZE_M * [0.5, 0.5, 1]),
        shape="hexahedron",
    )
    scene = tm.Scene("cube")
    numbers: dict[str, Any] = {"young_modulus_pa": 1e4, "poisson_ratio": 0.45, "density_kg_per_m3": 1000.0}
    scene.add_body(
        "block", mesh, law="stable_neo_hookean", **numbers, fixed_nodes=mesh.nodes[:, 2] < -SIZE_M[2] + 1e-9,
        quadrature="selective",
    )  # fmt: skip
    scene.body("block").rayleigh_stiffness_s = 0.01
    shape: dict[str, Any] = {"surface": cube_surface()}
    if kind == "box":
        shape = {"size_x_m": EDGE_M, "size_y_m": EDGE_M, "size_z_m": EDGE_M}
    numbers = {"position_m": tuple(START_M), "max_speed_m_per_s": 1.0, **shape, **contact}
    scene.add_tool("cube", kind, **numbers)
    scene.set_stepping(dt_s=1 / RATE_HZ)
    way_m = np.array([0, 0, DEPTH_M + 1e-4])
    steps = round(way_m[2] / SPEED_M_PER_S * RATE_HZ)
    poses = [(START_M - way_m * i / steps, None, ()) for i in range(1, steps + 1)]
    with server.load(scene, lockstep=True) as handle:
        handle.follow("cube", poses)
        handle.step(40)
        forces = []
        for _ in range(8):
            handle.step()
            forces.append(handle.feedback("cube").force_n[2])
        from_cube = np.abs(handle.positions("block") - (START_M - way_m))
    deepest_m = float((EDGE_M / 2 - from_cube.max(axis=1)).max())
    return forces[-1], float(np.ptp(forces)) / forces[-1], max(deepest_m, 0.0)


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_a_cube_keeps_its_force_and_no_node_comes_inside(server: tm.Server, kind: str) -> None:
    rigid_n, change, inside_m = press(server, kind, 0.005, contact_method="augmented_lagrangian")
    assert change < 0.01
    assert inside_m < 1e-4, "without penetration"
    for cell_m, off in ((0.01, 0.3), (0.005, 0.17), (0.0025, 0.17)):
        force_n, change, inside_m = press(server, kind, cell_m)
        assert force_n == pytest.approx(rigid_n, rel=off), cell_m
        assert change < 0.03, cell_m
        assert inside_m < 6e-4, cell_m


def test_tissue_rests_under_a_cube_of_any_stiffness(server: tm.Server) -> None:
    default = 20 * 1e4 / (EDGE_M / 2)
    for factor in (0.1, 1, 10):
        _, change, _ = press(server, "box", 0.005, penalty_stiffness_pa_per_m=factor * default)
        assert change < 0.01, factor
    forces = []
    for factor in (0.01, 1):
        force_n, change, _ = press(
            server, "box", 0.005, penalty_stiffness_pa_per_m=factor * default, contact_method="augmented_lagrangian"
        )
        assert change < 0.01, factor
        forces.append(force_n)
    assert forces[0] == pytest.approx(forces[1], rel=0.01), "the force without penetration does not depend on it"
