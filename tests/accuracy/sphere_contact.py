"""A rigid sphere pressed into tissue by the server: slightly into a half ball (Hertz), and deep into a block.

a       radius of the contact by Hertz, √(radius · depth) [m]
E*      E / (1 − ν²) [Pa]
d       depth [m]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tensormass.v1 import scene_pb2

from .engine import Engine
from .half_ball import half_ball
from .laws import hooke, stable_neo_hookean
from .meshes import Floats, box
from .problem import Prescribed, Problem

FULL, SELECTIVE = scene_pb2.QUADRATURE_FULL, scene_pb2.QUADRATURE_SELECTIVE
TOOL = "sphere"
#: `penalty_stiffness_pa_per_m` of a sphere unless a scene gives another, times E / radius.
DEFAULT_PENALTY = 20.0
NEWTON_TOLERANCE = 1e-5
NEWTON_ITERATIONS = 100


@dataclass(frozen=True)
class Hertz:
    """A small depth in linear tissue. inner: half the width of the fine cells; outer: radius of the half ball; both
    in contact radii."""

    young_modulus_pa: float = 5000.0
    poisson_ratio: float = 0.35
    radius_m: float = 0.02
    depth_m: float = 2e-5
    inner: float = 1.25
    outer: float = 400.0

    @property
    def contact_radius_m(self) -> float:
        return float(np.sqrt(self.radius_m * self.depth_m))

    @property
    def force_n(self) -> float:
        """Hertz: 4/3 E* √radius depth^1.5."""
        modulus_pa = self.young_modulus_pa / (1 - self.poisson_ratio**2)
        return float(4 / 3 * modulus_pa * np.sqrt(self.radius_m) * self.depth_m**1.5)

    def penalty_pa_per_m(self, times: float) -> float:
        """A penalty of `times` E / a. It loses 0.5 / times of the force (measured).

        The mean pressure, 0.42 E* a / radius, lets one expect 0.72 / times.
        """
        return times * self.young_modulus_pa / self.contact_radius_m

    def elements_per_contact_radius(self, cells: int) -> float:
        return cells / self.inner


@dataclass(frozen=True)
class Deep:
    """A fifth of the thickness of a square block of neo-Hookean tissue that is fixed at its bottom."""

    young_modulus_pa: float = 5000.0
    poisson_ratio: float = 0.45
    radius_m: float = 0.012
    side_m: float = 0.06
    thickness_m: float = 0.03
    depth_m: float = 0.006

    def penalty_pa_per_m(self, times: float) -> float:
        """A penalty of `times` the default."""
        return times * DEFAULT_PENALTY * self.young_modulus_pa / self.radius_m


HERTZ, DEEP = Hertz(), Deep()


def layers(cells: int) -> int:
    """Layers of the half ball: the finer its block, the less they grow."""
    return 2 * cells + 2


def press_half_ball(
    engine: Engine,
    shape: str,
    cells: int,
    penalty_pa_per_m: float,
    quadrature: scene_pb2.Quadrature = FULL,
    given: Hertz = HERTZ,
) -> float:
    """Force on the sphere [N]. cells: along half the width of the fine block."""
    a = given.contact_radius_m
    mesh = half_ball(shape, cells, layers(cells), given.inner * a, given.outer * a)
    ends = np.linalg.norm(mesh.nodes, axis=1) > 0.9 * given.outer * a
    problem = Problem(
        mesh,
        hooke(given.young_modulus_pa, given.poisson_ratio),
        [Prescribed(np.intersect1d(np.flatnonzero(ends), mesh.boundary()), np.zeros(3))],
        quadrature=quadrature,
    )
    return _press(engine, problem, given, np.zeros(3), penalty_pa_per_m, (0.5, 1))


def press_block(
    engine: Engine,
    shape: str,
    cells: int,
    penalty_pa_per_m: float,
    quadrature: scene_pb2.Quadrature = FULL,
    given: Deep = DEEP,
) -> float:
    """Force on the sphere [N]. cells: along a side; half as many, rounded up, through the thickness."""
    mesh = box(shape, (cells, cells, (cells + 1) // 2), (given.side_m, given.side_m, given.thickness_m))
    problem = Problem(
        mesh,
        stable_neo_hookean(given.young_modulus_pa, given.poisson_ratio),
        [Prescribed(mesh.where(lambda x, y, z: z < 1e-9), np.zeros(3))],
        quadrature=quadrature,
    )
    top = np.array([given.side_m / 2, given.side_m / 2, given.thickness_m])
    return _press(engine, problem, given, top, penalty_pa_per_m, (0.25, 0.5, 0.75, 1))


def _press(
    engine: Engine,
    problem: Problem,
    given: Hertz | Deep,
    top_m: Floats,
    penalty_pa_per_m: float,
    shares: Sequence[float],
) -> float:
    """Presses down from the point top_m in equilibria at shares of the depth.

    Raises:
        ArithmeticError: the last equilibrium did not converge.
    """
    scene = engine.scene(problem)
    tool = scene.tools.add(name=TOOL, max_speed_m_per_s=1)
    tool.spherical_probe.radius_m = given.radius_m
    tool.spherical_probe.penalty_stiffness_pa_per_m = penalty_pa_per_m

    def centre(depth_m: float) -> Floats:
        return top_m + np.array([0, 0, given.radius_m - depth_m])

    tool.position_m.x, tool.position_m.y, tool.position_m.z = centre(0)
    scene.solver.newton_tolerance = NEWTON_TOLERANCE
    scene.solver.newton_max_iterations = NEWTON_ITERATIONS
    scene.solver.cg_tolerance = NEWTON_TOLERANCE / 10
    scene.solver.allow_unconverged = True
    with engine.loaded(scene) as handle:
        for share in shares:
            handle.move_tool(TOOL, tuple(centre(share * given.depth_m)))
            status = handle.step()
    if not status.newton_residual <= NEWTON_TOLERANCE:
        raise ArithmeticError(f"the press ended at a residual of {status.newton_residual:.1e}")
    return float(status.tools[0].force_n.z)
