"""A rigid sphere pressed into tissue without friction, by scikit-fem's elements and Newton's method with multipliers.

It shares no code with the server: contact acts at the nodes of the top (Simpson's rule), and augmented Lagrangian steps
(Alart, Curnier 1991) remove the penetration that a penalty alone leaves.

    u       displacements of the nodes [m]
    F       deformation gradient; P: first Piola-Kirchhoff stress [Pa]
    depth   radius − distance from the sphere's centre to a quadrature point [m]
    k       augmentation [Pa/m]
    λ       contact pressure of a quadrature point at rest area [Pa], max(0, λ + k depth) after each step
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from . import numpy_fem, skfem_fem
from .half_ball import growing
from .laws import IDENTITY, Law, hooke, stable_neo_hookean
from .meshes import Floats, Integers
from .sphere_contact import DEEP, HERTZ

if TYPE_CHECKING:
    import scipy.sparse
    import skfem

#: Names of the answers, and what is added for a coarser mesh.
DEEP_PRESS, HALF_BALL, COARSER = "deep press", "half ball", ", coarser mesh"
#: Newton's method ends at this residual, relative to the force on the sphere.
TOLERANCE = 1e-7
#: The same on the way to a depth.
LOOSE = 0.03
#: Augmentations end when the force changes by less, relative.
FORCE_TOLERANCE = 1e-5
MOST_AUGMENTATIONS = 30
MOST_ITERATIONS = 40
#: Steps on the way to each depth.
STEPS = 8


@dataclass(frozen=True)
class Tissue:
    """A discretized body.

    dofs: unknowns of each element, [element, m]. slopes: derivative of F by them, [element, point, m, 9].
    weights: [element, point] m³. free: unknowns that may move. touching: unknowns at each surface point, by component,
    [point, component, k]; values: their shape functions, [point, k]; areas: [point] m²; places: [point, component] m.
    """

    law: Law
    dofs: Integers
    slopes: Floats
    weights: Floats
    free: Integers
    touching: Integers
    values: Floats
    areas: Floats
    places: Floats
    unknown_count: int

    def system(self, u: Floats) -> tuple[Floats, scipy.sparse.csc_matrix]:
        """Internal forces and their derivative."""
        f = IDENTITY + np.einsum("eqma,em->eqa", self.slopes, u[self.dofs]).reshape(*self.weights.shape, 3, 3)
        stress = self.law.stress(f).reshape(*self.weights.shape, 9)
        forces = np.einsum("eqma,eqa->em", self.slopes, self.weights[..., None] * stress)
        moduli = numpy_fem.tangent(self.law.stress, f).reshape(*self.weights.shape, 9, 9)
        moved = np.matmul(self.slopes, self.weights[..., None, None] * moduli)
        stiffness = np.matmul(
            moved.transpose(0, 2, 1, 3).reshape(len(self.dofs), self.dofs.shape[1], -1),
            self.slopes.transpose(0, 1, 3, 2).reshape(len(self.dofs), -1, self.dofs.shape[1]),
        )
        inner = np.bincount(self.dofs.ravel(), forces.ravel(), self.unknown_count)
        return inner.astype(np.float64, copy=False), _sum_blocks(self.dofs, stiffness, self.unknown_count)


def _sum_blocks(dofs: Integers, blocks: Floats, count: int) -> scipy.sparse.csc_matrix:
    import scipy.sparse

    rows = np.repeat(dofs, dofs.shape[1], axis=1).ravel()
    columns = np.tile(dofs, (1, dofs.shape[1])).ravel()
    return scipy.sparse.csc_matrix((blocks.ravel(), (rows, columns)), shape=(count, count))


def available() -> bool:
    return skfem_fem.available()


def source() -> str:
    return f"{skfem_fem.source()}, augmented Lagrangian"


def press(tissue: Tissue, radius_m: float, depths_m: Sequence[float], augmentation_pa_per_m: float) -> Floats:
    """Forces on a sphere that is pressed into the top, which is at height 0 of the last axis, by depth [N].

    Raises:
        ArithmeticError: Newton's method or the augmentation did not converge.
    """
    state = _State(np.zeros(tissue.unknown_count), np.zeros(len(tissue.areas)))
    forces, last_m = [], 0.0
    for depth_m in depths_m:
        for step_m in np.linspace(last_m, depth_m, STEPS + 1)[1:]:
            centre = np.zeros(tissue.places.shape[1])
            centre[-1] = radius_m - step_m
            guess = state.moved * (step_m / last_m if last_m > 0 else 1.0)
            start = replace(state, moved=guess)
            state = _equilibrium(tissue, start, centre, radius_m, augmentation_pa_per_m, LOOSE)
            last_m = float(step_m)
        for _ in range(MOST_AUGMENTATIONS):
            before = state
            state = _equilibrium(tissue, state, centre, radius_m, augmentation_pa_per_m, TOLERANCE)
            if abs(state.force_n - before.force_n) <= FORCE_TOLERANCE * state.force_n:
                break
        else:
            raise ArithmeticError(f"the augmentation did not converge at {depth_m} m")
        forces.append(state.force_n)
    return np.array(forces)


@dataclass(frozen=True)
class _State:
    """moved: u. pressures: λ after the step."""

    moved: Floats
    pressures: Floats
    force_n: float = 0.0


def _equilibrium(tissue: Tissue, start: _State, centre: Floats, radius_m: float, k: float, tolerance: float) -> _State:
    """Solves for given multipliers, and updates them."""
    import scipy.sparse.linalg

    eye = np.eye(len(centre))

    def contact(u: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Distances, normals, pressures and forces of the surface points."""
        away = tissue.places + np.einsum("pk,pik->pi", tissue.values, u[tissue.touching]) - centre
        distance = np.linalg.norm(away, axis=1)
        normal = away / distance[:, None]
        pressure = np.maximum(start.pressures + k * (radius_m - distance), 0)
        return distance, normal, pressure, (tissue.areas * pressure)[:, None] * normal

    def residual(u: Floats) -> tuple[Floats, scipy.sparse.csc_matrix]:
        push = contact(u)[3]
        outer = np.bincount(
            tissue.touching.ravel(), (push[:, :, None] * tissue.values[:, None, :]).ravel(), tissue.unknown_count
        )
        inner, matrix = tissue.system(u)
        return (outer - inner)[tissue.free], matrix

    u = start.moved
    rest, matrix = residual(u)
    for _ in range(MOST_ITERATIONS):
        distance, normal, pressure, push = contact(u)
        force_n = -float(push[:, -1].sum())
        if force_n > 0 and np.linalg.norm(rest) <= tolerance * force_n:
            return _State(u, pressure, force_n)
        at = np.flatnonzero(pressure > 0)
        across = eye - normal[at, :, None] * normal[at, None, :]
        block = k * normal[at, :, None] * normal[at, None, :] - (pressure / distance)[at, None, None] * across
        weighted = np.einsum("p,pij,pk,pl->pikjl", tissue.areas[at], block, tissue.values[at], tissue.values[at])
        size = tissue.touching.shape[1] * tissue.touching.shape[2]
        matrix = matrix + _sum_blocks(
            tissue.touching[at].reshape(-1, size), weighted.reshape(-1, size, size), tissue.unknown_count
        )
        solver = scipy.sparse.linalg.splu(
            matrix[tissue.free][:, tissue.free],
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )
        change = np.zeros_like(u)
        change[tissue.free] = solver.solve(rest)
        size_before = np.linalg.norm(rest)
        for share in (1, 0.5, 0.25, 0.125):
            rest, matrix = residual(u + share * change)
            if np.linalg.norm(rest) < size_before:
                break
        u = u + share * change
    raise ArithmeticError(f"Newton's method did not converge: residual {np.linalg.norm(rest):.1e} N")


def _tissue(
    law: Law,
    mesh: skfem.Mesh,
    element: skfem.Element,
    order: int,
    free: Callable[[Floats], np.ndarray],
    gradient: Callable[[Floats, Floats, Floats], Floats],
    scale: Callable[[Floats], Floats],
) -> Tissue:
    """Discretizes a body whose facets "top" may touch the sphere.

    free: positions of nodes [component, node] to a mask [component, node]; called once.
    gradient: values and slopes of a shape function and positions [component, ...] to the derivative of F by each
        component of the displacement, [component, ..., 9]; called once a shape function.
    scale: positions [component, ...] to the factor of a volume or an area, as 2πr of a ring.
    """
    import skfem

    inside = skfem.Basis(mesh, element, intorder=order)
    dimension = mesh.dim()
    top = skfem.FacetBasis(mesh, element, facets="top", quadrature=_at_nodes(dimension - 1, order > 3))
    places = inside.global_coordinates().value
    slopes = np.stack(
        [gradient(field[0].value, field[0].grad, places) for field in inside.basis], axis=0
    )  # [k, component, element, point, 9]
    slopes = slopes.transpose(2, 3, 0, 1, 4).reshape(*places.shape[1:], -1, 9)
    numbers = dimension * inside.element_dofs.T[:, :, None] + np.arange(dimension)
    at = top.global_coordinates().value
    values = np.stack([np.broadcast_to(field[0].value, at.shape[1:]) for field in top.basis], axis=-1)
    on_top = dimension * top.element_dofs.T[:, None, :] + np.arange(dimension)[:, None]
    touching = np.repeat(on_top[:, None], at.shape[2], axis=1)
    return Tissue(
        law=law,
        dofs=numbers.reshape(len(numbers), -1),
        slopes=slopes,
        weights=inside.dx * scale(places),
        free=np.flatnonzero(free(inside.doflocs).T.ravel()),
        touching=touching.reshape(-1, *touching.shape[2:]),
        values=values.reshape(-1, values.shape[2]),
        areas=(top.dx * scale(at)).ravel(),
        places=at.reshape(dimension, -1).T,
        unknown_count=dimension * inside.N,
    )


def _at_nodes(dimension: int, quadratic: bool) -> tuple[Floats, Floats]:
    """Simpson's rule on [0, 1]^dimension, or the trapezoidal rule: points [dimension, point] and weights."""
    points, weights = np.array([0.0, 1]), np.array([0.5, 0.5])
    if quadratic:
        points, weights = np.array([0, 0.5, 1]), np.array([1, 4, 1]) / 6
    grid = np.stack(np.meshgrid(*[points] * dimension, indexing="ij")).reshape(dimension, -1)
    shares = np.stack(np.meshgrid(*[weights] * dimension, indexing="ij")).reshape(dimension, -1)
    return grid, shares.prod(axis=0)


def graded(cells: int, fine_cells: int, fine_m: float, length_m: float) -> Floats:
    """Coordinates from 0 to length_m: `fine_cells` equal cells up to fine_m, then cells that grow evenly."""
    size, rest = fine_m / fine_cells, cells - fine_cells
    low, high = 1.0, 10.0
    for _ in range(100):
        ratio = (low + high) / 2
        low, high = (
            (ratio, high) if fine_m + size * sum(ratio**i for i in range(1, rest + 1)) < length_m else (low, ratio)
        )
    steps = [size] * fine_cells + [size * low**i for i in range(1, rest + 1)]
    out = np.concatenate([[0], np.cumsum(steps)])
    out[-1] = length_m
    return out


def block_quarter(law: Law, x_m: Floats, z_m: Floats, quadratic: bool = True) -> Tissue:
    """A quarter of a block with its bottom fixed, in hexahedra of 27 nodes or of 8, on two planes of symmetry.

    x_m: coordinates of the grid from the axis to a side. z_m: depths of the grid below the top, which is at 0.
    """
    import skfem

    bottom = float(z_m[-1])
    mesh = skfem.MeshHex.init_tensor(x_m, x_m, -z_m[::-1]).with_boundaries({"top": lambda x: x[2] > -1e-9})

    def free(x: Floats) -> np.ndarray:
        above = x[2] > -bottom + 1e-9
        return np.array([above & (x[0] > 1e-9), above & (x[1] > 1e-9), above])

    def gradient(_: Floats, slope: Floats, places: Floats) -> Floats:
        out = np.zeros((3, *places.shape[1:], 3, 3))
        for i in range(3):
            out[i, ..., i, :] = np.moveaxis(slope, 0, -1)
        return out.reshape(*out.shape[:-2], 9)

    element, order = (skfem.ElementHex2(), 5) if quadratic else (skfem.ElementHex1(), 3)
    return _tissue(law, mesh, element, order, free, gradient, lambda x: np.ones(x.shape[1:]))


def half_ball_section(law: Law, cells: int, layers: int, inner_m: float, outer_m: float) -> Tissue:
    """A half ball of tissue with its round side fixed, as a section (r, z) that turns about z, in quadrilaterals of 9
    nodes.

    cells: cells along a side of a square of inner_m under the contact. layers: layers of cells around the square.
    """
    import skfem

    line = np.linspace(0, inner_m, cells + 1)
    square = skfem.MeshQuad.init_tensor(line, -line[::-1])
    # From the top of the square's outer side along its perimeter to the axis.
    rim = np.array([[inner_m, -x] for x in line] + [[x, -inner_m] for x in line[-2::-1]])
    angle = np.linspace(0, np.pi / 2, len(rim))
    far = outer_m * np.column_stack([np.cos(angle), -np.sin(angle)])
    out = growing(layers, inner_m / cells / (outer_m - inner_m))
    points = (rim[:, None] + out[:, None] * (far - rim)[:, None]).reshape(-1, 2)
    index = np.arange(len(points)).reshape(len(rim), -1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]).reshape(4, -1)
    mesh = square + skfem.MeshQuad(points.T, quads)
    return _section(law, mesh, lambda x: np.hypot(*x) > outer_m * (1 - 0.2 / len(rim) ** 2))


def cylinder_section(law: Law, r_m: Floats, z_m: Floats) -> Tissue:
    """The same for a cylinder with its bottom fixed. r_m, z_m: as x_m and z_m of block_quarter."""
    import skfem

    mesh = skfem.MeshQuad.init_tensor(r_m, -z_m[::-1])
    return _section(law, mesh, lambda x: x[1] < -z_m[-1] + 1e-9)


def _section(law: Law, mesh: skfem.Mesh, fixed: Callable[[Floats], np.ndarray]) -> Tissue:
    """fixed: positions (r, z) of nodes to a mask; called once."""
    import skfem

    size_m = float(np.abs(mesh.p).max())
    mesh = mesh.with_boundaries({"top": lambda x: x[1] > -1e-9 * size_m})

    def free(x: Floats) -> np.ndarray:
        return np.array([~fixed(x) & (x[0] > 1e-9 * size_m), ~fixed(x)])

    def gradient(value: Floats, slope: Floats, places: Floats) -> Floats:
        """F has the axes r, z, θ."""
        out = np.zeros((2, *places.shape[1:], 3, 3))
        for i in range(2):
            out[i, ..., i, :2] = np.moveaxis(slope, 0, -1)
        out[0, ..., 2, 2] = value / places[0]
        return out.reshape(*out.shape[:-2], 9)

    return _tissue(law, mesh, skfem.ElementQuad2(), 5, free, gradient, lambda x: 2 * np.pi * x[0])


def solve_all() -> dict[str, float]:
    """Forces on the spheres of sphere_contact.py [N], each with that of a coarser mesh, which says how exact it is.

    The force of the block is corrected by a cylinder: multiplied by its force on a fine grid, and divided by that on
    the block's grid.
    """
    out = {}
    law = stable_neo_hookean(DEEP.young_modulus_pa, DEEP.poisson_ratio)

    def deep(body: Callable[[Law, Floats, Floats], Tissue], cells: int, fine: int) -> float:
        grids = [graded(cells, fine, DEEP.radius_m, to_m) for to_m in (DEEP.side_m / 2, DEEP.thickness_m)]
        augmentation = 20 * DEEP.young_modulus_pa / DEEP.radius_m
        return float(press(body(law, *grids), DEEP.radius_m, [DEEP.depth_m], augmentation)[0])

    exact = deep(cylinder_section, 24, 16)
    for name, cells, fine in (("", 8, 5), (COARSER, 6, 4)):
        out[DEEP_PRESS + name] = 4 * deep(block_quarter, cells, fine) * exact / deep(cylinder_section, cells, fine)
    for name, cells in (("", 12), (COARSER, 6)):
        a = HERTZ.contact_radius_m
        linear = hooke(HERTZ.young_modulus_pa, HERTZ.poisson_ratio)
        tissue = half_ball_section(linear, cells, 2 * cells + 2, HERTZ.inner * a, HERTZ.outer * a)
        (force_n,) = press(tissue, HERTZ.radius_m, [HERTZ.depth_m], 20 * HERTZ.young_modulus_pa / a)
        out[HALF_BALL + name] = float(force_n)
    return out
