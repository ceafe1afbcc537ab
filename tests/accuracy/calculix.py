"""The same equilibria by CalculiX, which shares no code with the server. Its results have seven digits."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from .meshes import Floats
from .problem import Problem

PROGRAM = "ccx"
# Shapes that CalculiX integrates with the rule of scene.proto. Its C3D6 has 1×2 points, and it has no pyramid.
ELEMENTS = {"tetrahedron": "C3D4", "hexahedron": "C3D8", "quadratic_tetrahedron": "C3D10"}
_RESIDUAL = "1E-13"
# CalculiX treats forces below 1e-8 as zero. With millimetres and pascals a newton becomes a million.
_MM = 1e3
_FORCE_UNITS = 1e6


def available() -> bool:
    return shutil.which(PROGRAM) is not None


def source() -> str:
    text = subprocess.run([PROGRAM, "-v"], capture_output=True, text=True, check=False).stdout
    version = re.search(r"Version (\S+)", text)
    return f"CalculiX {version.group(1)}" if version else "CalculiX"


def solve(problem: Problem) -> Floats:
    """Displacements in equilibrium, [node_count, 3] m, for a mesh of one shape and a law that CalculiX has."""
    with tempfile.TemporaryDirectory(prefix="accuracy-") as folder:
        (Path(folder) / "case.inp").write_text(_deck(problem))
        done = subprocess.run([PROGRAM, "-i", "case"], cwd=folder, capture_output=True, text=True, check=False)
        results = Path(folder) / "case.dat"
        if done.returncode != 0 or not results.exists():
            raise ArithmeticError(f"CalculiX gave up:\n{done.stdout[-2000:]}")
        tables = results.read_text().split("displacements")[1:]
    if len(tables) != problem.increments:
        raise ArithmeticError(f"CalculiX made {len(tables)} of {problem.increments} increments:\n{done.stdout[-2000:]}")
    rows = [line.split() for line in tables[-1].splitlines()[1:] if line.strip()]
    return np.array([[float(value) for value in row[1:4]] for row in rows]) / _MM


def _deck(problem: Problem) -> str:
    ((shape, elements),) = problem.mesh.blocks
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{i}, {x:.12E}, {y:.12E}, {z:.12E}" for i, (x, y, z) in enumerate(_MM * problem.mesh.nodes, 1)]
    lines.append(f"*ELEMENT, TYPE={ELEMENTS[shape]}, ELSET=BODY")
    lines += [f"{i}, " + ", ".join(str(node + 1) for node in element) for i, element in enumerate(elements, 1)]
    lines += ["*MATERIAL, NAME=TISSUE", problem.law.calculix.rstrip(), "*SOLID SECTION, ELSET=BODY, MATERIAL=TISSUE"]
    # Increments of equal size, each iterated down to rounding.
    share = 1 / problem.increments
    lines += ["*STEP, NLGEOM, INC=1000", "*STATIC, DIRECT", f"{share:.12E}, 1."]
    lines += ["*CONTROLS, PARAMETERS=FIELD", f"{_RESIDUAL}, {_RESIDUAL}, , , {_RESIDUAL}, , , {_RESIDUAL}"]
    lines += ["*CONTROLS, PARAMETERS=TIME INCREMENTATION", "60, 80, 9, 200, 10, 4, , 5, , "]
    lines.append("*BOUNDARY")
    prescribed = _MM * problem.prescribed()
    for node, direction in np.argwhere(~np.isnan(prescribed)):
        lines.append(f"{node + 1}, {direction + 1}, {direction + 1}, {prescribed[node, direction]:.12E}")
    forces = _FORCE_UNITS * problem.nodal_forces()
    if np.any(forces):
        lines.append("*CLOAD")
        for node, direction in np.argwhere(forces != 0):
            lines.append(f"{node + 1}, {direction + 1}, {forces[node, direction]:.12E}")
    lines += ["*NODE PRINT, NSET=ALL", "U", "*END STEP", ""]
    return "\n".join(lines)
