"""What the tests of `tensormass trade` measure instead of a running daemon."""

from __future__ import annotations

from pathlib import Path

from tensormass.scene import SceneFile
from tensormass.trade.knobs import Knobs, Setting
from tensormass.trade.measures import Errors
from tensormass.trade.script import Costs
from tensormass.trade.store import Machine, Measurement

BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
bodies:
  - name: block
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 3, shape: hexahedron}}
    law: {neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}, prony: [{share: 0.2, relaxation_time_s: 0.1}]}
    density_kg_per_m3: 1000
    quadrature: selective
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - {name: probe, spherical_probe: {radius_m: 0.01}, position_m: {x: 0.05, y: 0.05, z: 0.08}}
solver: {cg_tolerance: 0.01}
"""
MACHINE = Machine("cpu", "some processor", None, "1", "abc")
COSTS = Costs(1e-3, 2e-3, 3e-3, 10, 20, 5, 500, 0.1)


def knobs_of(text: str, folder: Path) -> Knobs:
    return Knobs(SceneFile.parse(text, folder, "scene.yaml"), folder / "meshes")


def measurement(setting: Setting, cost_s: float, error: float, failure: str = "") -> Measurement:
    errors = None if failure else Errors(error, error, 0)
    return Measurement(
        repr(setting), dict(setting), MACHINE, 6, errors, None if failure else COSTS, cost_s=cost_s, failure=failure
    )
