"""Long and short steps, large loads, and many steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

import tensormass as tm
from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES, box
from accuracy.problem import Prescribed, Problem
from tensormass.v1 import scene_pb2

from .case import CAUGHT, FELT, HOLDS, REFUSED, Case, Check, Found, Group
from .tissue import (
    CUBE_M,
    NEWTON_SAYS,
    REAL_TIME_DT_S,
    SOFTENS,
    Shared,
    clamped,
    cube,
    distance,
    equilibrium,
    law_says,
    nodal_weight,
    real_time,
    running,
    side_by_side,
    tissue,
)

STEP = Group(
    "step",
    "Length of a step",
    "energy never rises; ends at the equilibrium, to 1 %",
    "A cube of 0.1 m (E 5 kPa, 1000 kg/m³), clamped on one side, falls under its weight with a damping of 20 / s until "
    "it is at rest. Time integration is implicit Euler linearized once, or Newton's method if the name says so. Must "
    "hold: the total energy (elastic, kinetic, of the load) never rises between two checks by more than 1 % of the "
    "load's work. At the end the cube is at the equilibrium that Newton's method finds in double precision, to 1 %.",
)
LOAD = Group(
    "load",
    "Loads",
    "energy never exceeds the start's; a reset restores the start",
    "The same cube under a multiple of its weight. Must hold: the total energy never rises above that of the start, "
    "and a reset restores the start exactly. From 100 times its weight, one step of 1/60 s throws a soft cube farther "
    "than its own size, and the guard does not publish such a step.",
)
REST = Group(
    "rest",
    "Rest",
    "alone nothing moves; hanging, drift below 10⁻⁶ (float 10⁻³)",
    "One element, 60 steps a second. *Alone*: nothing acts on it. Must hold: nothing moves. *Hanging*: fixed at one "
    "face, under its weight, at rest after 2,000 steps. Must hold: from then on it drifts by less than 10⁻⁶ of its "
    "displacement (10⁻³ in float). The 10⁶ steps run once a law, with both cases in one scene.",
)
HOUR = Group(
    "hour",
    "An hour in float",
    "float equals double, to 1 % of the displacement",
    "One side of a cell moves along z with 10 mm and 1 Hz for an hour of simulated time, 216,000 steps, in float and "
    "in double. Must hold: at 60 checks the two differ by less than 1 % of the displacement. The hour runs once in "
    "each precision, with the cells of all laws and both shapes in one scene.",
)
# Nearly critical for the cube's first mode, 15 rad/s: it decays to e⁻¹⁰ within SETTLED_S.
DAMPING_PER_S = 20.0
SETTLED_S = 1.0
STEPS_S = (1e-4, 1e-3, REAL_TIME_DT_S, 0.1, 1.0)
NAMES = {1e-4: "0.1 ms", 1e-3: "1 ms", REAL_TIME_DT_S: "1/60 s", 0.1: "0.1 s", 1.0: "1 s"}
LOOKS = 20
# Approximate solves of a step by Newton's method.
NEWTON_SOLVES = 4
# Laws that yield without limit under ten times the weight: pressed below 1/√3, or stretched beyond e.
_YIELDS = (*SOFTENS, "hencky")

# What a run of several parts found, by law and kind of part.
_Parts = dict[tuple[str, str], Found]


def step_cases() -> Iterator[Case]:
    yield from _step_cases()
    yield from _load_cases()
    yield from _rest_cases()
    yield from _hour_cases()


def settles(law: str) -> tuple[str, ...]:
    """Outcomes allowed under the weight: at the clamp's edge st_venant_kirchhoff softens until an element inverts."""
    return (HOLDS, CAUGHT) if law in SOFTENS else (HOLDS,)


def settling_steps(dt_s: float) -> int:
    return max(round(SETTLED_S / dt_s), 120)


def settle(
    engine: Engine, problem: Problem, dt_s: float, *, newton: bool = False, damping_per_s: float = DAMPING_PER_S
) -> Found:
    """Lets the problem settle; checks its energy on the way and its distance to the equilibrium at the end."""
    try:
        reference = equilibrium(engine, problem).displacement_m
    except tm.FailedPreconditionError:
        reference = None  # a missing equilibrium says nothing about stepping the scene
    forces = problem.nodal_forces()
    scene = real_time(engine, problem, dt_s)
    scene.bodies[0].rayleigh_mass_per_s = damping_per_s
    if newton:
        scene.solver.newton_max_iterations = 20
    steps = settling_steps(dt_s)
    energies = [0.0]
    with running(engine, scene) as scene_running:
        for _ in range(LOOKS):
            scene_running.step(steps // LOOKS)
            now = scene_running.state()
            energies.append(now.elastic_energy_j + now.kinetic_energy_j - float((forces * now.displacement_m).sum()))
        warnings = scene_running.last_warnings
    if reference is None:
        return Found([Check("Newton's method finds no equilibrium to compare with", np.nan, 0)], warnings)
    rise = float(np.diff(energies).max() / float((forces * reference).sum()))
    return Found([distance(now.displacement_m, reference), Check("rise of energy", rise, FELT)], warnings)


def _step_cases() -> Iterator[Case]:
    def run(engine: Engine, law: str, shape: str, dt_s: float, newton: bool) -> Found:
        mesh = cube(shape)
        problem = Problem(mesh, tissue(law), [clamped(mesh)], forces_n=nodal_weight(mesh))
        return settle(engine, problem, dt_s, newton=newton)

    for dt_s in STEPS_S:
        for newton in (False, True):
            if newton and dt_s < REAL_TIME_DT_S:
                continue  # same as linearized once: nothing is left to iterate
            for law in LAWS:
                for shape in SHAPES:
                    yield Case(
                        STEP,
                        NAMES[dt_s] + (", Newton" if newton else ""),
                        law,
                        shape,
                        partial(run, law=law, shape=shape, dt_s=dt_s, newton=newton),
                        expects=settles(law),
                        names=law_says(law) + (NEWTON_SAYS if newton else ()),
                        quick=shape == "hexahedron" and dt_s == 1.0 and not newton,
                        solves=settling_steps(dt_s) * (NEWTON_SOLVES if newton else 1),
                    )


def _load_cases() -> Iterator[Case]:
    def run(engine: Engine, law: str, shape: str, times: float, young_pa: float, newton: bool) -> Found:
        mesh = cube(shape)
        forces = nodal_weight(mesh, times)
        scene = real_time(engine, Problem(mesh, tissue(law, young_pa), [clamped(mesh)], forces_n=forces))
        if newton:
            scene.solver.newton_max_iterations = 50
        worst = -np.inf
        with running(engine, scene) as scene_running:
            for _ in range(LOOKS):
                scene_running.step(6)
                now = scene_running.state()
                work = float((forces * now.displacement_m).sum())
                total = now.elastic_energy_j + now.kinetic_energy_j - work
                worst = max(worst, total / max(abs(work), 1e-300))
            scene_running.handle.reset()
            left = float(np.abs(scene_running.state().displacement_m).max())
            return Found(
                [Check("energy above the start / work", worst, FELT), Check("left by a reset [m]", left, 0)],
                scene_running.warnings,
            )

    def gravity(engine: Engine, law: str, shape: str) -> Found:
        mesh = cube(shape)
        scene = real_time(engine, Problem(mesh, tissue(law), [clamped(mesh)]))
        scene.gravity_m_per_s2.z = -9.81e6
        with running(engine, scene):
            raise AssertionError("it was admitted")

    for times, young_pa, newton, name in (
        (1e1, 5e3, False, "10 × weight, 5 kPa"),
        (1e1, 5e3, True, "10 × weight, 5 kPa, Newton"),
        (1e2, 5e3, False, "100 × weight, 5 kPa"),
        (1e2, 5e3, True, "100 × weight, 5 kPa, Newton"),
        (1e4, 5e3, False, "10⁴ × weight, 5 kPa"),
        (1e6, 5e3, False, "10⁶ × weight, 5 kPa"),
        (1e6, 1e11, False, "10⁶ × weight, 100 GPa"),
    ):
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    LOAD,
                    name,
                    law,
                    shape,
                    partial(run, law=law, shape=shape, times=times, young_pa=young_pa, newton=newton),
                    expects=(HOLDS,) if young_pa > 1e9 or (times < 1e2 and law not in _YIELDS) else (HOLDS, CAUGHT),
                    names=law_says(law) + (NEWTON_SAYS if newton else ()),
                    solves=120 * (NEWTON_SOLVES if newton else 1),
                )
    for law in LAWS:
        yield Case(
            LOAD,
            "gravity of 10⁶ g",
            law,
            "hexahedron",
            partial(gravity, law=law, shape="hexahedron"),
            expects=(REFUSED,),
        )


def _rest_cases() -> Iterator[Case]:
    mesh = box("hexahedron", (1, 1, 1), (CUBE_M,) * 3)

    def part(engine: Engine, law: str, kind: str) -> scene_pb2.Scene:
        if kind == "alone":
            return real_time(engine, Problem(mesh, tissue(law), []))
        scene = real_time(engine, Problem(mesh, tissue(law), [clamped(mesh)], forces_n=nodal_weight(mesh)))
        scene.bodies[0].rayleigh_mass_per_s = DAMPING_PER_S
        return scene

    def rest(engine: Engine, parts: Sequence[tuple[str, str]], steps: int) -> dict[tuple[str, str], Found]:
        scene = side_by_side({f"{law}-{kind}": part(engine, law, kind) for law, kind in parts})
        with running(engine, scene) as scene_running:
            scene_running.step(2000)
            settled = [scene_running.displacement_m(body.name) for body in scene.bodies]
            scene_running.step(steps)
            now = [scene_running.displacement_m(body.name) for body in scene.bodies]
        found = {}
        for (law, kind), before, after in zip(parts, settled, now, strict=True):
            if kind == "alone":
                check = Check("displacement / size", float(np.abs(after).max() / CUBE_M), 0)
            else:
                check = distance(after, before, "drift", {"double": 1e-6, "float": 1e-3}[engine.precision])
            found[law, kind] = Found([check], scene_running.warnings)
        return found

    def one(engine: Engine, of: tuple[str, str], steps: int, together: Shared[_Parts] | None) -> Found:
        return (together(engine) if together else rest(engine, [of], steps))[of]

    kinds = ("alone", "hanging")
    for steps, name, long in ((50_000, "50,000 steps", False), (1_000_000, "10⁶ steps", True)):
        for law in LAWS:
            # One scene for each law: on a GPU the kernels of several laws in a scene run one after the other.
            both = [(law, kind) for kind in kinds]
            together = Shared(partial(rest, parts=both, steps=steps))
            for kind in kinds:
                yield Case(
                    REST,
                    f"{kind}, {name}",
                    law,
                    "hexahedron",
                    partial(one, of=(law, kind), steps=steps, together=together if long else None),
                    long=long,
                    solves=steps,
                    together=f"rest, {name}, {law}" if long else "",
                )


def _hour_cases() -> Iterator[Case]:
    frequency_hz, amplitude_m, points_a_period = 1.0, 0.01, 20

    def part(engine: Engine, law: str, shape: str, duration_s: float) -> scene_pb2.Scene:
        mesh = box(shape, (1, 1, 1), (CUBE_M,) * 3)
        moved = Prescribed(mesh.where(lambda x, y, z: x < 1e-9), np.array([0, 0, amplitude_m]))
        scene = real_time(engine, Problem(mesh, tissue(law), [moved]))
        time_s = np.arange(0, duration_s + 1, 1 / (frequency_hz * points_a_period))
        for condition in scene.bodies[0].prescribed:
            condition.schedule.time_s.extend(time_s.tolist())
            condition.schedule.factor.extend(np.sin(2 * np.pi * frequency_hz * time_s).tolist())
        return scene

    def drive(engine: Engine, parts: Sequence[tuple[str, str]], duration_s: float) -> list[np.ndarray]:
        scene = side_by_side({f"{law}-{shape}": part(engine, law, shape, duration_s) for law, shape in parts})
        looks = 60
        with running(engine, scene) as scene_running:
            found = []
            for look in range(looks):
                # A different phase at each check.
                scene_running.step(round(duration_s / REAL_TIME_DT_S / looks) + look % 7)
                found.append([scene_running.displacement_m(body.name) for body in scene.bodies])
        return [np.array(of) for of in zip(*found, strict=True)]

    def compare(engine: Engine, parts: Sequence[tuple[str, str]], duration_s: float) -> dict[tuple[str, str], Found]:
        references = drive(Engine(engine.server, "double"), parts, duration_s)
        ours = drive(engine, parts, duration_s)
        return {
            of: Found([distance(one, reference)]) for of, one, reference in zip(parts, ours, references, strict=True)
        }

    def one(engine: Engine, of: tuple[str, str], duration_s: float, together: Shared[_Parts] | None) -> Found:
        return (together(engine) if together else compare(engine, [of], duration_s))[of]

    whole = [(law, shape) for law in LAWS for shape in ("tetrahedron", "hexahedron")]
    for duration_s, name, long in ((60.0, "a minute", False), (3600.0, "an hour", True)):
        together = Shared(partial(compare, parts=whole, duration_s=duration_s))
        for law, shape in whole:
            yield Case(
                HOUR,
                name,
                law,
                shape,
                partial(one, of=(law, shape), duration_s=duration_s, together=together if long else None),
                precisions=("float",),
                long=long,
                solves=round(2 * duration_s / REAL_TIME_DT_S),
                together=f"hour, {name}" if long else "",
            )
