"""A small finite element solver of our own, for pyramids and for meshes of several shapes, which other solvers lack.

It shares no code with the server. Slopes of the shape functions come from complex steps. Newton's method uses a
numerical tangent, an assembled sparse matrix and a direct solve. test_references.py compares it with scikit-fem for the
shapes that both have.

N_k: shape function of node k. r = (ξ, η, ζ): reference coordinates. F: deformation gradient. P: first Piola-Kirchhoff
stress [Pa].
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tensormass.v1 import scene_pb2

from . import problem as problems
from .laws import IDENTITY, Law
from .meshes import Floats, Integers, Mesh

if TYPE_CHECKING:
    import scipy.sparse

Rule = tuple[Floats, Floats]

# Rings of linear tetrahedra in selective quadrature (server/model/clusters.h).
MOST_IN_RING = 6
MOST_NODES_IN_RING = 8
PART_OF_RING = 0.7


def available() -> bool:
    return True


def source() -> str:
    return "own NumPy solver (numpy_fem.py)"


def _tetrahedron(r: npt.NDArray[Any]) -> list[Any]:
    return [1 - r[0] - r[1] - r[2], r[0], r[1], r[2]]


def _quadratic_tetrahedron(r: npt.NDArray[Any]) -> list[Any]:
    a = _tetrahedron(r)
    edges = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
    return [x * (2 * x - 1) for x in a] + [4 * a[i] * a[j] for i, j in edges]


def _wedge(r: npt.NDArray[Any]) -> list[Any]:
    triangle = [1 - r[0] - r[1], r[0], r[1]]
    return [x * (1 - r[2]) for x in triangle] + [x * r[2] for x in triangle]


def _hexahedron(r: npt.NDArray[Any]) -> list[Any]:
    signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return [(1 + x * r[0]) * (1 + y * r[1]) * (1 + z * r[2]) / 8 for z in (-1, 1) for x, y in signs]


def _quadratic_hexahedron(r: npt.NDArray[Any]) -> list[Any]:
    """Middles first; a corner is its trilinear function minus half of the middles of its three edges."""
    base = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    places = [(x, y, z) for z in (-1, 1) for x, y in base]
    for z in (-1, 1):
        places += [(0, -1, z), (1, 0, z), (0, 1, z), (-1, 0, z)]
    places += [(x, y, 0) for x, y in base]
    middles: dict[tuple[int, ...], Any] = {}
    for place in places[8:]:
        factors = [1 - r[c] * r[c] if at == 0 else (1 + at * r[c]) / 2 for c, at in enumerate(place)]
        middles[place] = factors[0] * factors[1] * factors[2]
    out = []
    for linear, place in zip(_hexahedron(r), places, strict=False):
        near = [middles[tuple(0 if c == axis else at for c, at in enumerate(place))] for axis in range(3)]
        out.append(linear - (near[0] + near[1] + near[2]) / 2)
    return out + list(middles.values())


def _pyramid(r: npt.NDArray[Any]) -> list[Any]:
    """Bedrosian 1992: N = ¼ ((1 + xξ)(1 + yη) − ζ + xyξηζ/(1 − ζ)) for the corner (x, y) of the base."""
    signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    ratio = r[0] * r[1] * r[2] / (1 - r[2])
    return [((1 + x * r[0]) * (1 + y * r[1]) - r[2] + x * y * ratio) / 4 for x, y in signs] + [r[2]]


FUNCTIONS: dict[str, Callable[[npt.NDArray[Any]], list[Any]]] = {
    "tetrahedron": _tetrahedron,
    "pyramid": _pyramid,
    "wedge": _wedge,
    "hexahedron": _hexahedron,
    "quadratic_tetrahedron": _quadratic_tetrahedron,
    "quadratic_hexahedron": _quadratic_hexahedron,
}


def _gauss(points: int) -> Rule:
    return np.polynomial.legendre.leggauss(points)


def _unit_gauss(points: int) -> Rule:
    x, w = _gauss(points)
    return (x + 1) / 2, w / 2


def _triangle(points: int) -> Rule:
    """Rule for a triangle from a collapsed square, exact to degree 2 `points` − 2."""
    x, w = _unit_gauss(points)
    a, b = np.meshgrid(x, x, indexing="ij")
    return np.stack([a, b * (1 - a)], axis=-1).reshape(-1, 2), (np.outer(w, w) * (1 - a)).ravel()


def _tensor(*rules: Rule) -> Rule:
    """Tensor product of rules. A rule's points are numbers or rows of coordinates."""
    points, weights = np.zeros((1, 0)), np.ones(1)
    for x, w in rules:
        x = x.reshape(len(w), -1)
        points = np.hstack([np.repeat(points, len(w), axis=0), np.tile(x, (len(points), 1))])
        weights = np.outer(weights, w).ravel()
    return points, weights


def _conical(across: Rule, heights: Rule) -> Rule:
    """Rule for a pyramid. heights: a rule for ζ on [0, 1] with the weight (1 − ζ)²."""
    points, weights = _tensor(across, across, heights)
    return np.column_stack([points[:, :2] * (1 - points[:, 2:]), points[:, 2]]), weights


@cache
def rule(shape: str, fine: bool = False) -> Rule:
    """The full quadrature rule of a shape (see scene.proto), or a fine one to integrate given fields."""
    n = 4 if fine else 2
    if shape == "hexahedron" or (shape == "quadratic_hexahedron" and fine):
        return _tensor(_gauss(n), _gauss(n), _gauss(n))
    if shape == "quadratic_hexahedron":
        points = np.vstack([_tensor(_gauss(2), _gauss(2), _gauss(2))[0], np.eye(3), -np.eye(3)])
        return points, np.full(14, 8 / 14)
    if shape == "wedge":
        three = np.array([[1, 1], [4, 1], [1, 4]]) / 6, np.full(3, 1 / 6)
        return _tensor(_triangle(5) if fine else three, _unit_gauss(n))
    if shape == "pyramid":
        # Two-point Gauss-Jacobi: the orthogonal polynomial for the weight (1 − ζ)² has the roots 1/3 ∓ √(2/45).
        root = np.sqrt(2 / 45)
        heights = np.array([1 / 3 - root, 1 / 3 + root])
        # The weights integrate 1 and ζ exactly: ∫(1 − ζ)² = 1/3, ∫ζ(1 − ζ)² = 1/12.
        weights = np.linalg.solve(np.array([[1, 1], heights]), np.array([1 / 3, 1 / 12]))
        if fine:
            heights, weights = _unit_gauss(5)
            weights = weights * (1 - heights) ** 2
        return _conical(_gauss(n), (heights, weights))
    if fine:
        x, w = _unit_gauss(5)
        points, weights = _tensor((x, w), (x, w), (x, w))
        a, b, c = points.T
        return np.stack([a, b * (1 - a), c * (1 - a) * (1 - b)], axis=1), weights * (1 - a) ** 2 * (1 - b)
    if shape == "tetrahedron":
        return np.full((1, 3), 1 / 4), np.array([1 / 6])
    near, far = (5 - np.sqrt(5)) / 20, (5 + 3 * np.sqrt(5)) / 20
    return np.full((4, 3), near) + np.vstack([np.zeros(3), np.eye(3)]) * (far - near), np.full(4, 1 / 24)


def values(shape: str, at: Floats) -> Floats:
    """N_k at the points, [point, k]."""
    return np.array(FUNCTIONS[shape](at.T) if shape else []).T


def slopes(shape: str, at: Floats) -> Floats:
    """∂N_k/∂r_j at the points, [point, k, j]; exact to rounding (complex step)."""
    steps = [np.array(FUNCTIONS[shape]((at + 1e-30j * IDENTITY[j]).T)).imag.T / 1e-30 for j in range(3)]
    return np.stack(steps, axis=-1)


def gradients(mesh: Mesh, shape: str, elements: Integers, fine: bool = False) -> tuple[Floats, Floats]:
    """∇N_k [element, point, k, 3] 1/m and weights [element, point] m³."""
    points, weights = rule(shape, fine)
    slope = slopes(shape, points)
    jacobian = np.einsum("eki,qkj->eqij", mesh.nodes[elements], slope)
    determinant = np.linalg.det(jacobian)
    if determinant.min() <= 0:
        raise ValueError(f"a {shape} is inverted")
    a, w = np.einsum("qkj,eqji->eqki", slope, np.linalg.inv(jacobian)), determinant * weights
    if shape == "quadratic_hexahedron" and not fine:
        # The six points in the faces take on the volume and the mean gradients of the 2×2×2 points.
        volumes = [w[:, part].sum(axis=1) for part in (slice(8), slice(8, None))]
        means = [
            np.einsum("eq,eqki->eki", w[:, part], a[:, part]) / volume[:, None, None]
            for part, volume in zip((slice(8), slice(8, None)), volumes, strict=True)
        ]
        a[:, 8:] += (means[0] - means[1])[:, None]
        w[:, 8:] *= (6 / 8 * volumes[0] / volumes[1])[:, None]
    return a, w


def wedge_pairs(mesh: Mesh, elements: Integers) -> Integers:
    """Pairs of wedges for selective quadrature, [pair, 2]: each lies across the other's largest quadrilateral that two
    wedges share.

    In a mesh of cells cut in two, a pair is a cell. In other meshes the server chooses the pairs, and there is no
    reference.

    Raises:
        ValueError: two wedges do not choose each other.
    """
    sharing: dict[tuple[int, ...], list[int]] = {}
    areas: dict[tuple[int, ...], float] = {}
    for element, nodes in enumerate(elements):
        for local in ((0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)):
            face = nodes[list(local)]
            key = tuple(sorted(face.tolist()))
            a, b, c, d = mesh.nodes[face]
            sharing.setdefault(key, []).append(element)
            areas[key] = float(np.linalg.norm(np.cross(c - a, d - b))) / 2
    best: dict[int, tuple[float, int]] = {}
    for key, members in sharing.items():
        if len(members) == 2:
            for element, other in (members, members[::-1]):
                best[element] = max(best.get(element, (0.0, -1)), (areas[key], other))
    partner = np.array([best.get(element, (0.0, -1))[1] for element in range(len(elements))])
    if (partner < 0).any() or (partner[partner] != np.arange(len(elements))).any():
        raise ValueError("the wedges do not form pairs that choose each other")
    first = np.flatnonzero(np.arange(len(elements)) < partner)
    return np.column_stack([first, partner[first]])


def tetrahedron_rings(mesh: Mesh, elements: Integers) -> list[list[int]]:
    """Tetrahedra that are one for selective quadrature, by the rule of server/model/tetrahedron_rings.h. A tetrahedron
    that the rule leaves is a ring of its own.
    """
    around: dict[tuple[int, int], list[int]] = {}
    for element, nodes in enumerate(elements.tolist()):
        for edge in itertools.combinations(sorted(nodes), 2):
            around.setdefault(edge, []).append(element)
    lengths = {edge: float(np.linalg.norm(mesh.nodes[edge[0]] - mesh.nodes[edge[1]])) for edge in around}
    longest = max(lengths.values())
    order = sorted(around, key=lambda edge: (-round(1e6 * lengths[edge] / longest), edge))
    free = set(range(len(elements)))
    rings: list[list[int]] = []
    for size in range(MOST_IN_RING, 1, -1):
        for edge in order:
            ring: list[int] = []
            for element in around[edge]:
                nodes = set(elements[[*ring, element]].ravel())
                if element in free and len(ring) < MOST_IN_RING and len(nodes) <= MOST_NODES_IN_RING:
                    ring.append(element)
            if len(ring) >= size:
                rings.append(ring)
                free -= set(ring)
    return rings + [[element] for element in sorted(free)]


Stress = Callable[[Floats], Floats]


def tangent(stress: Stress, f: Floats) -> Floats:
    """∂P_ij/∂F_km by central differences, [..., i, j, k, m]. Newton stops by the residual, so this is enough."""
    out = np.empty((*f.shape, 3, 3))
    for k in range(3):
        for m in range(3):
            step = np.zeros((3, 3))
            step[k, m] = 1e-6
            out[..., k, m] = (stress(f + step) - stress(f - step)) / 2e-6
    return out


def _sums(problem: problems.Problem, shape: str, elements: Integers) -> list[tuple[Integers, Floats, Floats, Stress]]:
    """The terms to integrate over the elements: nodes [element, k], gradients, weights, and a stress."""
    law = problem.law
    a, w = gradients(problem.mesh, shape, elements)
    if problem.quadrature == scene_pb2.QUADRATURE_FULL:
        return [(elements, a, w, law.stress)]
    if shape == "tetrahedron":
        return _ring_sums(law, elements, a[:, 0], w[:, 0], tetrahedron_rings(problem.mesh, elements))
    if shape == "quadratic_hexahedron":  # selective: the volumetric stress is integrated at the 2×2×2 points
        return [
            (elements, a, w, lambda f: law.stress(f) - law.volumetric(f)),
            (elements, a[:, :8], w[:, :8] * 14 / 8, law.volumetric),
        ]
    # Selective: the volumetric stress is integrated once, with mean gradients; for wedges over a pair of them.
    volume = w.sum(axis=1, keepdims=True)
    total = np.einsum("eq,eqki->eki", w, a)
    together = elements
    if shape == "wedge":
        pairs = wedge_pairs(problem.mesh, elements)
        volume = volume[pairs].sum(axis=1)
        total = np.concatenate([total[pairs[:, 0]], total[pairs[:, 1]]], axis=1)
        # A pair lists twelve nodes, four of them twice; assembly adds up both entries.
        together = np.concatenate([elements[pairs[:, 0]], elements[pairs[:, 1]]], axis=1)
    return [
        (elements, a, w, lambda f: law.stress(f) - law.volumetric(f)),
        (together, (total / volume[..., None])[:, None], volume, law.volumetric),
    ]


def _ring_sums(
    law: Law, elements: Integers, a: Floats, w: Floats, rings: list[list[int]]
) -> list[tuple[Integers, Floats, Floats, Stress]]:
    """The terms of `_sums` for linear tetrahedra in selective quadrature: each keeps a part of its deviatoric stress,
    and its ring has the rest."""

    def kept(f: Floats) -> Floats:
        return (1 - PART_OF_RING) * (law.stress(f) - law.volumetric(f))

    def shared(f: Floats) -> Floats:
        return PART_OF_RING * law.stress(f) + (1 - PART_OF_RING) * law.volumetric(f)

    alone = [ring[0] for ring in rings if len(ring) == 1]
    in_rings = [element for ring in rings if len(ring) > 1 for element in ring]
    out = [
        (elements[alone], a[alone][:, None], w[alone][:, None], law.stress),
        (elements[in_rings], a[in_rings][:, None], w[in_rings][:, None], kept),
    ]
    for size in sorted({len(ring) for ring in rings} - {1}):
        of_size = np.array([ring for ring in rings if len(ring) == size])
        volume = w[of_size].sum(axis=1)
        mean = a[of_size] * (w[of_size] / volume[:, None])[:, :, None, None]
        # A ring lists a node once for each of its tetrahedra; assembly adds up the entries.
        nodes = elements[of_size].reshape(len(of_size), -1)
        out.append((nodes, mean.reshape(len(of_size), 1, -1, 3), volume[:, None], shared))
    return [term for term in out if len(term[0])]


def solve(problem: problems.Problem) -> Floats:
    """Displacements in equilibrium, [node_count, 3] m."""
    import scipy.sparse  # imported here: comparing with stored answers needs no SciPy

    blocks = [sum_ for shape, elements in problem.mesh.blocks for sum_ in _sums(problem, shape, elements)]

    def system(u: Floats) -> tuple[Floats, scipy.sparse.csr_matrix]:
        inner = np.zeros(u.size)
        rows, columns, entries = [], [], []
        for elements, a, w, stress in blocks:
            f = IDENTITY + np.einsum("eki,eqkj->eqij", u[elements], a)
            force = np.einsum("eq,eqij,eqkj->eki", w, stress(f), a)
            dofs = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), -1)
            np.add.at(inner, dofs, force.reshape(dofs.shape))
            stiffness = np.einsum("eq,eqaj,eqijkl,eqbl->eaibk", w, a, tangent(stress, f), a, optimize=True)
            rows.append(np.repeat(dofs, dofs.shape[1], axis=1).ravel())
            columns.append(np.tile(dofs, (1, dofs.shape[1])).ravel())
            entries.append(stiffness.ravel())
        where = np.concatenate(rows), np.concatenate(columns)
        return inner, scipy.sparse.csr_matrix((np.concatenate(entries), where), shape=(u.size, u.size))

    return newton(problem, system)


def newton(problem: problems.Problem, system: Callable[[Floats], tuple[Floats, scipy.sparse.csr_matrix]]) -> Floats:
    """Displacements in equilibrium under the problem's loads and boundary conditions, [node_count, 3] m.

    system: displacements [node_count, 3] m to internal forces [3 node_count] N and their derivative. Called once an
    iteration.

    Raises:
        ArithmeticError: Newton's method did not converge.
    """
    import scipy.sparse.linalg

    given = problem.prescribed().ravel()
    free = np.flatnonzero(np.isnan(given))
    fixed = np.flatnonzero(~np.isnan(given))
    outer = problem.nodal_forces().ravel()
    u = np.zeros(given.size)
    scale = 0.0  # largest force so far; a rigidly rotated body ends without forces
    for increment in range(1, problem.increments + 1):
        target = given * increment / problem.increments
        for _ in range(60):
            inner, stiffness = system(u.reshape(-1, 3))
            residual = (outer - inner)[free]
            move = target[fixed] - u[fixed]
            scale = max(scale, np.abs(inner).max(), np.abs(outer).max())
            if np.abs(move).max() == 0 and np.abs(residual).max() <= 1e-12 * scale:
                break
            right = residual - stiffness[free][:, fixed] @ move
            u[free] += scipy.sparse.linalg.spsolve(stiffness[free][:, free].tocsc(), right)
            u[fixed] = target[fixed]
        else:
            raise ArithmeticError(f"Newton did not converge: residual {np.abs(residual).max() / scale:.1e}")
    return u.reshape(-1, 3)


def l2_norm(mesh: Mesh, field: Callable[[Floats], Floats], nodal: Floats | None = None) -> float:
    """√∫|field(x) − Σ N_k nodal_k|² dV; without `nodal` the norm of the field. field: positions [..., 3] to values."""
    total = 0.0
    for shape, elements in mesh.blocks:
        n = values(shape, rule(shape, fine=True)[0])
        _, w = gradients(mesh, shape, elements, fine=True)
        difference = field(np.einsum("qk,eki->eqi", n, mesh.nodes[elements]))
        if nodal is not None:
            difference = difference - np.einsum("qk,eki->eqi", n, nodal[elements])
        total += np.einsum("eq,eqi,eqi->", w, difference, difference)
    return float(np.sqrt(total))


def consistent_forces(mesh: Mesh, density: Callable[[Floats], Floats]) -> Floats:
    """∫ N_k density(x) dV, [node_count, components]. density: positions [..., 3] m to values per volume."""
    out = None
    for shape, elements in mesh.blocks:
        n = values(shape, rule(shape, fine=True)[0])
        _, w = gradients(mesh, shape, elements, fine=True)
        force = np.einsum("eq,qk,eqi->eki", w, n, density(np.einsum("qk,eki->eqi", n, mesh.nodes[elements])))
        out = np.zeros((len(mesh.nodes), force.shape[2])) if out is None else out
        np.add.at(out, elements, force)
    assert out is not None
    return out
