"""The first steps of a scene, measured in a daemon."""

from __future__ import annotations

from pathlib import Path

from service_parts import BLOCK

import tensormass as tm
from tensormass.v1 import scene_pb2
from tensormass_tools.first_steps import measure
from tensormass_tools.hand import HandScript


def scene(text: str) -> scene_pb2.Scene:
    return tm.Scene.from_yaml(text).message


def test_steps_are_measured_and_leave_nothing_behind(server: tm.Server) -> None:
    found = measure(server, scene(BLOCK), None, 1.0)
    assert found is not None
    assert 0 < found.p50_s <= found.p99_s
    assert found.period_s == 0.005
    assert found.elements == 5 * 5 * 3 * 6
    assert server.scenes() == []


def test_a_hand_moves_the_tool(server: tm.Server, tmp_path: Path) -> None:
    script = tmp_path / "hand.yaml"
    script.write_text("""
tool: probe
poses:
  - {time_s: 0, position_m: {x: 0.05, y: 0.05, z: 0.08}}
  - {time_s: 10, position_m: {x: 0.05, y: 0.05, z: 0.06}}
""")
    assert measure(server, scene(BLOCK), HandScript.read(script), 1.0) is not None
    script.write_text(script.read_text().replace("tool: probe", "tool: nobody"))
    assert measure(server, scene(BLOCK), HandScript.read(script), 1.0) is None


def test_a_scene_that_stops_or_is_refused_has_no_measure(server: tm.Server) -> None:
    stops = BLOCK + "solver: {cg_max_iterations: 1, cg_tolerance: 1.0e-9, floor_tolerance: 1.0e-9}\n"
    assert measure(server, scene(stops), None, 1.0) is None
    refused = BLOCK.replace("density_kg_per_m3: 1000", "density_kg_per_m3: -1")
    assert measure(server, scene(refused), None, 1.0) is None
    assert server.scenes() == []


def test_one_step_to_equilibrium_has_no_measure(server: tm.Server) -> None:
    assert measure(server, tm.Scene.from_file("cantilever").message, None, 1.0) is None
