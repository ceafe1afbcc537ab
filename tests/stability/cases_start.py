"""Where a scene starts: stretched, flattened, collapsed, turned inside out, at random."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES, Floats
from accuracy.problem import Problem

from .case import CAUGHT, FELT, HOLDS, Case, Check, Found, Group
from .tissue import CUBE_M, RECOVERS, at_rest_again, clamped, cube, initial, real_time, running, tissue

START = Group(
    "start",
    "Where it starts",
    "A cube of 0.1 m, clamped on one side (or free), let go from a state far from rest, 60 steps a second for 10 s "
    "with a damping of 5 / s, implicit Euler linearized once. Must hold: every element is back at its rest volume (1 "
    "%), and of what was stored 10⁻⁴ E V is left at most: it has its shape again. Held to that: corotational and "
    "stable neo-Hookean, and every law where nothing is inverted; the others may say that they cannot.",
)
STEPS = 600
DAMPING_PER_S = 5.0
CENTRE = np.full(3, CUBE_M / 2)


def _random(x: Floats) -> Floats:
    return np.random.default_rng(3).uniform(0, CUBE_M, x.shape)


# Positions of the nodes from those at rest.
STARTS: dict[str, Callable[[Floats], Floats]] = {
    "stretched to 2×": lambda x: x * (2, 1, 1),
    "stretched to 10×": lambda x: x * (10, 1, 1),
    "pressed to 1/2": lambda x: x * (0.5, 1, 1),
    "pressed to 1/10": lambda x: x * (0.1, 1, 1),
    "flattened to a plane": lambda x: x * (1, 1, 0),
    "collapsed to a point": lambda x: x * 0 + CENTRE * (0, 1, 1),
    "inverted": lambda x: x * (-1, 1, 1),
    "at random": _random,
}
# Every element keeps det F > 0.
UPRIGHT = ("stretched to 2×", "stretched to 10×", "pressed to 1/2", "pressed to 1/10")


def start_cases() -> Iterator[Case]:
    def run(engine: Engine, name: str, law: str, shape: str, free: bool) -> Found:
        mesh = cube(shape)
        support = clamped(mesh)
        scene = real_time(engine, Problem(mesh, tissue(law), [] if free else [support]))
        scene.bodies[0].rayleigh_mass_per_s = DAMPING_PER_S
        moved = STARTS[name](mesh.nodes) - mesh.nodes
        if not free:
            moved[support.nodes] = 0
        initial(scene, displacement_m=moved)
        with running(engine, scene) as scene_running:
            for _ in range(10):
                scene_running.step(STEPS // 10)
            found = scene_running.state()
            checks = at_rest_again(found, mesh)
            if not free:
                checks.append(Check("|u| / L", float(np.abs(found.displacement_m).max() / CUBE_M), FELT))
            return Found(checks, scene_running.warnings)

    for name in STARTS:
        for free in (False, True):
            for law in LAWS:
                for shape in SHAPES:
                    held_to_it = law in RECOVERS or name in UPRIGHT
                    yield Case(
                        START,
                        name + (", free" if free else ""),
                        law,
                        shape,
                        lambda engine, name=name, law=law, shape=shape, free=free: run(engine, name, law, shape, free),
                        expects=(HOLDS,) if held_to_it else (HOLDS, CAUGHT),
                        quick=shape == "tetrahedron" and law in RECOVERS and not free,
                    )
