"""Tools that jump, and tools that press and hold."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from accuracy.engine import Engine
from accuracy.laws import LAWS
from accuracy.meshes import box
from accuracy.problem import Prescribed, Problem
from tensormass.v1 import scene_pb2

from .case import CAUGHT, FELT, HOLDS, Case, Check, Found, Group
from .tissue import CUBE_M, RECOVERS, at_rest_again, law_says, real_time, running, tissue

TOOL = Group(
    "tool",
    "Tools",
    "shape restored, zero force after leaving; pressed: steady force equal to the reaction, to 1 %",
    "A cube of 0.1 m in 3 × 3 × 3 cells, clamped at its bottom, damping of 5 / s, and a probe of 15 mm, 60 steps a "
    "second. *Through*: the probe moves through the middle and back at 0.5 m/s, five times. *Teleported*: without a "
    "speed limit, from one side to the other in every step, or into the middle in every second step, 120 steps. Must "
    "hold: 5 s after the tool has left, every element has its volume and shape again, as under “Where it starts”, and "
    "the force on the tool is zero. *Pressed*: 10, 25, 50 mm into the top for 10 s. Must hold: over the last second "
    "the force is steady to 1 %, and it equals the reaction at the bottom, to 1 %.",
)
RADIUS_M = 0.015
DAMPING_PER_S = 5.0
# Below this force the tissue has moved out of the tool's way, and neither check holds.
LEAST_FORCE_N = 1e-6
UNLIMITED_M_PER_S = 1000.0
Point = tuple[float, float, float]
SIDES = ((-0.05, 0.05, 0.06), (0.15, 0.05, 0.06))
MIDDLE = (0.05, 0.05, 0.06)
AWAY = (0.05, 0.05, 0.5)
AWAY_STEPS = 300


def tool_cases() -> Iterator[Case]:
    def scene_of(engine: Engine, law: str, shape: str, speed_m_per_s: float) -> tuple[scene_pb2.Scene, Problem]:
        mesh = box(shape, (3, 3, 3), (CUBE_M,) * 3)
        bottom = Prescribed(mesh.where(lambda x, y, z: z < 1e-9), np.zeros(3))
        problem = Problem(mesh, tissue(law), [bottom])
        scene = real_time(engine, problem)
        scene.bodies[0].rayleigh_mass_per_s = DAMPING_PER_S
        probe = scene.tools.add(name="probe", max_speed_m_per_s=speed_m_per_s)
        probe.spherical_probe.radius_m = RADIUS_M
        probe.position_m.x, probe.position_m.y, probe.position_m.z = SIDES[0]
        return scene, problem

    def visit(
        engine: Engine, law: str, shape: str, speed: float, stops: list[tuple[float, float, float]], steps_each: int
    ) -> Found:
        scene, problem = scene_of(engine, law, shape, speed)
        with running(engine, scene) as scene_running:
            for stop in stops:
                scene_running.handle.move_tool("probe", stop)
                scene_running.step(steps_each)
            scene_running.handle.move_tool("probe", AWAY)
            scene_running.step(AWAY_STEPS)
            force = float(np.linalg.norm(scene_running.handle.feedback("probe").force_n))
            found = scene_running.state()
            return Found(
                [*at_rest_again(found, problem.mesh), Check("force [N]", force, 0)], scene_running.last_warnings
            )

    def press(engine: Engine, law: str, shape: str, depth_m: float) -> Found:
        scene, problem = scene_of(engine, law, shape, 0.5)
        (bottom,) = problem.conditions
        start = scene.tools[0].position_m
        start.x, start.y, start.z = 0.05, 0.05, CUBE_M + RADIUS_M + 0.005
        with running(engine, scene) as scene_running:
            scene_running.handle.move_tool("probe", (0.05, 0.05, CUBE_M + RADIUS_M - depth_m))
            scene_running.step(540)
            forces = []
            for _ in range(60):
                scene_running.step()
                forces.append(scene_running.handle.feedback("probe").force_n)
            held = scene_running.state().reaction_n[bottom.nodes].sum(axis=0)
            size = max(float(np.linalg.norm(forces[-1])), LEAST_FORCE_N)
            swing = float(np.ptp(np.array(forces), axis=0).max()) / size
            balance = float(np.linalg.norm(held - forces[-1])) / size
            return Found(
                [
                    Check("the tool is not felt", float(size <= LEAST_FORCE_N), 0),
                    Check("swing of the force", swing, FELT),
                    Check("action − reaction", balance, FELT),
                ],
                scene_running.last_warnings,
            )

    tours = {
        "through": (0.5, [SIDES[1], SIDES[0]] * 5, 30),
        "teleported from side to side": (UNLIMITED_M_PER_S, [SIDES[1], SIDES[0]] * 60, 1),
        "teleported into the middle": (UNLIMITED_M_PER_S, [MIDDLE, SIDES[0]] * 60, 1),
    }
    for shape in ("tetrahedron", "hexahedron"):
        for law in LAWS:
            for name, (speed, stops, steps_each) in tours.items():
                yield Case(
                    TOOL,
                    name,
                    law,
                    shape,
                    partial(visit, law=law, shape=shape, speed=speed, stops=stops, steps_each=steps_each),
                    expects=(HOLDS,) if law in RECOVERS else (HOLDS, CAUGHT),
                    names=law_says(law),
                    quick=shape == "tetrahedron" and law == "stable_neo_hookean",
                    solves=len(stops) * steps_each + AWAY_STEPS,
                )
            for depth_m in (0.01, 0.025, 0.05):
                yield Case(
                    TOOL,
                    f"pressed {1000 * depth_m:g} mm and held",
                    law,
                    shape,
                    partial(press, law=law, shape=shape, depth_m=depth_m),
                    expects=(HOLDS,) if depth_m < 0.02 and law != "hooke" else (HOLDS, CAUGHT),
                    names=law_says(law),
                    solves=600,
                )
