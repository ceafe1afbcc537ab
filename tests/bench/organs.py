"""Writes a scene of an organ with the settings of the beams, for `tensormass-bench --scene FILE --unpaced`.

    python tests/bench/organs.py --cell-m 0.0037 liver.scene             the demo's liver, cut finer
    python tests/bench/organs.py --mesh FILE --length-m 0.24 organ.scene any volume mesh, scaled to that length

The law is St-Venant-Kirchhoff, dt 10 ms, float, exactly 50 conjugate-gradient iterations; the lowest tenth of the
nodes is fixed.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from tensormass._src.mesh_files import read_mesh
from tensormass._src.meshes import VolumeMesh
from tensormass._src.organ import ORGANS
from tensormass._src.scene import Scene

_LOWEST = 0.1


def organ_scene(name: str, mesh: VolumeMesh) -> Scene:
    height = mesh.nodes[:, 2]
    scene = Scene.from_mesh(
        mesh,
        name=name,
        law="st_venant_kirchhoff",
        young_modulus_pa=2e4,
        poisson_ratio=0.4,
        gravity_m_per_s2=(0.0, 0.0, -9.81),
        fixed_nodes=height <= np.quantile(height, _LOWEST),
    )
    scene.message.stepping.dt_s = 0.01
    scene.message.solver.cg_tolerance = 0.0
    scene.message.solver.cg_max_iterations = 50
    return scene


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path, help="written: a serialized tensormass.v1.Scene")
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--cell-m", type=float, help="cell size for the demo's liver, which has 0.0093")
    source.add_argument("--mesh", type=Path, help="a volume mesh, as the Python package reads them")
    parser.add_argument("--length-m", type=float, default=0.24, help="with --mesh: scale its box to this longest side")
    arguments = parser.parse_args()
    if arguments.mesh is not None:
        mesh = read_mesh(arguments.mesh)
        scale = arguments.length_m / np.ptp(mesh.nodes, axis=0).max()
        mesh = replace(mesh, nodes=mesh.nodes * scale)
    else:
        mesh = replace(ORGANS["liver"], cell_m=arguments.cell_m).unfitted(graded=False)
    scene = organ_scene(arguments.output.stem, mesh)
    arguments.output.write_bytes(scene.message.SerializeToString())
    print(f"{arguments.output}: {mesh.element_count} elements, {len(mesh.nodes)} nodes")


if __name__ == "__main__":
    main()
