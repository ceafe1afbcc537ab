"""Stiffness and mass matrix of a body at rest, in the linear elastic limit of its laws.

Shape functions, their gradients and the geometry of elements come from scikit-fem, and not from the server. Quadrature
and lumping follow the scene, so the matrices are those of the server's first step with small displacements.

    K = ∫ λ (∇·u)(∇·v) + 2 μ ε(u):ε(v) dV        M = ∫ ρ u·v dV

u, v: displacement and test function. ε: small strain. λ, μ: Lamé's constants [Pa]. ρ: density [kg/m³].
N_k: shape function of node k. G: ∫ ∂N_k/∂x_i ∂N_l/∂x_j dV of an element, from which K is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from tensormass import (
    BoolArray,
    ElementBlock,
    FloatArray,
    InvalidArgumentError,
    Regions,
    VolumeMesh,
    body_mesh,
    lame,
    signed_volumes,
)
from tensormass._shared.errors import naming
from tensormass.v1 import scene_pb2
from tensormass_tools.trade.small_strain import ISOTROPIC_LAWS, small_strain

if TYPE_CHECKING:
    import scipy.sparse

#: Shapes that can be assembled, with scikit-fem's order of quadrature for K and for M. Those for K have the points of
#: the server's full rule: 1, 4 and 2×2×2. Those for M are exact for straight edges.
SHAPES = {"tetrahedron": (1, 2), "quadratic_tetrahedron": (2, 4), "hexahedron": (3, 5)}
_ONE_POINT = "tetrahedron"
# Corners of scikit-fem's hexahedron in VTK's order of the unit cube.
_CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


@dataclass(frozen=True)
class Matrices:
    """Matrices of one body. Direction c of node n is row 3 n + c."""

    #: The mesh as it is stepped: metres, with the nodes that `element_order` adds.
    mesh: VolumeMesh
    #: [3 node_count, 3 node_count] N/m.
    stiffness: scipy.sparse.csr_matrix
    #: [3 node_count, 3 node_count] kg; diagonal if the scene lumps masses.
    mass: scipy.sparse.csr_matrix
    #: Directions that are neither fixed nor prescribed, [3 node_count].
    free: BoolArray
    #: Largest Young's modulus of an element [Pa].
    young_modulus_pa: float


def matrices(body: scene_pb2.Body) -> Matrices:
    """Assembles the matrices of a body.

    Raises:
        InvalidArgumentError: a shape, quadrature or law that is not supported, or a mistake in the body.
    """
    import scipy.sparse

    where = f"body {body.name!r}"
    mesh = _placed_mesh(body)
    _check_supported(body, mesh, where)
    regions = Regions(body, mesh.nodes)
    young, poisson = _elastic_constants(body, mesh, regions, where)
    with naming(where):
        lambda_pa, mu_pa = np.array([lame(*pair) for pair in np.stack([young, poisson], axis=1).tolist()]).T
    if not 0 < body.density_kg_per_m3 < np.inf:
        raise InvalidArgumentError(f"{where}.density_kg_per_m3: expected a positive number")

    size = 3 * len(mesh.nodes)
    stiffness, mass = (scipy.sparse.csr_matrix((size, size)) for _ in range(2))
    first = 0
    for block in mesh.blocks:
        own = slice(first, first + len(block.nodes))
        first = own.stop
        nodes, order_k, order_m = _local_order(block), *SHAPES[block.shape.name]
        gradients, _, weights = _evaluated(mesh, block, order_k)
        selective = body.quadrature == scene_pb2.QUADRATURE_SELECTIVE
        stiffness += _assembled(nodes, _stiffness(gradients, weights, lambda_pa[own], mu_pa[own], selective), size)
        _, values, weights = _evaluated(mesh, block, order_m)
        lumped = body.mass != scene_pb2.MASS_CONSISTENT
        mass += _assembled(nodes, body.density_kg_per_m3 * _mass(block, values, weights, lumped), size)
    return Matrices(mesh, stiffness, mass, _free(body, regions, len(mesh.nodes), where), float(young.max()))


def _placed_mesh(body: scene_pb2.Body) -> VolumeMesh:
    mesh = body_mesh(body)
    scale = body.mesh.scale if body.mesh.HasField("scale") else 1.0
    moved = body.mesh.translation_m
    return VolumeMesh(scale * mesh.nodes + [moved.x, moved.y, moved.z], mesh.blocks)


def _check_supported(body: scene_pb2.Body, mesh: VolumeMesh, where: str) -> None:
    for shape, _ in mesh.blocks:
        if shape.name not in SHAPES:
            raise InvalidArgumentError(f"{where}: modes of a {shape.name} are not computed; take {', '.join(SHAPES)}")
        if body.quadrature == scene_pb2.QUADRATURE_REDUCED and shape.name != _ONE_POINT:
            raise InvalidArgumentError(
                f"{where}: with quadrature: reduced, bending modes of a {shape.name} have no stiffness; take selective"
            )
        if body.quadrature == scene_pb2.QUADRATURE_SELECTIVE and shape.name == _ONE_POINT:
            raise InvalidArgumentError(
                f"{where}: with quadrature: selective, modes of linear tetrahedra are not computed; take full, or "
                "element_order: quadratic"
            )
    inverted = np.flatnonzero(signed_volumes(mesh) <= 0)
    if inverted.size:
        raise InvalidArgumentError(f"{where}: element {inverted[0]} is flat or inverted; `tensormass mesh` repairs it")


def _elastic_constants(
    body: scene_pb2.Body, mesh: VolumeMesh, regions: Regions, where: str
) -> tuple[FloatArray, FloatArray]:
    """Returns Young's modulus [Pa] and Poisson's ratio of each element, [element_count] each."""
    count = mesh.element_count
    values = np.empty((count, 2))
    values[:] = _small_strain(body.law, f"{where}.law")
    for index, part in enumerate(body.law_regions):
        at = f"{where}.law_regions[{index}]"
        inside = regions.mask(part.region, at)
        chosen = np.concatenate([inside[nodes].all(axis=1) for _, nodes in mesh.blocks])
        values[chosen] = _small_strain(part.law, at)
    for column, name in enumerate(("young_modulus_pa", "poisson_ratio")):
        own = np.frombuffer(getattr(body.element_fields, name), "<f8")
        if own.size not in (0, count):
            raise InvalidArgumentError(f"{where}.element_fields.{name}: {own.size} values for {count} elements")
        if own.size:
            values[:, column] = own
    return values[:, 0], values[:, 1]


def _small_strain(law: scene_pb2.Law, where: str) -> tuple[float, float]:
    found = small_strain(law)
    if found is not None:
        return found
    kind = law.WhichOneof("kind")
    if kind is None:
        raise InvalidArgumentError(f"{where}: has no law; give one of {', '.join(ISOTROPIC_LAWS)}")
    if kind in ("mooney_rivlin", "ogden"):
        raise InvalidArgumentError(f"{where}: {kind} is stiffer in volume than Poisson's ratio 0.4999 is")
    raise InvalidArgumentError(
        f"{where}: {kind} is not isotropic, and modes are computed for isotropic laws: "
        f"{', '.join([*ISOTROPIC_LAWS, 'mooney_rivlin', 'ogden'])}"
    )


def _free(body: scene_pb2.Body, regions: Regions, node_count: int, where: str) -> BoolArray:
    """Returns the directions that boundary conditions leave free, [3 node_count]."""
    free = np.ones((node_count, 3), np.bool_)
    for index, region in enumerate(body.fixed):
        free[regions.mask(region, f"{where}.fixed[{index}]")] = False
    for index, entry in enumerate(body.prescribed):
        inside = regions.mask(entry.region, f"{where}.prescribed[{index}]")
        for axis, name in enumerate(("x_m", "y_m", "z_m")):
            if entry.HasField(name):
                free[inside, axis] = False
    return free.reshape(-1)


def _local_order(block: ElementBlock) -> npt.NDArray[np.int64]:
    """Returns the nodes of each element in scikit-fem's local order, [element, k]."""
    import skfem

    if block.shape.name != "hexahedron":
        return block.nodes.astype(np.int64)  # corners, then the edges 01 12 02 03 13 23, in both
    corners = skfem.MeshHex1.elem.refdom.p.T
    order = [int(np.flatnonzero((corner == _CUBE).all(axis=1))[0]) for corner in corners]
    return block.nodes[:, order].astype(np.int64)


def _evaluated(mesh: VolumeMesh, block: ElementBlock, order: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Evaluates shape functions at quadrature points.

    Returns:
        gradients [element, k, 3, point] 1/m, values [element, k, point], weights [element, point] m³.
    """
    import skfem

    used, index = np.unique(_local_order(block), return_inverse=True)
    local = np.ascontiguousarray(index.reshape(len(block.nodes), -1).T)
    points = np.ascontiguousarray(mesh.nodes[used].T)
    # Unsorted, so that local nodes keep their order.
    if block.shape.name == "hexahedron":
        basis = skfem.Basis(skfem.MeshHex1(points, local, sort_t=False), skfem.ElementHex1(), intorder=order)
    else:
        corners, corner_index = np.unique(local[:4], return_inverse=True)
        straight = skfem.MeshTet1(np.ascontiguousarray(points[:, corners]), corner_index.reshape(4, -1), sort_t=False)
        if block.shape.name == "tetrahedron":
            basis = skfem.Basis(straight, skfem.ElementTetP1(), intorder=order)
        else:
            basis = skfem.Basis(_curved(straight, points, local), skfem.ElementTetP2(), intorder=order)
    functions = [of[0] for of in basis.basis]
    shape = basis.dx.shape
    gradients = np.stack([np.broadcast_to(f.grad, (3, *shape)) for f in functions])
    values = np.stack([np.broadcast_to(np.asarray(f), shape) for f in functions])
    return gradients.transpose(2, 0, 1, 3), values.transpose(1, 0, 2), basis.dx


def _curved(straight: Any, points: FloatArray, local: npt.NDArray[np.int64]) -> Any:  # noqa: ANN401
    """Returns scikit-fem's mesh of quadratic tetrahedra, whose edges bend through the nodes in their middles.

    Args:
        straight: the mesh of their corners.
        points: [3, n] m.
        local: indices of points, [10, element].
    """
    import skfem

    places = skfem.Dofs(straight, skfem.ElementTetP2()).element_dofs  # [10, element]
    positions = np.empty((3, places.max() + 1))
    positions[:, places] = points[:, local]
    if not (positions[:, places] == points[:, local]).all():
        raise InvalidArgumentError("two quadratic tetrahedra have different nodes in the middle of a shared edge")
    return skfem.MeshTet2(positions, straight.t, sort_t=False)


def _stiffness(
    gradients: FloatArray, weights: FloatArray, lambda_pa: FloatArray, mu_pa: FloatArray, selective: bool
) -> FloatArray:
    """Returns the stiffness of each element, [element, 3 k, 3 k] N/m."""
    count, nodes = gradients.shape[:2]
    rows = gradients.reshape(count, 3 * nodes, -1)
    of = ((rows * weights[:, None]) @ rows.transpose(0, 2, 1)).reshape(count, nodes, 3, nodes, 3)  # G, [e, k, i, l, j]
    # Selective: the bulk modulus acts on the mean gradients, and all points have the deviatoric part of μ only.
    at_points = -2 / 3 * mu_pa if selective else lambda_pa
    out = at_points[:, None, None, None, None] * of
    out += mu_pa[:, None, None, None, None] * of.transpose(0, 1, 4, 3, 2)
    trace = mu_pa[:, None, None] * np.einsum("ekili->ekl", of)
    for axis in range(3):
        out[:, :, axis, :, axis] += trace
    out = out.reshape(count, 3 * nodes, 3 * nodes)
    if selective:
        mean = np.einsum("erq,eq->er", rows, weights)
        bulk = (lambda_pa + 2 / 3 * mu_pa) / weights.sum(axis=1)
        out += bulk[:, None, None] * mean[:, :, None] * mean[:, None, :]
    return out


def _mass(block: ElementBlock, values: FloatArray, weights: FloatArray, lumped: bool) -> FloatArray:
    """Returns the mass of each element for a density of one, [element, 3 k, 3 k] m³."""
    each = (values * weights[:, None]) @ values.transpose(0, 2, 1)  # [e, k, l]
    if lumped:
        node = each.sum(axis=2)
        if block.shape.name == "quadratic_tetrahedron":  # row sums are negative at corners (HRZ)
            diagonal = np.einsum("ekk->ek", each)
            node = diagonal * (weights.sum(axis=1) / diagonal.sum(axis=1))[:, None]
        each = node[:, :, None] * np.eye(node.shape[1])
    count, nodes = each.shape[:2]
    return np.einsum("ekl,ij->ekilj", each, np.eye(3)).reshape(count, 3 * nodes, 3 * nodes)


def _assembled(nodes: npt.NDArray[np.int64], elements: FloatArray, size: int) -> scipy.sparse.csr_matrix:
    """Adds up the matrices of elements."""
    import scipy.sparse

    at = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
    rows, columns = np.broadcast_arrays(at[:, :, None], at[:, None, :])
    entries = (elements.reshape(-1), (rows.reshape(-1), columns.reshape(-1)))
    return scipy.sparse.coo_matrix(entries, shape=(size, size)).tocsr()
