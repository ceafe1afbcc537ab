"""Extreme stiffness, Poisson's ratio and density, alone and next to each other."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from accuracy.cases_homogeneous import STEPS as PULLED_STEPS
from accuracy.cases_homogeneous import free_sides_stretch, pulled
from accuracy.engine import BODY, Engine, state
from accuracy.laws import LAWS, Law
from accuracy.meshes import SHAPES, Floats, Mesh, box
from accuracy.problem import Prescribed, Problem, node_areas
from tensormass.v1 import scene_pb2

from .case import CURVATURE, FELT, REFUSED, Case, Check, Found, Group
from .cases_steps import DAMPING_PER_S, NEWTON_SOLVES, settle, settles, settling_steps
from .tissue import (
    CUBE_M,
    NEWTON_SAYS,
    REAL_TIME_DT_S,
    YOUNG_PA,
    clamped,
    cube,
    law_says,
    nodal_weight,
    real_time,
    running,
    tissue,
)

STIFFNESS = Group(
    "stiffness",
    "Stiffness",
    "as above, E from 10 Pa to 100 GPa",
    "The clamped cube under a load of 0.2 E on its section, for E from 10 Pa to 100 GPa. Procedure and bounds are "
    "those of “Length of a step”.",
)
JUMP = Group(
    "jump",
    "Jumps of stiffness",
    "closed form to 10⁻⁶ (float, real time 1 %) across a 10⁶ jump",
    "A column of 0.1 m that can only move along its axis. One half, or every second layer, is 10⁶ times as stiff as "
    "the rest. Its end is pressed with 10 % of the soft modulus. In equilibrium each layer has the stretch that its "
    "law gives for that stress, which is a closed form. Must hold: the displacement of every node to 10⁻⁶ of the "
    "largest (1 % in float and in real time).",
)
POISSON = Group(
    "poisson",
    "Poisson's ratio",
    "force and width as the closed form, to 10⁻⁶ (float 1 %)",
    "A cube on three planes of symmetry, pulled to 1.1 of its length by Newton's method. Must hold: force and width "
    "equal the closed form of the law, to 10⁻⁶ (1 % in float).",
)
DENSITY = Group(
    "density",
    "Densities side by side",
    "a light body beside a heavy one moves as alone, to 1 %",
    "Two clamped cubes in one scene, 10 and 10⁶ kg/m³, each under its own weight in a gravity of 1 m/s² for 1/6 s. In "
    "that time the heavy one still falls, while the light one has long come to rest, 300 times less far down. Must "
    "hold: the light one moves as it does alone, to 1 % of its displacement, at 10 checks.",
)
PULLED = 1.1
NEWTON_BOUND = {"double": 1e-6, "float": FELT}


def material_cases() -> Iterator[Case]:
    yield from _stiffness_cases()
    yield from _jump_cases()
    yield from _poisson_cases()
    yield from _density_cases()


def _stiffness_cases() -> Iterator[Case]:
    def run(engine: Engine, law: str, shape: str, young_pa: float) -> Found:
        mesh = cube(shape)
        forces = nodal_weight(mesh, young_pa / YOUNG_PA)
        problem = Problem(mesh, tissue(law, young_pa), [clamped(mesh)], forces_n=forces)
        # A soft cube swings slower, with √E. A stiff one is at rest after a few steps of this length.
        slower = max(1.0, float(np.sqrt(YOUNG_PA / young_pa)))
        return settle(engine, problem, REAL_TIME_DT_S * slower, damping_per_s=DAMPING_PER_S / slower)

    for young_pa, name in ((10, "10 Pa"), (1e3, "1 kPa"), (1e6, "1 MPa"), (1e9, "1 GPa"), (1e11, "100 GPa")):
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    STIFFNESS,
                    name,
                    law,
                    shape,
                    partial(run, law=law, shape=shape, young_pa=young_pa),
                    expects=settles(law),
                    names=law_says(law),
                    quick=shape == "tetrahedron" and young_pa in (10, 1e11),
                    solves=settling_steps(REAL_TIME_DT_S),
                )


def _confined_stretch(law: Law, stress_pa: float) -> float:
    """The stretch along x under a stress, without displacement across, by bisection."""
    low, high = 0.5, 1.5
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if law.pull(np.array([middle, 1, 1]))[0] > stress_pa else (middle, high)
    return middle


def _jump_cases() -> Iterator[Case]:
    ratio, layers = 1e6, 4

    def run(engine: Engine, name: str, law: str, shape: str, newton: bool) -> Found:
        mesh = box(shape, (layers, 2, 2), (CUBE_M,) * 3)
        is_stiff = [layer >= layers // 2 if name.startswith("halves") else layer % 2 == 1 for layer in range(layers)]
        soft, stiff = tissue(law), tissue(law, YOUNG_PA * ratio)
        stress_pa = -0.1 * YOUNG_PA
        stretches = {True: _confined_stretch(stiff, stress_pa), False: _confined_stretch(soft, stress_pa)}
        exact = _column(mesh, [stretches[one] for one in is_stiff])
        guides = [Prescribed(np.arange(len(mesh.nodes)), np.array([np.nan, 0, 0])), clamped(mesh)]
        problem = Problem(mesh, soft, guides, forces_n=_end_load(mesh, stress_pa))
        scene = engine.scene(problem) if newton else real_time(engine, problem)
        if newton:
            scene.solver.ClearField("newton_tolerance")  # the daemon's default
        else:
            scene.bodies[0].rayleigh_mass_per_s = 50
        width_m = CUBE_M / layers
        for layer in np.flatnonzero(is_stiff).tolist():
            part = scene.bodies[0].law_regions.add(law=stiff.message)
            part.region.box.min_m.x, part.region.box.max_m.x = (layer - 1e-6) * width_m, (layer + 1 + 1e-6) * width_m
            part.region.box.max_m.y = part.region.box.max_m.z = CUBE_M
        with running(engine, scene) as scene_running:
            scene_running.step(1 if newton else 240)
            ours = scene_running.state().displacement_m
            bound = NEWTON_BOUND[engine.precision] if newton else FELT
            error = float(np.abs(ours - exact).max() / np.abs(exact).max())
            return Found([Check("distance to the closed form", error, bound)], scene_running.last_warnings)

    rounding = "the jump uses 6 of float's 7 digits: the step ends above its tolerance, and the status says so"
    names = (("halves", True), ("layers", True), ("halves, real time", False), ("layers, real time", False))
    for name, newton in names:
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    JUMP,
                    name,
                    law,
                    shape,
                    partial(run, name=name, law=law, shape=shape, newton=newton),
                    short={"float": rounding} if newton or shape == "quadratic_hexahedron" else {},
                    names=NEWTON_SAYS if newton else (CURVATURE,),
                    solves=NEWTON_SOLVES if newton else 240,
                )


def _column(mesh: Mesh, stretches: list[float]) -> Floats:
    """Displacements [node_count, 3] m of a column whose layers have these stretches along x."""
    edges = np.linspace(0, CUBE_M, len(stretches) + 1)
    moved = np.concatenate([[0], np.cumsum((np.array(stretches) - 1) * np.diff(edges))])
    out = np.zeros(mesh.nodes.shape)
    out[:, 0] = np.interp(mesh.nodes[:, 0], edges, moved)
    return out


def _end_load(mesh: Mesh, stress_pa: float) -> Floats:
    """Nodal forces [node_count, 3] N of a traction on the end at x = CUBE_M."""
    end = mesh.where(lambda x, y, z: x > CUBE_M * (1 - 1e-9))
    out = np.zeros(mesh.nodes.shape)
    out[:, 0] = stress_pa * node_areas(mesh, end)
    return out


def pull(engine: Engine, mesh: Mesh, law: Law) -> Found:
    """Pulls a box, CUBE_M long, on three planes of symmetry to PULLED of its length by Newton's method."""
    section_m2 = float(np.prod(np.ptp(mesh.nodes[:, 1:], axis=0)))
    end = mesh.where(lambda x, y, z: x > CUBE_M * (1 - 1e-6))
    problem = pulled(mesh, law, PULLED)
    side = free_sides_stretch(law, PULLED)
    force = float(law.pull(np.array([PULLED, side, side]))[0])
    bound = NEWTON_BOUND[engine.precision]
    with running(engine, engine.scene(problem)) as scene_running:
        scene_running.step(problem.increments)
        found = scene_running.state()
    stress_pa = float(found.reaction_n[end, 0].sum()) / section_m2
    narrower = found.displacement_m[:, 1] - (side - 1) * mesh.nodes[:, 1]
    checks = [
        Check("force", abs(stress_pa / force - 1), bound),
        Check("width", float(np.abs(narrower).max()) / (CUBE_M * (PULLED - 1)), bound),
    ]
    return Found(checks, scene_running.last_warnings)


def _poisson_cases() -> Iterator[Case]:
    def run(engine: Engine, law: str, shape: str, poisson: float) -> Found:
        return pull(engine, box(shape, (1, 1, 1), (CUBE_M,) * 3), tissue(law, poisson_ratio=poisson))

    def refused(engine: Engine, law: str, poisson: float) -> Found:
        mesh = box("hexahedron", (1, 1, 1), (CUBE_M,) * 3)
        scene = engine.scene(Problem(mesh, tissue(law), [clamped(mesh)]))
        getattr(scene.bodies[0].law, law).poisson_ratio = poisson
        with running(engine, scene):
            raise AssertionError("it was admitted")

    for poisson in (-0.999, -0.5, 0.0, 0.3, 0.45, 0.49, 0.499, 0.4999):
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    POISSON,
                    f"{poisson:g}",
                    law,
                    shape,
                    partial(run, law=law, shape=shape, poisson=poisson),
                    names=NEWTON_SAYS,
                    quick=shape == "hexahedron" and poisson in (-0.5, 0.4999),
                    solves=PULLED_STEPS * NEWTON_SOLVES,
                )
    for poisson in (-1.0, 0.5):
        for law in LAWS:
            if law in ("mooney_rivlin", "ogden"):
                continue  # defined by a bulk modulus instead
            yield Case(
                POISSON,
                f"{poisson:g}",
                law,
                "hexahedron",
                partial(refused, law=law, poisson=poisson),
                expects=(REFUSED,),
            )


def _density_cases() -> Iterator[Case]:
    # With less gravity, float's rounding of det F would exceed the light one's strains.
    light_kg_per_m3, heavy_kg_per_m3, gravity_m_per_s2, looks = 10.0, 1e6, 1.0, 10

    def scene_of(engine: Engine, law: str, shape: str, dt_s: float) -> scene_pb2.Scene:
        mesh = cube(shape)
        problem = Problem(mesh, tissue(law), [clamped(mesh)], density_kg_per_m3=light_kg_per_m3)
        scene = real_time(engine, problem, dt_s)
        scene.gravity_m_per_s2.z = -gravity_m_per_s2
        return scene

    def moves(engine: Engine, scene: scene_pb2.Scene, steps: int) -> Floats:
        with engine.loaded(scene) as handle:
            found = []
            for _ in range(looks):
                handle.step(steps)
                found.append(state(handle).displacement_m)
            return np.array(found)

    def run(engine: Engine, law: str, shape: str, steps: int, cg_tolerance: float | None) -> Found:
        scene = scene_of(engine, law, shape, REAL_TIME_DT_S / steps)
        alone = moves(engine, scene, steps)
        together = scene_pb2.Scene()
        together.CopyFrom(scene)
        if cg_tolerance is not None:
            together.solver.cg_tolerance = cg_tolerance
        heavy = together.bodies.add()
        heavy.CopyFrom(scene.bodies[0])
        heavy.name = "heavy"
        heavy.density_kg_per_m3 = heavy_kg_per_m3
        assert together.bodies[0].name == BODY
        error = float(np.abs(moves(engine, together, steps) - alone).max() / np.abs(alone).max())
        return Found([Check("distance to the motion alone", error, FELT)])

    little = (
        "conjugate gradients stop at 10⁻³ of the whole scene's residual, little of it the light body's; "
        "`cg_tolerance: 1e-4` mends it"
    )
    bodies = "10 and 10⁶ kg/m³"
    # steps: between two checks
    for name, steps, cg_tolerance in (
        (bodies, 1, None),
        (f"{bodies}, cg_tolerance 10⁻⁴", 1, 1e-4),
        (f"{bodies}, 1000 / s", 17, None),
    ):
        for law in LAWS:
            for shape in SHAPES:
                yield Case(
                    DENSITY,
                    name,
                    law,
                    shape,
                    partial(run, law=law, shape=shape, steps=steps, cg_tolerance=cg_tolerance),
                    short={"": little} if (steps, cg_tolerance) == (1, None) else {},
                    solves=2 * looks * steps,
                )
