"""What the tests with a real daemon share. Without build/bin/tensormassd they are skipped."""

from __future__ import annotations

import pytest

import tensormass as tm
from tensormass._shared import processes

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

DEADLINE_S = 60.0

# A block on a table with a probe above its middle; light enough for a busy machine.
BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 5, cells_y: 5, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    rayleigh_stiffness_s: 0.01
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.015}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
accepted_findings:
  - {code: softening_law, reason: these tests press little}
  - {code: coarse_surface, reason: few elements make these tests fast}
"""


def block() -> tm.Scene:
    return tm.Scene.from_yaml(BLOCK)
