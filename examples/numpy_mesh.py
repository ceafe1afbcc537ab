"""Builds a mesh with NumPy, lets it bend under its own weight, and compares the result with beam theory.

Shows: nodes and elements as arrays, a fixed set of nodes, gravity, equilibrium in one step, results as an array.
Needs: a built daemon (`make build`) and the Python package.
Run:   python examples/numpy_mesh.py
"""

import numpy as np

import tensormass as tm

SIZE_M = LENGTH_M, _, HEIGHT_M = 0.1, 0.01, 0.01  # along x, y, z
CELLS = (40, 4, 4)
YOUNG_MODULUS_PA, DENSITY_KG_PER_M3, GRAVITY_M_PER_S2 = 5e6, 1060.0, 9.81


def hexahedra() -> tuple[np.ndarray, np.ndarray]:
    """Returns nodes [n, 3] m and hexahedra [m, 8] of a beam, corners in VTK's order."""
    axes = [np.linspace(0.0, size_m, cells + 1) for size_m, cells in zip(SIZE_M, CELLS, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    node = np.arange(len(nodes)).reshape([cells + 1 for cells in CELLS])  # [x, y, z]
    low, high = slice(None, -1), slice(1, None)
    bottom = [node[low, low, low], node[high, low, low], node[high, high, low], node[low, high, low]]
    top = [node[low, low, high], node[high, low, high], node[high, high, high], node[low, high, high]]
    return nodes, np.stack(bottom + top, axis=-1).reshape(-1, 8)


def main() -> None:
    nodes, elements = hexahedra()
    scene = tm.Scene.from_mesh(
        tm.VolumeMesh.from_arrays(nodes, [("hexahedron", elements)]),
        body="beam",
        young_modulus_pa=YOUNG_MODULUS_PA,
        poisson_ratio=0.3,
        quadrature="selective",  # or linear hexahedra are too stiff in bending
        density_kg_per_m3=DENSITY_KG_PER_M3,
        fixed_nodes=nodes[:, 0] == 0.0,
        gravity_m_per_s2=(0.0, 0.0, -GRAVITY_M_PER_S2),
    )
    scene.message.solver.integrator = scene.message.solver.INTEGRATOR_QUASI_STATIC
    scene.message.solver.precision = scene.message.solver.PRECISION_DOUBLE
    with tm.launch() as server:
        handle = server.load(scene, lockstep=True)
        handle.step()
        moved_m = handle.positions("beam") - nodes

    tip_mm = -1000 * moved_m[nodes[:, 0] == LENGTH_M, 2].mean()
    # Euler and Bernoulli: w = q L⁴ / (8 E I) with q = ρ g h² and I = h⁴ / 12.
    theory_mm = 1500 * DENSITY_KG_PER_M3 * GRAVITY_M_PER_S2 * LENGTH_M**4 / (YOUNG_MODULUS_PA * HEIGHT_M**2)
    print(f"{len(nodes)} nodes, {len(elements)} hexahedra")
    print(f"the free end sinks by {tip_mm:.2f} mm; beam theory says {theory_mm:.2f} mm")


if __name__ == "__main__":
    main()
