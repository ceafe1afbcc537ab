"""Cook's membrane in two dimensions by scikit-fem, fine and of high order: what meshes in space converge to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import skfem_fem
from .laws import lame
from .meshes import Floats

CORNERS = np.array([[0, 0], [48, 44], [48, 60], [0, 44]], dtype=float)
HEIGHT = 16.0


@dataclass(frozen=True)
class Variant:
    """force: on the right edge, per unit of thickness. at: point where the displacement is read."""

    law: str
    young_modulus_pa: float
    poisson_ratio: float
    force: float
    at: tuple[float, float]
    plane_stress: bool


VARIANTS = {
    "plane stress": Variant("hooke", 1, 1 / 3, 1, (48, 52), True),
    "finite strain": Variant("neo_hookean", 200, 0.35, 4 * HEIGHT, (48, 60), False),
    "nearly incompressible": Variant("hooke", 250, 0.4999, 100, (48, 60), False),
}


def available() -> bool:
    return skfem_fem.available()


def source() -> str:
    return f"{skfem_fem.source()}, two dimensions"


def solve_all() -> dict[str, float]:
    return {name: solve(variant) for name, variant in VARIANTS.items()}


def place(nodes: Floats) -> Floats:
    """Maps the unit square to the membrane and keeps a third coordinate."""
    r, s = nodes[:, 0], nodes[:, 1]
    weights = np.stack([(1 - r) * (1 - s), r * (1 - s), r * s, (1 - r) * s], axis=1)
    return np.column_stack([weights @ CORNERS, nodes[:, 2:]])


def solve(variant: Variant, cells: int = 20, order: int = 4) -> float:
    """Vertical displacement, with quadrilaterals of order 4 that are refined towards the corner of infinite stress."""
    import scipy.sparse.linalg
    import skfem
    from skfem.helpers import ddot, grad

    line = np.linspace(0, 1, cells + 1)
    graded = line**3 * (10 - 15 * line + 6 * line**2)
    mesh = skfem.MeshQuad.init_tensor(graded, graded)
    mesh = skfem.MeshQuad(place(mesh.p.T).T, mesh.t).with_boundaries(
        {"left": lambda x: x[0] < 1e-9, "right": lambda x: x[0] > 48 - 1e-9}
    )
    basis = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuadP(order)), intorder=2 * order)
    lam, mu = lame(variant.young_modulus_pa, variant.poisson_ratio)
    if variant.plane_stress:
        lam = 2 * lam * mu / (lam + 2 * mu)
    eye = np.eye(2)

    def stress_and_moduli(slope: Floats) -> tuple[Floats, Floats]:
        """Stress and moduli of displacement gradients [2, 2, ...]. Plane strain, or plane stress if λ is modified."""
        unit = np.ones(slope.shape[2:])
        same = np.einsum("ik,jl->ijkl", eye, eye)[..., None, None] * unit
        turned = np.einsum("il,jk->ijkl", eye, eye)[..., None, None] * unit
        traces = np.einsum("ij,kl->ijkl", eye, eye)[..., None, None] * unit
        if variant.law == "hooke":
            moduli = lam * traces + mu * (same + turned)
            return np.einsum("ijkl...,kl...->ij...", moduli, slope), moduli
        f = slope + eye[..., None, None]
        j = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
        dual = np.array([[f[1, 1], -f[1, 0]], [-f[0, 1], f[0, 0]]]) / j
        pressure = lam * np.log(j) - mu
        moduli = mu * same + lam * np.einsum("ij...,kl...->ijkl...", dual, dual)
        return mu * f + pressure * dual, moduli - pressure * np.einsum("il...,kj...->ijkl...", dual, dual)

    inner_force = skfem.LinearForm(lambda v, w: ddot(w["stress"], grad(v)))
    stiffness = skfem.BilinearForm(
        lambda du, v, w: np.einsum("ijkl...,ij...,kl...->...", w["moduli"], grad(v), grad(du))
    )
    pull = skfem.LinearForm(lambda v, w: variant.force / HEIGHT * v[1])

    load = skfem.asm(pull, skfem.FacetBasis(mesh, basis.elem, facets="right", intorder=2 * order))
    free = basis.complement_dofs(basis.get_dofs("left"))
    u = np.zeros(basis.N)
    shares = [1.0] if variant.law == "hooke" else np.linspace(0.1, 1, 10)
    for share in shares:
        for _ in range(30):
            stress, moduli = stress_and_moduli(basis.interpolate(u).grad)
            residual = (share * load - skfem.asm(inner_force, basis, stress=stress))[free]
            matrix = skfem.asm(stiffness, basis, moduli=moduli).tocsc()[free][:, free]
            change = scipy.sparse.linalg.spsolve(matrix, residual)
            u[free] += change
            if np.abs(change).max() < 1e-8 * np.abs(u).max():
                break
        else:
            raise ArithmeticError("Cook's membrane did not converge")
    node = np.argmin(np.linalg.norm(mesh.p.T - variant.at, axis=1))
    return float(u[basis.nodal_dofs[1, node]])
