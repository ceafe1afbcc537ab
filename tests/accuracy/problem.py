"""A boundary value problem, independent of the solver: the server and each reference solve it."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass.v1 import scene_pb2

from .laws import Law
from .meshes import Floats, Integers, Mesh, boundary_faces

DENSITY_KG_PER_M3 = 1000.0


@dataclass(frozen=True)
class Prescribed:
    """Prescribed displacements of nodes. displacement_m: [node, 3] or [3]; NaN: free in that direction."""

    nodes: Integers
    displacement_m: Floats


@dataclass(frozen=True)
class Traction:
    """A constant force per rest area, on the boundary faces that have all their nodes in `nodes`."""

    nodes: Integers
    traction_pa: tuple[float, float, float]


@dataclass(frozen=True)
class Pressure:
    """A follower pressure on the boundary faces that have all their nodes in `nodes`."""

    nodes: Integers
    pressure_pa: float


@dataclass(frozen=True)
class Problem:
    """An equilibrium problem. The prescribed nodes move in `increments` equal shares."""

    mesh: Mesh
    law: Law
    conditions: Sequence[Prescribed]
    tractions: Sequence[Traction] = ()
    # The reference solvers do not know pressures.
    pressures: Sequence[Pressure] = ()
    # Additional nodal forces, [node_count, 3] N.
    forces_n: Floats | None = None
    quadrature: scene_pb2.Quadrature = scene_pb2.QUADRATURE_FULL
    increments: int = 1
    density_kg_per_m3: float = DENSITY_KG_PER_M3

    def prescribed(self) -> Floats:
        """Prescribed displacements, [node_count, 3] m; NaN where free."""
        out = np.full(self.mesh.nodes.shape, np.nan)
        for condition in self.conditions:
            given = np.broadcast_to(condition.displacement_m, (len(condition.nodes), 3))
            out[condition.nodes] = np.where(np.isnan(given), out[condition.nodes], given)
        return out

    def nodal_forces(self) -> Floats:
        """The loads as forces on the nodes, [node_count, 3] N."""
        if self.pressures:
            raise ValueError("a pressure follows the surface and cannot be written as constant nodal forces")
        out = np.zeros(self.mesh.nodes.shape) if self.forces_n is None else self.forces_n.copy()
        for load in self.tractions:
            out += node_areas(self.mesh, load.nodes)[:, None] * np.array(load.traction_pa)
        return out

    def digest(self) -> str:
        """Hash of everything that the answer depends on; a stored answer carries it. Numbers are rounded to 9 digits,
        so that every machine computes the same hash."""
        text = f"{self.law.message.SerializeToString(deterministic=True).hex()} {self.quadrature}"
        for array in (self.mesh.nodes, self.prescribed(), self.nodal_forces()):
            scale = np.nanmax(np.abs(array)) or 1.0
            text += " ".join(f"{value:.9f}" for value in (np.round(array / scale, 9) + 0.0).ravel()) + f"*{scale:.9g}"
        for shape, elements in self.mesh.blocks:
            text += shape + " ".join(map(str, elements.ravel()))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def node_areas(mesh: Mesh, nodes: npt.ArrayLike) -> Floats:
    """∫ N_k da over the plane boundary faces that have all their nodes in `nodes`, [node_count] m²."""
    chosen = np.zeros(len(mesh.nodes), dtype=bool)
    chosen[np.asarray(nodes)] = True
    out = np.zeros(len(mesh.nodes))
    for face in boundary_faces(mesh):
        if chosen[face].all():
            out[face] += _face_areas(mesh.nodes[face])
    return out


def _face_areas(x: Floats) -> Floats:
    if len(x) % 4 == 0:  # a quadrilateral with straight sides: 3×3 Gauss points are exact for a plane face
        out = np.zeros(len(x))
        points, weights = np.polynomial.legendre.leggauss(3)
        for r, weight_r in zip(points, weights, strict=True):
            for s, weight_s in zip(points, weights, strict=True):
                n = np.array([(1 - r) * (1 - s), (1 + r) * (1 - s), (1 + r) * (1 + s), (1 - r) * (1 + s)]) / 4
                by_r = np.array([s - 1, 1 - s, 1 + s, -1 - s]) @ x[:4] / 4
                by_s = np.array([r - 1, -1 - r, 1 + r, 1 - r]) @ x[:4] / 4
                if len(x) == 8:  # a corner is its bilinear function less half of the middles of its two sides
                    across = (1 - r**2) / 2, (1 - s**2) / 2
                    middles = np.array(
                        [across[0] * (1 - s), across[1] * (1 + r), across[0] * (1 + s), across[1] * (1 - r)]
                    )
                    n = np.concatenate([n - (middles + np.roll(middles, 1)) / 2, middles])
                out += weight_r * weight_s * n * np.linalg.norm(np.cross(by_r, by_s))
        return out
    area = np.linalg.norm(np.cross(x[1] - x[0], x[2] - x[0])) / 2
    # Quadratic triangle: a corner gets zero, an edge midpoint a third of the area.
    return area / 3 * (np.array([0, 0, 0, 1, 1, 1]) if len(x) == 6 else np.ones(3))
