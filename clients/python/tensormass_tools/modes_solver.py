"""The lowest natural frequencies and mode shapes of a body: K φ = ω² M φ with shapes φ of modal mass 1 kg.

K: stiffness matrix [N/m]. M: mass matrix [kg]. ω: angular frequency [rad/s]. σ: shift [rad²/s²].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from tensormass import FloatArray, NotConvergedError
from tensormass_tools.modes_matrices import Matrices

if TYPE_CHECKING:
    import scipy.sparse

    Sparse: TypeAlias = scipy.sparse.csr_matrix

# Directions up to which a dense solver is faster and simpler.
_DENSE = 400
# The shift is so many times -E / (ρ L²), with L the size of the body. Because it is below zero, K - σ M is positive
# definite, also for bodies without fixed nodes.
_SHIFT = 1e-4
# A mode below this share of the shift is a rigid motion: its frequency is rounding.
_RIGID = 1e-3
# Modes that are computed beyond those asked for, so that a pair of equal frequencies is not cut.
_MORE = 4
# Residual |K φ - ω² M φ| of a mode relative to |K| |φ| above which the result is refused.
_RESIDUAL = 1e-8


@dataclass(frozen=True)
class Modes:
    """The lowest modes of one body, in ascending order."""

    #: [mode] Hz; 0 for rigid motions.
    frequency_hz: FloatArray
    #: [mode, node_count, 3]. Modal mass φᵀ M φ = 1, so a unit of φ is 1 m for 1 kg of modal mass.
    shapes: FloatArray
    #: [mode, 3] kg: the mass that takes part in a motion of the fixed nodes along x, y and z.
    effective_mass_kg: FloatArray
    #: Mass of the body [kg], and the number of directions that are not fixed.
    mass_kg: float
    free_count: int


def lowest_modes(of: Matrices, count: int) -> Modes:
    """Computes the `count` lowest modes, or all if the body has fewer: as many as free directions.

    Raises:
        NotConvergedError: the eigenvalue solver did not get there.
    """
    free = np.flatnonzero(of.free)
    count = min(count, len(free))
    stiffness, mass = of.stiffness[free][:, free], of.mass[free][:, free]
    mass_kg = float(of.mass[0::3, 0::3].sum())
    if count == 0:
        none = np.empty((0, len(of.mesh.nodes), 3))
        return Modes(np.empty(0), none, np.empty((0, 3)), mass_kg, 0)
    size_m = float(np.linalg.norm(np.ptp(of.mesh.nodes, axis=0)))
    # ρ L³ is about the mass, so E / (ρ L²) is about E L / mass.
    sigma = -_SHIFT * of.young_modulus_pa * size_m / mass_kg
    computed = min(count + _MORE, len(free))
    solve = _dense if len(free) <= _DENSE or 2 * computed >= len(free) else _shift_inverted
    squares, vectors = solve(stiffness, mass, computed, sigma)
    order = np.argsort(squares)[:count]
    squares, vectors = squares[order], vectors[:, order]
    _check(stiffness, mass, squares, vectors)
    largest = np.abs(vectors).argmax(axis=0)
    vectors = vectors * np.sign(vectors[largest, np.arange(count)])  # the sign of a mode is free
    squares = np.where(squares < _RIGID * abs(sigma), 0.0, squares)

    shapes = np.zeros((count, len(of.free)))
    shapes[:, free] = vectors.T
    moved = of.mass @ np.tile(np.eye(3), (len(of.mesh.nodes), 1))  # [3 node_count, 3]
    return Modes(
        np.sqrt(squares) / (2 * np.pi),
        shapes.reshape(count, -1, 3),
        (shapes @ moved) ** 2,
        mass_kg,
        len(free),
    )


def _dense(stiffness: Sparse, mass: Sparse, count: int, sigma: float) -> tuple[FloatArray, FloatArray]:
    import scipy.linalg

    return scipy.linalg.eigh(stiffness.toarray(), mass.toarray(), subset_by_index=[0, count - 1])


def _shift_inverted(stiffness: Sparse, mass: Sparse, count: int, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Lanczos iteration with (K - σ M)⁻¹, whose largest eigenvalues belong to the lowest modes."""
    import scipy.sparse.linalg as sparse

    shifted = (stiffness - sigma * mass).tocsc()
    # Positive definite, so no pivoting is needed and the ordering may be symmetric.
    factors = sparse.splu(shifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    inverse = sparse.LinearOperator(shifted.shape, matvec=factors.solve, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=shifted.shape[0])  # the same result in every run
    try:
        return sparse.eigsh(stiffness, count, mass, sigma=sigma, OPinv=inverse, v0=start)
    except sparse.ArpackError as error:
        raise NotConvergedError(f"the eigenvalue solver failed: {error}") from error


def _check(stiffness: Sparse, mass: Sparse, squares: FloatArray, vectors: FloatArray) -> None:
    """Refuses modes that do not solve the eigenvalue problem."""
    residual = np.linalg.norm(stiffness @ vectors - (mass @ vectors) * squares, axis=0)
    scale = np.abs(stiffness).sum(axis=1).max() * np.linalg.norm(vectors, axis=0)
    worst = int(np.argmax(residual / scale))
    if not residual[worst] <= _RESIDUAL * scale[worst]:
        raise NotConvergedError(f"mode {worst + 1} has a residual of {residual[worst] / scale[worst]:.1e}")
