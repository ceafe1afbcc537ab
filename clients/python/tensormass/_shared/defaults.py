"""Defaults of scene.proto: the values of fields that a scene leaves open."""

from __future__ import annotations

from typing import NamedTuple

from tensormass.v1 import guard_pb2, scene_pb2

_QUASI_STATIC = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC


def dt_s(scene: scene_pb2.Scene) -> float:
    """Returns the simulated time of a step [s]."""
    return scene.stepping.dt_s if scene.stepping.HasField("dt_s") else 1 / 60


def cg_max_iterations(solver: scene_pb2.Solver) -> int:
    """Returns the largest number of conjugate-gradient iterations in a solve."""
    if solver.HasField("cg_max_iterations"):
        return solver.cg_max_iterations
    return 10_000 if solver.integrator == _QUASI_STATIC else 100


def cg_tolerance(solver: scene_pb2.Solver) -> float:
    """Returns the residual, relative to the right-hand side, at which a solve ends."""
    if solver.HasField("cg_tolerance"):
        return solver.cg_tolerance
    return 1e-5 if solver.integrator == _QUASI_STATIC else 1e-3


def newton_max_iterations(solver: scene_pb2.Solver) -> int:
    """Returns the largest number of linearized solves in a step."""
    if solver.HasField("newton_max_iterations"):
        return solver.newton_max_iterations
    return 200 if solver.integrator == _QUASI_STATIC else 1


def newton_tolerance(solver: scene_pb2.Solver) -> float:
    """Returns the residual, as a share of the forces, at which a step ends."""
    if solver.HasField("newton_tolerance"):
        return solver.newton_tolerance
    return 1e-6 if solver.precision == scene_pb2.Solver.PRECISION_DOUBLE else 1e-3


def tangent_lag_steps(solver: scene_pb2.Solver) -> int:
    """Returns the number of steps from one evaluation of an element to the next."""
    return solver.tangent_lag_steps if solver.HasField("tangent_lag_steps") else 1


class LargestLoads(NamedTuple):
    """Loads of a tool above which it gives way."""

    force_n: float
    torque_n_m: float
    #: Of a joint [N m or N].
    joint_load: float


def largest_loads(tool: scene_pb2.Tool) -> LargestLoads:
    """Returns the loads above which a tool gives way."""
    return LargestLoads(
        tool.max_force_n if tool.HasField("max_force_n") else 30.0,
        tool.max_torque_n_m if tool.HasField("max_torque_n_m") else 1.0,
        tool.max_joint_load if tool.HasField("max_joint_load") else 1.0,
    )


def goes_on_after_fault(scene: scene_pb2.Scene) -> bool:
    """Returns whether a scene goes on where a step left its bounds and no retry stays within them."""
    if scene.solver.integrator == _QUASI_STATIC:
        return False
    if scene.guard.on_fault == guard_pb2.Guard.ON_FAULT_UNSPECIFIED:
        return any(not tool.fixed for tool in scene.tools)
    return scene.guard.on_fault == guard_pb2.Guard.ON_FAULT_GO_ON


def scheduled_s(scene: scene_pb2.Scene) -> float:
    """Returns when the last schedule ends [s], of prescribed displacements, loads and gravity; 0 without one."""
    schedules = [scene.gravity_schedule]
    for body in scene.bodies:
        schedules += [prescribed.schedule for prescribed in body.prescribed]
        schedules += [load.schedule for load in body.loads]
    return max(max(schedule.time_s, default=0.0) for schedule in schedules)
