"""Answers of other solvers, stored in references/<solver>.json so that machines without these solvers can compare.

python -m accuracy.references      remakes those whose solver is installed
"""

from __future__ import annotations

import functools
import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from .meshes import Floats
from .problem import Problem

FOLDER = Path(__file__).parent / "references"
COMMAND = "python -m accuracy.references"
SOLVERS = {
    "scikit-fem": "skfem_fem",
    "numpy": "numpy_fem",
    "calculix": "calculix",
    "cook": "cook_reference",
    "contact": "contact_reference",
}
# Displacements are stored as whole multiples of this length, two decimal digits below the tightest bound.
UNIT_M = 1e-11


class StaleReferenceError(Exception):
    """A stored answer is missing or belongs to another problem."""


@functools.cache
def _file(solver: str) -> dict[str, Any]:
    path = FOLDER / f"{solver}.json"
    if not path.exists():
        raise StaleReferenceError(f"{path.name} is missing; make it with `{COMMAND}`")
    return json.loads(path.read_text())


def source(solver: str) -> str:
    """Name and version of the solver that made the answers."""
    try:
        return str(_file(solver)["source"])
    except StaleReferenceError:
        return solver


def read(solver: str, name: str, shape: str, law: str, problem: Problem) -> Floats:
    """Displacements [node_count, 3] m.

    Raises:
        StaleReferenceError: mesh, law, boundary conditions or loads differ from those of the stored answer.
    """
    key = f"{name}/{shape}/{law}"
    entry = _file(solver)["answers"].get(key)
    if entry is None or entry["problem"] != problem.digest():
        raise StaleReferenceError(f"{solver}: no answer for {key} as it stands now; remake them with `{COMMAND}`")
    return np.array(entry["displacement"], dtype=float).reshape(-1, 3) * UNIT_M


def numbers(solver: str) -> dict[str, float]:
    """Answers of a solver that stores single values."""
    return dict(_file(solver)["answers"])


def write(solver: str, answers: dict[str, Any], source: str) -> None:
    """Writes the answers of a solver, one line each."""
    FOLDER.mkdir(exist_ok=True)
    rows = ",\n".join(
        f"    {json.dumps(key)}: {json.dumps(value, separators=(',', ':'))}" for key, value in sorted(answers.items())
    )
    head = json.dumps({"source": source, "command": COMMAND, "displacement_unit_m": UNIT_M})[1:-1]
    (FOLDER / f"{solver}.json").write_text(f'{{{head},\n  "answers": {{\n{rows}\n  }}\n}}\n')


def main() -> int:
    from . import cases_equilibrium, contact_reference, cook_reference

    made: dict[str, dict[str, Any]] = {}
    for solver, name, shape, law in cases_equilibrium.pairs():
        module = importlib.import_module(f".{SOLVERS[solver]}", __package__)
        if not module.available():
            continue
        print(f"{solver}: {name}, {shape}, {law}", flush=True)
        problem = cases_equilibrium.problem(name, shape, law)
        displacement = np.round(module.solve(problem) / UNIT_M).astype(int).ravel().tolist()
        made.setdefault(solver, {})[f"{name}/{shape}/{law}"] = {
            "problem": problem.digest(),
            "displacement": displacement,
        }
    if cook_reference.available():
        print("Cook's membrane", flush=True)
        made["cook"] = cook_reference.solve_all()
        print("sphere against tissue", flush=True)
        made["contact"] = contact_reference.solve_all()
    for solver, answers in made.items():
        write(solver, answers, importlib.import_module(f".{SOLVERS[solver]}", __package__).source())
    return 0


if __name__ == "__main__":
    sys.exit(main())
