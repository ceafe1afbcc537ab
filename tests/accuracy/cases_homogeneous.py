"""States of constant strain, for every law in every shape: patch test, rigid rotation, pulling, shearing, fibres."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from tensormass.v1 import scene_pb2

from .case import Case, Group, Outcome, relative
from .engine import Engine, state
from .laws import IDENTITY, LAWS, Law, lame, transversely_isotropic
from .meshes import MESHES, SHAPES, Floats, Mesh, box, shaken
from .problem import Prescribed, Problem

PATCH = Group(
    "patch",
    "Patch test and rigid rotation",
    "A unit cube whose inner nodes are moved by up to 0.2 of a cell. *Patch*: the boundary is displaced affinely "
    "(strains up to 15 %); inside, the displacement must be the same affine map. Value: the largest displacement. "
    "Error: the largest difference at any node, relative to the largest displacement. *Rotation*: the boundary is "
    "rotated rigidly by 60°. Value: the largest force on any node over E times the area of a cell's face. It must be "
    "zero, except for the linear law, which makes no such claim.",
)
WORK = Group(
    "work",
    "Energy and force",
    "A unit cube whose inner nodes are moved by up to 0.2 of a cell. A quadratic field (strains up to 20 %) displaces "
    "its boundary and is varied by 0.01 % to either side. Value: the change of the elastic energy by central "
    "difference. Reference: the work of the reaction forces. Error: relative. (tests/physics compares energy, force "
    "and stiffness of every pair by finite differences.)",
)
CURVES = Group(
    "curves",
    "Pulling and shearing",
    "A cube, pulled to 1.4 and pressed to 0.85 of its length with free sides, and sheared to γ = 0.6 with its "
    "whole boundary prescribed, in four steps each. Reference: closed form of each law in principal stretches or by "
    "components (laws.py); the stretch of the free sides is the root of one scalar equation. Value: nominal stress "
    "at the end from the reaction forces (pulling: axial, in the longest state; shearing: P12). Error: the largest of "
    "all states relative to the largest stress; in shear also of all components of P and of the Cauchy stress, of the "
    "von Mises stress and of det F.",
)
FIBRES = Group(
    "fibres",
    "Fibre anisotropy",
    "Uniaxial strain of 20 % along x in the whole cube, fibres along x, across it, or at 30°. Reference: closed "
    "form, S = λ tr E I + 2 μ E + k (a₀·E a₀) a₀ ⊗ a₀ (E: Green strain, k: fibre modulus, a₀: fibre direction at "
    "rest). Value: P11. Error: the largest of P11, P12, P21, P22, relative to the largest of them.",
)

CURVE_BOUNDS = {"double": 1e-9, "float": 1e-4}
CUBE_M = 0.1
STEPS = 4
PULLED = 1.4
# Stiff fibres buckle when the stress along them nears the shear modulus of the tissue; at 0.75 some meshes do.
PRESSED = 0.85


def _cells(mesh: str, across: int) -> tuple[int, int, int]:
    return (5 if mesh == "mixed" else across, across, across)


def _prescribed_boundary(mesh: Mesh, law: Law, f: Floats, quadrature: scene_pb2.Quadrature, increments: int) -> Problem:
    boundary = mesh.boundary()
    condition = Prescribed(boundary, mesh.nodes[boundary] @ (f - IDENTITY).T)
    return Problem(mesh, law, [condition], quadrature=quadrature, increments=increments)


def nominal_stress(mesh: Mesh, reaction_n: Floats, volume_m3: float) -> Floats:
    """Mean first Piola-Kirchhoff stress in equilibrium without body forces: Σ r_k ⊗ X_k over the volume."""
    return np.einsum("ki,kj->ij", reaction_n, mesh.nodes) / volume_m3


def homogeneous_cases() -> Iterator[Case]:
    yield from _patch_cases()
    yield from _work_cases()
    yield from _curve_cases()
    yield from _fibre_cases()


def _patch_cases() -> Iterator[Case]:
    affine = IDENTITY + np.array([[0.10, 0.05, -0.02], [0.03, -0.08, 0.04], [-0.02, 0.06, 0.07]])
    angle = np.pi / 3
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])

    def mesh_of(shape: str) -> Mesh:
        cells = _cells(shape, 3)
        return box(shape, cells, place=shaken(7, 0.2, cells))

    for shape in MESHES:
        for law in LAWS:
            for selective in (False, True):
                if selective and law != "neo_hookean":
                    continue

                def patch(engine: Engine, shape: str = shape, law: str = law, selective: bool = selective) -> Outcome:
                    mesh = mesh_of(shape)
                    quadrature = scene_pb2.QUADRATURE_SELECTIVE if selective else scene_pb2.QUADRATURE_FULL
                    u = engine.equilibrium(_prescribed_boundary(mesh, LAWS[law], affine, quadrature, 2)).displacement_m
                    exact = mesh.nodes @ (affine - IDENTITY).T
                    size = np.abs(exact).max()
                    return Outcome(float(np.abs(u).max()), float(size), float(np.abs(u - exact).max() / size))

                yield Case(
                    PATCH,
                    shape,
                    law,
                    "patch, selective" if selective else "patch",
                    "largest displacement [m]",
                    "the affine map",
                    {"double": 1e-10, "float": 1e-5},
                    patch,
                    quick=law == "mooney_rivlin",
                )
            if law == "hooke":
                continue

            def rotate(engine: Engine, shape: str = shape, law: str = law) -> Outcome:
                mesh = mesh_of(shape)
                found = engine.equilibrium(
                    _prescribed_boundary(mesh, LAWS[law], rotation, scene_pb2.QUADRATURE_FULL, 4)
                )
                force = float(np.abs(found.reaction_n).max()) / (5000 / 9)
                return Outcome(force, 0.0, force)

            yield Case(
                PATCH, shape, law, "rotation", "force / (E h²)", "zero", {"double": 1e-10, "float": 1e-5}, rotate
            )


def _work_cases() -> Iterator[Case]:
    step = 1e-4

    def run(engine: Engine, shape: str, law: str) -> Outcome:
        cells = _cells(shape, 3)
        mesh = box(shape, cells, place=shaken(7, 0.2, cells))
        boundary = mesh.boundary()
        x, y, z = mesh.nodes[boundary].T
        moved = 0.1 * np.stack([x * y, y * z - x**2 / 2, x * z + y**2 / 2], axis=1)
        scene = engine.scene(Problem(mesh, LAWS[law], [Prescribed(boundary, moved)]))
        for condition in scene.bodies[0].prescribed:
            condition.schedule.time_s.extend([1, 2, 3])
            condition.schedule.factor.extend([1 - step, 1, 1 + step])
        found = []
        with engine.loaded(scene) as handle:
            for _ in range(3):
                handle.step()
                found.append(state(handle))
        growth = (found[2].elastic_energy_j - found[0].elastic_energy_j) / (2 * step)
        work = float((found[1].reaction_n[boundary] * moved).sum())
        return Outcome(growth, work, relative(growth, work))

    for shape in MESHES:
        for law in LAWS:

            def compare(engine: Engine, shape: str = shape, law: str = law) -> Outcome:
                return run(engine, shape, law)

            source = "work of the reactions"
            yield Case(WORK, shape, law, "growth", "dW/dt [J]", source, {"double": 1e-8}, compare)


def pulled(mesh: Mesh, law: Law, stretch: float) -> Problem:
    """A cube on three planes of symmetry, with its end at x = CUBE_M moved."""
    far = CUBE_M * (1 - 1e-6)
    planes = [np.flatnonzero(mesh.nodes[:, axis] < 1e-9) for axis in range(3)]
    prescribed = [Prescribed(nodes, np.where(IDENTITY[axis] == 1, 0, np.nan)) for axis, nodes in enumerate(planes)]
    end = mesh.where(lambda x, y, z: x > far)
    prescribed.append(Prescribed(end, np.array([CUBE_M * (stretch - 1), np.nan, np.nan])))
    return Problem(mesh, law, prescribed, increments=STEPS)


def free_sides_stretch(law: Law, stretch: float) -> float:
    """The stretch of the sides that makes their stress zero, by bisection."""
    low, high = 0.6, 1.6
    for _ in range(60):  # enough for all digits of a double
        side = (low + high) / 2
        low, high = (low, side) if law.pull(np.array([stretch, side, side]))[1] > 0 else (side, high)
    return side


def free_sides_stress(law: Law, stretch: float) -> float:
    """Nominal stress along x with sides free of stress."""
    side = free_sides_stretch(law, stretch)
    return float(law.pull(np.array([stretch, side, side]))[0])


def _curve_cases() -> Iterator[Case]:
    def pull(engine: Engine, shape: str, law: str) -> Outcome:
        mesh = box(shape, _cells(shape, 1), (CUBE_M,) * 3)
        end = mesh.where(lambda x, y, z: x > CUBE_M * (1 - 1e-6))
        ours, exact = [], []
        for stretch in (PRESSED, PULLED):
            for step, found in enumerate(engine.states(pulled(mesh, LAWS[law], stretch)), 1):
                ours.append(float(found.reaction_n[end, 0].sum()) / CUBE_M**2)
                exact.append(free_sides_stress(LAWS[law], 1 + (stretch - 1) * step / STEPS))
        error = np.abs(np.subtract(ours, exact)).max() / np.abs(exact).max()
        return Outcome(ours[-1], exact[-1], float(error))

    def shear(engine: Engine, shape: str, law: str) -> Outcome:
        gamma = 0.6
        mesh = box(shape, _cells(shape, 2), (CUBE_M,) * 3)
        f = IDENTITY + gamma * np.outer(IDENTITY[0], IDENTITY[1])
        problem = _prescribed_boundary(mesh, LAWS[law], f, scene_pb2.QUADRATURE_FULL, STEPS)
        errors, sizes, last = [], [], (0.0, 0.0)
        for step, found in enumerate(engine.states(problem), 1):
            g = gamma * step / STEPS
            p11, p12, _, p22, p33 = exact = LAWS[law].shear(g)
            ours = nominal_stress(mesh, found.reaction_n, CUBE_M**3)
            errors.append(np.abs(ours[[0, 0, 1, 1, 2], [0, 1, 0, 1, 2]] - exact).max())
            if law != "hooke":  # σ = P Fᵀ, J = 1; xx yy zz yz xz xy
                cauchy = np.array([p11 + g * p12, p22, p33, 0, 0, p12])
                errors.append(np.abs(found.cauchy_pa - cauchy).max())
                deviator = np.diag(cauchy[:3] - cauchy[:3].mean()) + p12 * np.array([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
                errors.append(np.abs(found.von_mises_pa - np.sqrt(1.5 * (deviator**2).sum())).max())
            sizes.append(np.abs(exact).max())
            errors.append(np.abs(found.det_f - 1).max() * sizes[-1])
            last = float(ours[0, 1]), float(p12)
        return Outcome(*last, float(max(errors) / max(sizes)))

    for shape in MESHES:
        for law in LAWS:
            for name, quantity, solve in (("pulling", "P11 [Pa]", pull), ("shearing", "P12 [Pa]", shear)):
                run = partial(solve, shape=shape, law=law)
                quick = shape == "hexahedron"
                yield Case(CURVES, shape, law, name, quantity, "closed form", CURVE_BOUNDS, run, quick)


def _fibre_cases() -> Iterator[Case]:
    young_pa, nu, fibre_pa, stretch = 5000.0, 0.35, 8000.0, 1.2
    lam, mu = lame(young_pa, nu)

    def run(engine: Engine, shape: str, angle_deg: float, by_element: bool) -> Outcome:
        mesh = box(shape, _cells(shape, 2), (CUBE_M,) * 3)
        angle = np.radians(angle_deg)
        a = np.array([np.cos(angle), np.sin(angle), 0])
        law = transversely_isotropic(young_pa, nu, fibre_pa, (0, 0, 1) if by_element else tuple(a))
        f = IDENTITY + (stretch - 1) * np.outer(IDENTITY[0], IDENTITY[0])
        scene = engine.scene(_prescribed_boundary(mesh, law, f, scene_pb2.QUADRATURE_FULL, 1))
        if by_element:
            count = sum(len(elements) for _, elements in mesh.blocks)
            # Three times the unit vector: the server normalizes.
            scene.bodies[0].element_fields.fibre_directions = np.tile(3 * a, (count, 1)).astype("<f8").tobytes()
        with engine.loaded(scene) as handle:
            handle.step()
            ours = nominal_stress(mesh, state(handle).reaction_n, CUBE_M**3)
        strain = (stretch**2 - 1) / 2
        tension = fibre_pa * a[0] ** 2 * strain
        s11 = (lam + 2 * mu) * strain + tension * a[0] ** 2
        s12, s22 = tension * a[0] * a[1], lam * strain + tension * a[1] ** 2
        exact = np.array([stretch * s11, stretch * s12, s12, s22])
        error = np.abs(ours[[0, 0, 1, 1], [0, 1, 0, 1]] - exact).max() / np.abs(exact).max()
        return Outcome(float(ours[0, 0]), float(exact[0]), float(error))

    for shape in SHAPES:
        for name, angle_deg, by_element in (
            ("along", 0, False),
            ("across", 90, False),
            ("at 30°", 30, False),
            ("at 30°, given by element", 30, True),
        ):

            def solve(
                engine: Engine, shape: str = shape, angle_deg: float = angle_deg, by_element: bool = by_element
            ) -> Outcome:
                return run(engine, shape, angle_deg, by_element)

            quick = shape == "tetrahedron"
            law = "transversely_isotropic"
            yield Case(FIBRES, shape, law, name, "P11 [Pa]", "closed form", CURVE_BOUNDS, solve, quick)
