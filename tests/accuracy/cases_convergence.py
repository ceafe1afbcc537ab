"""Convergence under refinement: a manufactured solution, Cook's membrane, the thick sphere under pressure."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np

from tensormass.v1 import scene_pb2

from . import cook_reference, numpy_fem, references
from .case import Case, Group, Outcome, relative
from .engine import Engine
from .laws import LAWS, Law, hooke, lame, neo_hookean
from .meshes import SHAPES, Floats, Mesh, box, sphere_octant
from .problem import Prescribed, Pressure, Problem, Traction

MANUFACTURED = Group(
    "manufactured",
    "Manufactured solution",
    "Unit cube, zero on the boundary, u = (1, 2, −1) mm · sin πx sin πy sin πz under the matching body force. "
    "Value: the order at which the L2 error falls with the last halving of the cells. It must be p + 1 for shapes of "
    "order p. Error: the difference of the two.",
)
COOK = Group(
    "cook",
    "Cook's membrane",
    "The panel (0, 0), (48, 44), (48, 60), (0, 44), clamped at the left, with a shearing force on the right. One "
    "layer of cells of thickness 1 lies on a plane of symmetry (plane stress) or between two (plane strain). Three "
    "variants: plane stress E = 1, ν = 1/3, F = 1, displacement at (48, 52), literature 23.91 to 23.96; "
    "finite strain, E = 200, ν = 0.35, traction 4, at (48, 60), literature 6.1468; nearly incompressible, E = 250, "
    "ν = 0.4999, F = 100, at (48, 60), literature 7.771. Reference: the same panel in two dimensions with "
    "quadrilaterals of order 4, refined towards the corner of infinite stress. Value: on the finest mesh. Error: "
    "relative; it is a discretization error, not one of the solver. Nearly incompressible, linear shapes lock under "
    "full quadrature, and no claim is made there.",
)
SPHERE = Group(
    "sphere",
    "Thick sphere under inner pressure",
    "An octant of a sphere from r = 1 m to r = 2 m on three planes of symmetry, under a follower pressure of a "
    "ten-thousandth of the bulk stiffness. Reference: Lamé 1852, small strain. Value: mean displacement of the "
    "inner surface on the finest mesh. Error: relative; it is a discretization error.",
)

# By order of the shape: cells along an edge, halved from one mesh to the next.
SERIES = {1: (4, 8, 16), 2: (2, 4, 8)}
COOK_SERIES = {1: (8, 16, 32), 2: (4, 8, 16)}
# On the finest mesh. Triangles of constant strain converge slowest, and a wedge is one in this plane.
COOK_BOUNDS = {
    "tetrahedron": 0.06,
    "pyramid": 0.02,
    "wedge": 0.06,
    "hexahedron": 0.02,
    "quadratic_tetrahedron": 0.01,
    "quadratic_hexahedron": 0.01,
}
NEARLY_INCOMPRESSIBLE_BOUNDS = {
    ("tetrahedron", "selective"): 0.02,
    ("pyramid", "selective"): 0.05,
    ("wedge", "selective"): 0.04,
    ("wedge", "selective, axis in the plane"): 0.02,
    ("hexahedron", "selective"): 0.02,
    ("quadratic_tetrahedron", "full"): 0.05,
    ("quadratic_tetrahedron", "selective"): 0.02,
    ("quadratic_hexahedron", "full"): 0.05,
    ("quadratic_hexahedron", "selective"): 0.02,
}
SPHERE_BOUNDS = {1: 0.03, 2: 0.003}


def convergence_cases() -> Iterator[Case]:
    yield from _manufactured_cases()
    yield from _cook_cases()
    yield from _sphere_cases()


def _manufactured_cases() -> Iterator[Case]:
    young_pa, nu = 5000.0, 0.3
    lam, mu = lame(young_pa, nu)
    amplitude = np.array([1, 2, -1]) * 1e-3

    def exact(x: Floats) -> Floats:
        return np.sin(np.pi * x).prod(axis=-1)[..., None] * amplitude

    def body_force(x: Floats) -> Floats:
        """−div σ = −μ ∆u − (λ + μ) ∇ div u."""
        sin, cos = np.sin(np.pi * x), np.cos(np.pi * x)
        laplacian = -3 * np.pi**2 * exact(x)
        second = np.empty((*x.shape, 3))
        for i in range(3):
            for j in range(3):
                factors = sin.copy()
                if i == j:
                    factors[..., i] *= -1
                else:
                    factors[..., [i, j]] = cos[..., [i, j]]
                second[..., i, j] = np.pi**2 * factors.prod(axis=-1)
        return -mu * laplacian - (lam + mu) * second @ amplitude

    def run(engine: Engine, shape: str) -> Outcome:
        order = SHAPES[shape].order
        errors = []
        for count in SERIES[order]:
            mesh = box(shape, (count,) * 3)
            forces = numpy_fem.consistent_forces(mesh, body_force)
            boundary = mesh.boundary()
            forces[boundary] = 0
            problem = Problem(mesh, hooke(young_pa, nu), [Prescribed(boundary, np.zeros(3))], forces_n=forces)
            u = engine.equilibrium(problem).displacement_m
            errors.append(numpy_fem.l2_norm(mesh, exact, u) / numpy_fem.l2_norm(mesh, exact))
        orders = [float(np.log2(coarse / fine)) for coarse, fine in itertools.pairwise(errors)]
        details = tuple(
            (f"{count}³ cells", value, error)
            for count, value, error in zip(SERIES[order], [float("nan"), *orders], errors, strict=True)
        )
        return Outcome(orders[-1], order + 1, abs(orders[-1] - order - 1), details)

    for shape in SHAPES:
        yield Case(
            MANUFACTURED,
            shape,
            "hooke",
            "sine field",
            "order in L2",
            "p + 1",
            {"double": 0.15 if SHAPES[shape].order == 1 else 0.2},  # coarser meshes
            partial(run, shape=shape),
        )


def _cook_mesh(shape: str, count: int, turned: bool) -> Mesh:
    """turned: the third axis of the cells, along which wedges are extruded, lies in the membrane's plane."""
    if not turned:
        return box(shape, (count, count, 1), place=cook_reference.place)
    return box(shape, (count, 1, count), place=lambda nodes: cook_reference.place(nodes[:, [2, 0, 1]]))


def _cook_choices(shape: str) -> Iterator[tuple[str, scene_pb2.Quadrature, bool]]:
    """Yields name, quadrature, and whether the cells are turned."""
    yield "full", scene_pb2.QUADRATURE_FULL, False
    yield "selective", scene_pb2.QUADRATURE_SELECTIVE, False
    if shape == "wedge":
        yield "selective, axis in the plane", scene_pb2.QUADRATURE_SELECTIVE, True


def _cook(engine: Engine, name: str, shape: str, quadrature: scene_pb2.Quadrature, turned: bool) -> Outcome:
    variant, exact = cook_reference.VARIANTS[name], references.numbers("cook")[name]
    law = {"hooke": hooke, "neo_hookean": neo_hookean}[variant.law](variant.young_modulus_pa, variant.poisson_ratio)
    details = []
    for count in COOK_SERIES[SHAPES[shape].order]:
        mesh = _cook_mesh(shape, count, turned)
        flat = mesh.where(lambda x, y, z: z < 1e-9) if variant.plane_stress else np.arange(len(mesh.nodes))
        left = mesh.where(lambda x, y, z: x < 1e-9)
        right = mesh.where(lambda x, y, z: x > 48 - 1e-6)
        prescribed = [Prescribed(flat, np.array([np.nan, np.nan, 0])), Prescribed(left, np.array([0, 0, np.nan]))]
        load = Traction(right, (0, variant.force / cook_reference.HEIGHT, 0))
        u = engine.equilibrium(Problem(mesh, law, prescribed, [load], quadrature=quadrature)).displacement_m
        at = mesh.where(lambda x, y, z: (abs(x - variant.at[0]) < 1e-6) & (abs(y - variant.at[1]) < 1e-6))
        value = float(u[at, 1].mean())
        details.append((f"{count} × {count}", value, relative(value, exact)))
    _, value, error = details[-1]
    return Outcome(value, exact, error, tuple(details))


def _cook_cases() -> Iterator[Case]:
    for name, variant in cook_reference.VARIANTS.items():
        for shape in SHAPES:
            for choice, quadrature, turned in _cook_choices(shape):
                bound: float | None = COOK_BOUNDS[shape]
                if variant.poisson_ratio > 0.49:
                    bound = NEARLY_INCOMPRESSIBLE_BOUNDS.get((shape, choice))

                def run(
                    engine: Engine,
                    name: str = name,
                    shape: str = shape,
                    quadrature: scene_pb2.Quadrature = quadrature,
                    turned: bool = turned,
                ) -> Outcome:
                    return _cook(engine, name, shape, quadrature, turned)

                yield Case(
                    COOK,
                    shape,
                    variant.law,
                    f"{name}, {choice}",
                    "u_y",
                    references.source("cook"),
                    {"double": bound},
                    run,
                )


def small_strain_lame(law: Law) -> tuple[float, float]:
    """λ and μ [Pa] of an isotropic law at rest, by central differences of its stresses in principal stretches."""
    step = 1e-5
    slope = (law.pull(np.array([1 + step, 1, 1])) - law.pull(np.array([1 - step, 1, 1]))) / (2 * step)
    return float(slope[1]), float((slope[0] - slope[1]) / 2)


def _sphere_cases() -> Iterator[Case]:
    inner, outer = 1.0, 2.0

    def run(engine: Engine, shape: str, law: Law) -> Outcome:
        lam, mu = small_strain_lame(law)
        bulk = lam + 2 * mu / 3
        pressure = 1e-4 * bulk
        # u = A r + B / r², from σ_r(inner) = −p and σ_r(outer) = 0.
        a = pressure * inner**3 / (outer**3 - inner**3) / (3 * bulk)
        b = pressure * inner**3 * outer**3 / (outer**3 - inner**3) / (4 * mu)
        exact = a * inner + b / inner**2
        details = []
        for count in SERIES[SHAPES[shape].order]:
            mesh = sphere_octant(shape, max(count // 2, 1), count // 2 or 1, inner, outer)
            radius = np.linalg.norm(mesh.nodes, axis=1)
            inside = np.flatnonzero(radius < inner * 1.001)
            prescribed = [
                Prescribed(np.flatnonzero(mesh.nodes[:, i] < 1e-9), np.where(np.arange(3) == i, 0, np.nan))
                for i in range(3)
            ]
            u = engine.equilibrium(
                Problem(mesh, law, prescribed, pressures=[Pressure(inside, pressure)])
            ).displacement_m
            value = float(np.einsum("ki,ki->k", u, mesh.nodes)[inside].mean() / inner)
            details.append((f"{len(mesh.nodes)} nodes", value, relative(value, exact)))
        _, value, error = details[-1]
        return Outcome(value, exact, error, tuple(details))

    for shape in SHAPES:
        for law, entry in LAWS.items():
            if entry.directed or (law != "hooke" and shape != "hexahedron"):
                continue
            yield Case(
                SPHERE,
                shape,
                law,
                "inner pressure",
                "displacement [m]",
                "Lamé 1852",
                dict.fromkeys(("double", "float"), SPHERE_BOUNDS[SHAPES[shape].order]),
                partial(run, shape=shape, law=entry),
            )
