"""Behaviour over time: relaxation of viscoelastic laws, order of the time schemes, and a bar in free flight."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import tensormass as tm
from tensormass.v1 import scene_pb2

from . import numpy_fem
from .case import Case, Group, Outcome, relative
from .cases_homogeneous import nominal_stress
from .engine import Engine, state
from .laws import IDENTITY, LAWS, Law
from .meshes import MESHES, Floats, Mesh, box
from .problem import DENSITY_KG_PER_M3, Prescribed, Problem

RELAXATION = Group(
    "relaxation",
    "Prony relaxation",
    "A cube, suddenly stretched by 10 % along x and kept so, with two Prony terms: α 0.24 with τ 0.27 s, α 0.33 with "
    "τ 0.03 s. *Step by step*: against implicit Euler's own sum, S = S⁰ (1 − Σ α (1 − (τ / (Δt + τ))ⁿ)), every tenth "
    "step up to 0.4 s. Value: P11 at 0.4 s. Error: the largest, relative to the first stress. *Order*: against the "
    "exponential 1 − Σ α (1 − e^(−t/τ)) at 0.2 s. Value: the order at which the error falls with the last halving of "
    "Δt. Error: its distance from 1.",
)
SWING = Group(
    "swing",
    "Order in time",
    "A clamped bar of 100 × 40 × 40 mm swings under gravity of 1 m/s² from rest, until 0.2 s. Value: the order at "
    "which the displacement of its end changes with the last halving of Δt, from 200 to 400 to 800 steps, with "
    "Newton's method and with one linearized solve a step. Error: its distance from the scheme's.",
)
FLIGHT = Group(
    "flight",
    "Free flight",
    "A probe strikes a free bar of 100 × 40 × 40 mm off-centre and leaves. Then nothing acts on the bar for 10,000 "
    "steps of 1 ms. *Momentum*: value and error are the largest drift of the linear momentum, relative to its size. "
    "*Angular momentum* about the centre of mass: the value is the share left at the end. Implicit schemes lose some, "
    "so the error is the largest rise above the start. *Energy*, elastic and kinetic: the value is the share left at "
    "the end; BDF2 carries more vibration of the blow into the flight and loses it there. The error is the largest "
    "rise between two samples (every 10 steps), relative to the start.",
)
TERMS = ((0.24, 0.27), (0.33, 0.03))
STRETCH = 1.1
CUBE_M = 0.1
BAR_M = (0.1, 0.04, 0.04)
FLIGHT_STEPS = 10_000
FLIGHT_DT_S = 1e-3
SAMPLE_EVERY = 10


def time_cases() -> Iterator[Case]:
    yield from _relaxation_cases()
    yield from _swing_cases()
    yield from _flight_cases()


def viscous(law: Law) -> Law:
    message = scene_pb2.Law()
    message.CopyFrom(law.message)
    for share, time_s in TERMS:
        message.prony.add(share=share, relaxation_time_s=time_s)
    return replace(law, message=message)


def _relaxed(engine: Engine, shape: str, law: Law, dt_s: float, steps: list[int]) -> list[float]:
    """P11 [Pa] of a suddenly stretched cube after each of these numbers of steps."""
    mesh = box(shape, (5 if shape == "mixed" else 2, 2, 2), (CUBE_M,) * 3)
    boundary = mesh.boundary()
    moved = mesh.nodes[boundary] * (STRETCH - 1) * IDENTITY[0]
    stresses = []
    with engine.loaded(engine.scene(Problem(mesh, viscous(law), [Prescribed(boundary, moved)]), dt_s)) as handle:
        for count in np.diff([0, *steps]).tolist():
            handle.step(count)
            stresses.append(float(nominal_stress(mesh, state(handle).reaction_n, CUBE_M**3)[0, 0]))
    return stresses


def _relaxation_cases() -> Iterator[Case]:
    def by_step(engine: Engine, shape: str, law: Law) -> Outcome:
        dt_s, steps = 0.01, [1, 10, 20, 30, 40]
        first = float(law.pull(np.array([STRETCH, 1, 1]))[0])
        ours = _relaxed(engine, shape, law, dt_s, steps)
        exact = [
            first * (1 - sum(share * (1 - (time_s / (dt_s + time_s)) ** n) for share, time_s in TERMS)) for n in steps
        ]
        return Outcome(ours[-1], exact[-1], float(np.abs(np.subtract(ours, exact)).max() / first))

    def order(engine: Engine) -> Outcome:
        law, until_s = LAWS["neo_hookean"], 0.2
        exact = float(law.pull(np.array([STRETCH, 1, 1]))[0])
        exact *= 1 - sum(share * (1 - np.exp(-until_s / time_s)) for share, time_s in TERMS)
        counts = (40, 80, 160)
        found = [_relaxed(engine, "hexahedron", law, until_s / count, [count])[0] for count in counts]
        errors = [relative(value, exact) for value in found]
        reached = float(np.log2(errors[-2] / errors[-1]))
        details = tuple(
            (f"Δt {until_s / count:g} s", value, error)
            for count, value, error in zip(counts, found, errors, strict=True)
        )
        return Outcome(reached, 1.0, abs(reached - 1), details)

    bounds = {"double": 1e-10, "float": 1e-5}
    for shape in MESHES:
        for law in LAWS:
            yield Case(
                RELAXATION,
                shape,
                law,
                "step by step",
                "P11 [Pa]",
                "closed form of the scheme",
                bounds,
                partial(by_step, shape=shape, law=LAWS[law]),
                quick=shape == "wedge" and law == "ogden",
            )
    yield Case(RELAXATION, "hexahedron", "neo_hookean", "order", "order in Δt", "closed form", {"double": 0.05}, order)


def _swing_cases() -> Iterator[Case]:
    until_s, counts = 0.2, (200, 400, 800)

    def run(engine: Engine, integrator: str, one_solve: bool, order: int) -> Outcome:
        mesh = box("hexahedron", (5, 2, 2), BAR_M)
        end = mesh.where(lambda x, y, z: x > BAR_M[0] * (1 - 1e-6))
        clamped = Prescribed(mesh.where(lambda x, y, z: x < 1e-9), np.zeros(3))
        found = []
        for count in counts:
            scene = engine.scene(Problem(mesh, LAWS["neo_hookean"], [clamped]), until_s / count)
            scene.solver.integrator = {**_INTEGRATORS, **_CONSERVING}[integrator]
            if one_solve:
                scene.solver.newton_max_iterations = 1
            scene.gravity_m_per_s2.z = -1
            with engine.loaded(scene) as handle:
                handle.step(count)
                found.append(float(state(handle).displacement_m[end, 2].mean()))
        coarse, fine = abs(found[0] - found[1]), abs(found[1] - found[2])
        reached = float(np.log2(coarse / fine))
        details = tuple(
            (f"Δt {until_s / count:g} s", value, change)
            for count, value, change in zip(counts, found, (float("nan"), coarse, fine), strict=True)
        )
        return Outcome(reached, order, abs(reached - order), details)

    for integrator, order in (("implicit Euler", 1), ("BDF2", 2), ("implicit midpoint", 2)):
        for one_solve in (False, True):
            yield Case(
                SWING,
                "hexahedron",
                "neo_hookean",
                f"{integrator}, one solve" if one_solve else integrator,
                "order in Δt",
                "the scheme",
                {"double": 0.1},
                partial(run, integrator=integrator, one_solve=one_solve, order=order),
            )


@dataclass(frozen=True)
class Flight:
    """Momentum [sample, 3] kg m/s, angular momentum about the centre of mass [sample, 3] kg m²/s, energy [sample] J."""

    momentum: Floats
    angular_momentum: Floats
    energy: Floats


def _fly(engine: Engine, shape: str, law: str, integrator: scene_pb2.Solver.Integrator) -> Flight:
    mesh = box(shape, (5, 2, 2), BAR_M)
    scene = engine.scene(Problem(mesh, LAWS[law], []), FLIGHT_DT_S)
    scene.solver.integrator = integrator
    probe = scene.tools.add(name="probe", max_speed_m_per_s=1.0)
    probe.spherical_probe.radius_m = 0.01
    start, hit = (0.09, 0.03, 0.06), (0.09, 0.03, 0.045)
    probe.position_m.x, probe.position_m.y, probe.position_m.z = start
    with engine.loaded(scene) as handle:
        handle.move_tool("probe", hit)
        handle.step(40)
        handle.move_tool("probe", (0.09, 0.03, 0.5))
        handle.step(100)
        return watch_flight(handle, mesh, FLIGHT_STEPS)


def watch_flight(handle: tm.SceneHandle, mesh: Mesh, steps: int) -> Flight:
    """Samples a body that nothing acts on, every SAMPLE_EVERY steps.

    Nodal masses are row sums of the mass matrix. The server lumps them so for all linear shapes.
    """
    masses = numpy_fem.consistent_forces(mesh, lambda x: np.full((*x.shape[:-1], 1), DENSITY_KG_PER_M3))[:, 0]
    momenta, angular, energies = [], [], []
    for sample in range(steps // SAMPLE_EVERY + 1):
        if sample > 0:
            handle.step(SAMPLE_EVERY)
        now = state(handle)
        velocity, place = now.velocity_m_per_s, mesh.nodes + now.displacement_m
        momenta.append(masses @ velocity)
        centre, drift = masses @ place / masses.sum(), momenta[-1] / masses.sum()
        angular.append(masses @ np.cross(place - centre, velocity - drift))
        energies.append(now.elastic_energy_j + now.kinetic_energy_j)
    return Flight(np.array(momenta), np.array(angular), np.array(energies))


def _momentum(flight: Flight) -> Outcome:
    sizes = np.linalg.norm(flight.momentum - flight.momentum[0], axis=1) / np.linalg.norm(flight.momentum[0])
    return Outcome(float(sizes.max()), 0.0, float(sizes.max()))


def _angular_momentum(flight: Flight) -> Outcome:
    sizes = np.linalg.norm(flight.angular_momentum, axis=1)
    return Outcome(float(sizes[-1] / sizes[0]), 1.0, float(max(sizes.max() / sizes[0] - 1, 0)))


def _energy(flight: Flight) -> Outcome:
    rise = np.diff(flight.energy).max() / flight.energy[0]
    return Outcome(float(flight.energy[-1] / flight.energy[0]), 1.0, float(max(rise, 0)))


# By name: the quantity, the function that computes it from a flight, the bounds of its error.
FLIGHT_LOOKS: dict[str, tuple[str, Callable[[Flight], Outcome], dict[str, float]]] = {
    "momentum": ("drift", _momentum, {"double": 1e-10, "float": 5e-3}),
    "angular momentum": ("share left", _angular_momentum, {"double": 1e-3, "float": 1e-2}),
    "energy": ("share left", _energy, {"double": 1e-6, "float": 1e-4}),
}
_INTEGRATORS = {
    "implicit Euler": scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER,
    "BDF2": scene_pb2.Solver.INTEGRATOR_BDF2,
}
# Without damping a bar in flight keeps its vibration, and its energy swings about its mean.
_CONSERVING = {"implicit midpoint": scene_pb2.Solver.INTEGRATOR_IMPLICIT_MIDPOINT}


def _flight_cases() -> Iterator[Case]:
    # The engine itself is the key: its id could be used again after it is gone.
    flights: dict[tuple[Engine, str, str], Flight] = {}

    def flight(engine: Engine, shape: str, integrator: str) -> Flight:
        key = engine, shape, integrator
        if key not in flights:
            flights[key] = _fly(engine, shape, "neo_hookean", _INTEGRATORS[integrator])
        return flights[key]

    for shape in ("tetrahedron", "hexahedron"):
        for integrator in _INTEGRATORS:
            for name, (quantity, look, bounds) in FLIGHT_LOOKS.items():

                def run(
                    engine: Engine,
                    shape: str = shape,
                    integrator: str = integrator,
                    look: Callable[[Flight], Outcome] = look,
                ) -> Outcome:
                    return look(flight(engine, shape, integrator))

                yield Case(
                    FLIGHT,
                    shape,
                    "neo_hookean",
                    f"{name}, {integrator}",
                    quantity,
                    "conservation",
                    bounds,
                    run,
                )
