"""Scenes that say how much load their tools bear, and what follows a step that cannot be made."""

from __future__ import annotations

import pytest

import tensormass as tm
from tensormass._shared import defaults
from tensormass.v1 import guard_pb2, scene_pb2


def test_a_guard_has_bounds_and_says_what_follows_a_fault() -> None:
    scene = tm.Scene()
    scene.set_guard(on_fault="go_on", max_move_m=1e-4)
    scene.set_guard(max_energy_ratio=8)
    assert scene.message.guard == guard_pb2.Guard(
        on_fault=guard_pb2.Guard.ON_FAULT_GO_ON, max_move_m=1e-4, max_energy_ratio=8
    )
    with pytest.raises(tm.InvalidArgumentError, match=r"set_guard: on_fault: unknown value 'go'; did you mean 'go_on'"):
        scene.set_guard(on_fault="go", max_move_m=1)  # type: ignore[arg-type]
    assert scene.message.guard.max_move_m == 1e-4, "a wrong argument changes nothing"
    for text in ("stop", "ON_FAULT_STOP"):
        read = tm.Scene.from_yaml(f"{{name: a, guard: {{on_fault: {text}}}}}").message
        assert read.guard.on_fault == guard_pb2.Guard.ON_FAULT_STOP
    with pytest.raises(tm.InvalidArgumentError, match=r"guard\.on_fault: unknown value 'halt'; .*go_on.*stop"):
        tm.Scene.from_yaml("{name: a, guard: {on_fault: halt}}")


def test_a_tool_says_what_it_bears_in_a_scene_file() -> None:
    tool = "spherical_probe: {radius_m: 0.01}, position_m: {z: 1}"
    scene = tm.Scene.from_yaml(f"{{name: a, tools: [{{name: probe, {tool}, max_force_n: 5, max_torque_n_m: 0.5}}]}}")
    assert (scene.message.tools[0].max_force_n, scene.message.tools[0].max_torque_n_m) == (5, 0.5)
    with pytest.raises(tm.InvalidArgumentError, match=r"max_torque_n_m: expected a number in N m, found 'much'"):
        tm.Scene.from_yaml(f"{{name: a, tools: [{{name: probe, {tool}, max_torque_n_m: much}}]}}")


def test_defaults_of_tools_and_of_a_fault_are_those_of_the_schema() -> None:
    tool = scene_pb2.Tool()
    assert defaults.largest_loads(tool) == (30, 1, 1)
    tool.max_force_n, tool.max_torque_n_m, tool.max_joint_load = 5, 0.5, 0.25
    assert defaults.largest_loads(tool) == (5, 0.5, 0.25)
    scene = scene_pb2.Scene(tools=[scene_pb2.Tool(fixed=True)])
    assert not defaults.goes_on_after_fault(scene), "no tool takes poses"
    scene.tools.add()
    assert defaults.goes_on_after_fault(scene)
    scene.guard.on_fault = guard_pb2.Guard.ON_FAULT_STOP
    assert not defaults.goes_on_after_fault(scene)
    scene.guard.on_fault = guard_pb2.Guard.ON_FAULT_GO_ON
    del scene.tools[:]
    assert defaults.goes_on_after_fault(scene)
    scene.solver.integrator = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
    assert not defaults.goes_on_after_fault(scene), "an equilibrium always stops"
