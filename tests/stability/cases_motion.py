"""Free flight and spin: without forces, momentum is conserved."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from accuracy.cases_time import BAR_M, FLIGHT_LOOKS, Flight, watch_flight
from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES, box
from accuracy.problem import Problem
from tensormass.v1 import scene_pb2

from .case import CAUGHT, FELT, HOLDS, Case, Check, Found, Group
from .cases_steps import NEWTON_SOLVES
from .tissue import NEWTON_SAYS, initial, law_says, real_time, running, tissue

MOTION = Group(
    "motion",
    "Free flight and spin",
    "momentum kept to 10⁻¹⁰ (float 5·10⁻³); energy and spin never rise; real time 1 %",
    "A free bar of 100 × 40 × 40 mm starts with a velocity of 0.37 m/s and a spin about an oblique axis. Nothing acts "
    "on it for 1,000 steps of 1 ms. Must hold with Newton's method: momentum is kept to 10⁻¹⁰ (5·10⁻³ in float). "
    "Angular momentum and energy never rise by more than 10⁻³ and 10⁻⁶ (10⁻² and 10⁻⁴ in float); implicit Euler loses "
    "some of both. In real time, linearized once: all three to 1 %. Linear Hooke mistakes a rotation for strain, and "
    "the status says so. Quadratic shapes are left out because their nodal masses differ from those of the sums here.",
)
STEPS, DT_S = 1000, 1e-3
AXIS = np.array([1, 2, 3]) / np.sqrt(14)
VELOCITY_M_PER_S = np.array([0.3, 0.2, 0.1])


def _spun_up(flight: Flight) -> float:
    """The largest angular momentum of a flight without initial spin, relative to momentum × length of the bar."""
    lever = np.linalg.norm(flight.momentum[0]) * max(BAR_M)
    return float(np.linalg.norm(flight.angular_momentum, axis=1).max() / lever)


def motion_cases() -> Iterator[Case]:
    def run(engine: Engine, law: str, shape: str, spin_rad_per_s: float, newton: bool) -> Found:
        mesh = box(shape, (3, 2, 2), BAR_M)
        problem = Problem(mesh, tissue(law), [])
        scene = engine.scene(problem, DT_S) if newton else real_time(engine, problem, DT_S)
        scene.solver.integrator = scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER
        lever = mesh.nodes - np.array(BAR_M) / 2
        initial(scene, velocity_m_per_s=VELOCITY_M_PER_S + np.cross(spin_rad_per_s * AXIS, lever))
        with running(engine, scene) as scene_running:
            flight = watch_flight(scene_running.handle, mesh, STEPS)
            scene_running.step()  # updates the warnings
        checks = []
        for name, (_, look, bounds) in FLIGHT_LOOKS.items():
            bound = bounds[engine.precision] if newton else FELT
            error = _spun_up(flight) if name == "angular momentum" and spin_rad_per_s == 0 else look(flight).error
            checks.append(Check(name, error, bound))
        return Found(checks, scene_running.last_warnings)

    for spin in (0.0, 10.0, 60.0):
        for newton in (True, False):
            for law in LAWS:
                for shape in SHAPES:
                    if SHAPES[shape].order == 2:
                        continue
                    yield Case(
                        MOTION,
                        f"{spin:g} rad/s" + ("" if newton else ", real time"),
                        law,
                        shape,
                        partial(run, law=law, shape=shape, spin_rad_per_s=spin, newton=newton),
                        expects=(HOLDS, CAUGHT) if law == "hooke" and spin > 0 and not newton else (HOLDS,),
                        names=law_says(law) + (NEWTON_SAYS if newton else ()),
                        quick=shape == "tetrahedron" and spin == 10 and not newton,
                        solves=STEPS * (NEWTON_SOLVES if newton else 1),
                    )
