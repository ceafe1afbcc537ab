"""The server as a solver: a daemon of its own, used through the SDK."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

import tensormass as tm
from tensormass.v1 import scene_pb2

from .meshes import Floats
from .problem import Problem

BODY = "body"


@dataclass(frozen=True)
class Precision:
    """Tolerances of a scene's solver, as tight as the precision allows."""

    number: scene_pb2.Solver.Precision
    cg_tolerance: float
    newton_tolerance: float


PRECISIONS = {
    "double": Precision(scene_pb2.Solver.PRECISION_DOUBLE, 1e-12, 1e-10),
    "float": Precision(scene_pb2.Solver.PRECISION_FLOAT, 1e-6, 1e-5),
}
CG_ITERATIONS = 20_000
NEWTON_ITERATIONS = 50


@dataclass(frozen=True)
class State:
    """displacement_m, velocity_m_per_s, reaction_n: [node_count, 3]; cauchy_pa: [element_count, 6], xx yy zz yz xz xy;
    von_mises_pa, det_f: [element_count].
    """

    displacement_m: Floats
    velocity_m_per_s: Floats
    reaction_n: Floats
    cauchy_pa: Floats
    von_mises_pa: Floats
    det_f: Floats
    elastic_energy_j: float
    kinetic_energy_j: float


class Engine:
    """A daemon, and the precision of the scenes that it receives."""

    # Shared, because one daemon may hold scenes of several engines and names must differ.
    _numbers = itertools.count()

    def __init__(self, server: tm.Server, precision: str) -> None:
        self.server = server
        self.precision = precision

    def scene(self, problem: Problem, dt_s: float = 1.0) -> scene_pb2.Scene:
        """The problem as a quasi-static scene in lockstep; prescribed nodes move over `increments` steps."""
        scene = scene_pb2.Scene(name=f"accuracy-{next(self._numbers)}")
        scene.stepping.dt_s = dt_s
        scene.stepping.lockstep = True
        scene.streams.frame_rate_hz = 0
        precision = PRECISIONS[self.precision]
        scene.solver.precision = precision.number
        scene.solver.cg_tolerance = precision.cg_tolerance
        scene.solver.cg_max_iterations = CG_ITERATIONS
        scene.solver.newton_tolerance = precision.newton_tolerance
        scene.solver.newton_max_iterations = NEWTON_ITERATIONS
        scene.solver.integrator = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
        body = scene.bodies.add(name=BODY, mesh=problem.mesh.message(), law=problem.law.message)
        body.density_kg_per_m3 = problem.density_kg_per_m3
        body.quadrature = problem.quadrature
        _add_prescribed(body, problem, dt_s)
        for load in problem.tractions:
            x, y, z = load.traction_pa
            message = body.loads.add(traction_pa=scene_pb2.Vector3(x=x, y=y, z=z))
            message.region.nodes.indices.extend(load.nodes.tolist())
        for pressure in problem.pressures:
            message = body.loads.add(pressure_pa=pressure.pressure_pa)
            message.region.nodes.indices.extend(pressure.nodes.tolist())
        if problem.forces_n is not None:
            for node in np.flatnonzero(problem.forces_n.any(axis=1)).tolist():
                x, y, z = problem.forces_n[node].tolist()
                message = body.loads.add(force_n=scene_pb2.Vector3(x=x, y=y, z=z))
                message.region.nodes.indices.append(node)
        return scene

    def states(self, problem: Problem) -> Iterator[State]:
        """The state after each increment."""
        with self.loaded(self.scene(problem)) as handle:
            for _ in range(problem.increments):
                handle.step()
                yield state(handle)

    def equilibrium(self, problem: Problem) -> State:
        """The state after all increments."""
        *_, last = self.states(problem)
        return last

    @contextmanager
    def loaded(self, scene: scene_pb2.Scene) -> Iterator[tm.SceneHandle]:
        if self.precision == "float" and scene.solver.integrator == scene_pb2.Solver.INTEGRATOR_QUASI_STATIC:
            scene.solver.allow_unconverged = True  # rounding allows no tolerance this tight; the answer is what counts
        handle = self.server.load(scene)
        try:
            yield handle
        finally:
            handle.unload()


def _add_prescribed(body: scene_pb2.Body, problem: Problem, dt_s: float) -> None:
    """Adds boundary conditions: one message for all nodes with the same values; nodes that never move are `fixed`."""
    nodes_of: dict[tuple[float | None, ...], list[int]] = {}
    for node, row in enumerate(problem.prescribed().tolist()):
        given = tuple(None if np.isnan(value) else value for value in row)
        if any(value is not None for value in given):
            nodes_of.setdefault(given, []).append(node)
    for given, nodes in nodes_of.items():
        if given == (0, 0, 0):
            body.fixed.add().nodes.indices.extend(nodes)
            continue
        x, y, z = given
        message = body.prescribed.add(x_m=x, y_m=y, z_m=z)
        message.region.nodes.indices.extend(nodes)
        if problem.increments > 1 and any(given):
            message.schedule.time_s.extend([0, problem.increments * dt_s])
            message.schedule.factor.extend([0, 1])


def state(handle: tm.SceneHandle) -> State:
    """The fields that the cases compare."""
    fields = handle.fields(
        BODY, ("displacement", "velocity", "reaction_force", "cauchy_stress", "von_mises_stress", "det_f")
    )
    return State(
        fields["displacement"],
        fields["velocity"],
        fields["reaction_force"],
        fields["cauchy_stress"],
        fields["von_mises_stress"],
        fields["det_f"],
        fields.elastic_energy_j,
        fields.kinetic_energy_j,
    )
