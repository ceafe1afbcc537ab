"""The same equilibria by scikit-fem: its meshes, elements, mappings and assembly, with our laws and rules."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from typing import TYPE_CHECKING

import numpy as np

from . import numpy_fem
from . import problem as problems
from .laws import IDENTITY
from .meshes import Floats, Mesh

if TYPE_CHECKING:
    import scipy.sparse
    import skfem

_KINDS = {
    "tetrahedron": ("MeshTet1", "ElementTetP1"),
    "wedge": ("MeshWedge1", "ElementWedge1"),
    "hexahedron": ("MeshHex1", "ElementHex1"),
    "quadratic_tetrahedron": ("MeshTet1", "ElementTetP2"),
    "quadratic_hexahedron": ("MeshHex1", "ElementHexS2"),
}
SHAPES = tuple(_KINDS)


def available() -> bool:
    return importlib.util.find_spec("skfem") is not None


def source() -> str:
    return f"scikit-fem {importlib.metadata.version('scikit-fem')}"


def _basis(mesh: Mesh) -> tuple[skfem.CellBasis, np.ndarray]:
    """The basis, and for each of our degrees of freedom the number of its own, [3 node_count]."""
    import skfem  # imported here: comparing with stored answers needs no scikit-fem

    ((shape, elements),) = mesh.blocks
    mesh_type, element_type = (getattr(skfem, name) for name in _KINDS[shape])
    reference = mesh_type.elem.refdom.p.T
    points, weights = numpy_fem.rule(shape)
    if shape in ("hexahedron", "quadratic_hexahedron"):  # scikit-fem uses [0, 1]³
        points, weights = (points + 1) / 2, weights / 8
        corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
        order = [int(np.flatnonzero((corners == corner).all(axis=1))[0]) for corner in reference]
    else:
        order = list(range(len(reference)))
    used, index = np.unique(elements[:, order], return_inverse=True)
    # Unsorted, so that quadrature points keep their places.
    their = mesh_type(mesh.nodes[used].T, index.reshape(-1, len(order)).T, sort_t=False)
    basis = skfem.Basis(their, skfem.ElementVector(element_type()), quadrature=(points.T, weights))
    ours = {tuple(key): number for number, key in enumerate(np.round(mesh.nodes, 9).tolist())}
    dofs = np.empty(basis.N, dtype=int)
    components = np.empty(basis.N, dtype=int)
    for component in range(3):
        mine = basis.get_dofs(elements=np.arange(their.nelements)).all([f"u^{component + 1}"])
        components[mine] = component
    for dof, place in enumerate(np.round(basis.doflocs.T, 9).tolist()):
        dofs[dof] = 3 * ours[tuple(place)] + components[dof]
    theirs = np.empty(basis.N, dtype=int)
    theirs[dofs] = np.arange(basis.N)
    return basis, theirs


def solve(problem: problems.Problem) -> Floats:
    """Displacements in equilibrium, [node_count, 3] m, for a mesh of one shape."""
    import skfem
    from skfem.helpers import ddot, grad

    basis, theirs = _basis(problem.mesh)
    law = problem.law

    inner_force = skfem.LinearForm(lambda v, w: ddot(w["stress"], grad(v)))
    stiffness = skfem.BilinearForm(
        lambda du, v, w: np.einsum("ijkl...,ij...,kl...->...", w["moduli"], grad(v), grad(du))
    )

    def system(u: Floats) -> tuple[Floats, scipy.sparse.csr_matrix]:
        slope = basis.interpolate(u.ravel()[_inverse(theirs)]).grad
        f = IDENTITY + np.moveaxis(slope, (0, 1), (-2, -1))
        stress = np.moveaxis(law.stress(f), (-2, -1), (0, 1))
        moduli = np.moveaxis(numpy_fem.tangent(law.stress, f), (-4, -3, -2, -1), (0, 1, 2, 3))
        matrix = skfem.asm(stiffness, basis, moduli=moduli).tocsr()
        return skfem.asm(inner_force, basis, stress=stress)[theirs], matrix[theirs][:, theirs]

    return numpy_fem.newton(problem, system)


def _inverse(permutation: np.ndarray) -> np.ndarray:
    out = np.empty_like(permutation)
    out[permutation] = np.arange(len(permutation))
    return out
