"""Measures what the thresholds of two findings stand on, as tables for docs/findings.md.

    python tests/accuracy/finding_thresholds.py locking | coarse

A linear element in full quadrature cannot change its shape without changing its volume, so a beam of nearly
incompressible tissue bends too little. A ball that is smaller than the triangles it touches feels another force at a
node than between nodes.
"""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt

import tensormass as tm

POISSON_RATIOS = (0.45, 0.47, 0.48, 0.49, 0.495, 0.499)
SHAPES = ("tetrahedron", "hexahedron", "wedge")
# Radii [m] of a ball on cells of 12.5 mm, whose triangles have the area of equilateral ones with an edge of 13.4 mm.
RADII_M = (0.02, 0.01, 0.0067, 0.005)
BLOCK_M, CELLS = 0.1, 8
PLACES = 6


def tip_m(server: tm.Server, shape: str, poisson_ratio: float, quadrature: str) -> float:
    """Returns how far a pressure of 10 Pa lifts the tip of a beam."""
    beam = tm.grid([20, 4, 4], [0.1, 0.02, 0.02], shape=shape)
    scene = tm.Scene.from_mesh(
        beam,
        law="neo_hookean",
        young_modulus_pa=1e5,
        poisson_ratio=poisson_ratio,
        quadrature=quadrature,
        fixed_nodes=beam.nodes[:, 0] < 1e-9,
    )
    scene.set_solver(integrator="quasi_static", precision="double")
    load = scene.body("body").loads.add(pressure_pa=10.0)
    load.region.nodes.indices.extend(np.flatnonzero(beam.nodes[:, 2] < 1e-9).tolist())
    with server.load(scene, lockstep=True) as handle:
        handle.step()
        moved = handle.positions("body") - beam.nodes
    return float(moved[beam.nodes[:, 0] > 0.0999, 2].mean())


def locking(server: tm.Server) -> None:
    print(f"| Poisson's ratio | {' | '.join(SHAPES)} |\n|---|---|---|---|")
    for ratio in POISSON_RATIOS:
        stiffer = [tip_m(server, shape, ratio, "selective") / tip_m(server, shape, ratio, "full") for shape in SHAPES]
        print(f"| {ratio} | {' | '.join(f'{one:.3g}' for one in stiffer)} |")


def forces_n(server: tm.Server, radius_m: float, depth_m: float) -> npt.NDArray[np.float64]:
    """Returns the force on a ball at places from a node to the middle of a cell."""
    block = tm.grid([CELLS, CELLS, CELLS // 2], [BLOCK_M, BLOCK_M, BLOCK_M / 2])
    forces = []
    for away in np.linspace(0, 0.5, PLACES) * BLOCK_M / CELLS:
        scene = tm.Scene.from_mesh(
            block,
            law="stable_neo_hookean",
            young_modulus_pa=5e3,
            poisson_ratio=0.45,
            quadrature="selective",
            fixed_nodes=block.nodes[:, 2] < 1e-9,
        )
        scene.set_solver(integrator="quasi_static", precision="double")
        place = (BLOCK_M / 2 + away, BLOCK_M / 2 + 0.6 * away, BLOCK_M / 2 + radius_m - depth_m)
        scene.add_tool("ball", "spherical_probe", radius_m=radius_m, position_m=place)
        scene.accept("tool_inside_tissue", reason="only the equilibrium is measured")
        with server.load(scene, lockstep=True) as handle:
            handle.step()
            forces.append(float(np.linalg.norm(handle.feedback("ball").force_n)))
    return np.array(forces)


def coarse(server: tm.Server) -> None:
    print("| edge / width of the ball | pressed in by 0.8 radius | by 3 mm |\n|---|---|---|")
    edge_m = np.sqrt(2 / np.sqrt(3)) * BLOCK_M / CELLS
    for radius_m in RADII_M:
        found = [forces_n(server, radius_m, depth_m) for depth_m in (min(0.8 * radius_m, 0.01), 0.003)]
        ranges = [f"{100 * np.ptp(forces) / forces.mean():.0f} %" for forces in found]
        print(f"| {edge_m / (2 * radius_m):.2f} | {' | '.join(ranges)} |")


if __name__ == "__main__":
    measure = {"locking": locking, "coarse": coarse}[sys.argv[1]]
    with tm.launch(backend="cpu") as running:
        measure(running)
