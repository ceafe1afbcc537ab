"""Cantilever and twisted bar: every law in every shape against other solvers, on the same mesh with the same
quadrature rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from tensormass.v1 import scene_pb2

from . import calculix, references, skfem_fem
from .case import Case, Group, Outcome
from .engine import Engine
from .laws import LAWS, Law
from .meshes import MESHES, Floats, Mesh, box
from .problem import Prescribed, Problem, Traction

GROUP = Group(
    "equilibrium",
    "Cantilever and twisted bar",
    "A bar of 100 × 40 × 40 mm in 5 × 2 × 2 cells, clamped at one end. The cantilever carries a traction of (5, "
    "0, −40) Pa on the other end. The twisted bar has that end rotated by 60° and pulled by 5 mm. Mesh and quadrature "
    "are the same in all solvers. Value: the largest displacement. Error: the largest difference at any node, relative "
    "to the largest displacement. CalculiX prints seven digits.",
)
CELLS = (5, 2, 2)
SIZE_M = (0.1, 0.04, 0.04)
TWIST_RAD = np.pi / 3
PULL_M = 0.005

FE_BOUNDS = {"double": 1e-8, "float": 1e-4}
CALCULIX_BOUNDS = {**FE_BOUNDS, "double": 1e-6}


def _ends(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    near = 1e-6 * SIZE_M[0]
    return mesh.where(lambda x, y, z: x < near), mesh.where(lambda x, y, z: x > SIZE_M[0] - near)


def cantilever(mesh: Mesh, law: Law) -> Problem:
    clamped, loaded = _ends(mesh)
    return Problem(mesh, law, [Prescribed(clamped, np.zeros(3))], [Traction(loaded, (5, 0, -40))])


def twisted_bar(mesh: Mesh, law: Law) -> Problem:
    clamped, turned = _ends(mesh)
    middle = np.array(SIZE_M[1:]) / 2
    cos, sin = np.cos(TWIST_RAD), np.sin(TWIST_RAD)
    arm = mesh.nodes[turned, 1:] - middle
    moved = np.full((len(turned), 3), PULL_M)
    moved[:, 1:] = arm @ np.array([[cos, sin], [-sin, cos]]) - arm
    return Problem(mesh, law, [Prescribed(clamped, np.zeros(3)), Prescribed(turned, moved)], increments=6)


def selective_cantilever(mesh: Mesh, law: Law) -> Problem:
    return replace(cantilever(mesh, law), quadrature=scene_pb2.QUADRATURE_SELECTIVE)


SELECTIVE = "cantilever, selective"
PROBLEMS: dict[str, Callable[[Mesh, Law], Problem]] = {
    "cantilever": cantilever,
    "twisted bar": twisted_bar,
    SELECTIVE: selective_cantilever,
}


def pairs() -> Iterator[tuple[str, str, str, str]]:
    """Yields (solver, problem, shape, law) of every comparison."""
    for shape in MESHES:
        for law, entry in LAWS.items():
            for name in PROBLEMS:
                if name == SELECTIVE:
                    yield "numpy", name, shape, law
                    continue
                yield ("scikit-fem" if shape in skfem_fem.SHAPES else "numpy"), name, shape, law
                if shape in calculix.ELEMENTS and entry.calculix:
                    yield "calculix", name, shape, law


def problem(name: str, shape: str, law: str) -> Problem:
    return PROBLEMS[name](box(shape, CELLS, SIZE_M), LAWS[law])


def equilibrium_cases() -> Iterator[Case]:
    for solver, name, shape, law in pairs():

        def run(engine: Engine, solver: str = solver, name: str = name, shape: str = shape, law: str = law) -> Outcome:
            stated = problem(name, shape, law)
            return compare(engine.equilibrium(stated).displacement_m, references.read(solver, name, shape, law, stated))

        yield Case(
            GROUP,
            shape,
            law,
            name if solver != "calculix" else f"{name}, CalculiX",
            "largest displacement [m]",
            references.source(solver),
            CALCULIX_BOUNDS if solver == "calculix" else FE_BOUNDS,
            run,
            quick=law in ("hooke", "neo_hookean") and name == "cantilever" and solver != "calculix",
        )


def compare(ours: Floats, theirs: Floats) -> Outcome:
    size = float(np.linalg.norm(theirs, axis=1).max())
    difference = float(np.linalg.norm(ours - theirs, axis=1).max())
    return Outcome(float(np.linalg.norm(ours, axis=1).max()), size, difference / size)
