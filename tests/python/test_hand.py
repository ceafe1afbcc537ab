"""The scripts of `tensormass hand`."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

import tensormass as tm
from tensormass._src.demo import builtin_scene, builtin_scenes
from tensormass_tools.hand import ClaimWatch, HandScript, script_of, scripts_of

SCRIPT = """
tool: probe
poses:
  - {time_s: 0, position_m: {x: 0.1}, orientation: {w: 1}, joint_values: [0.2]}
  - {time_s: 1, position_m: {x: 0.3, z: 0.1}, orientation: {w: 2, z: 2}, joint_values: [0.8]}
  - {time_s: 1.5, position_m: {x: 0.3, z: 0.1}}
  - {time_s: 3, position_m: {x: 0.1}, orientation: {w: 1}, joint_values: [0.2]}
"""


def read(folder: Path, text: str) -> HandScript:
    path = folder / "hand.yaml"
    path.write_text(text)
    return HandScript.read(path)


def test_a_script_passes_through_its_poses_and_starts_again(tmp_path: Path) -> None:
    script = read(tmp_path, SCRIPT)
    quarter = np.array([1, 0, 0, 1]) / np.sqrt(2)
    for time_s, position, orientation, joint in (
        (0, (0.1, 0, 0), (1, 0, 0, 0), 0.2),
        (1, (0.3, 0, 0.1), quarter, 0.8),
        (1.3, (0.3, 0, 0.1), quarter, 0.8),
        (4, (0.3, 0, 0.1), quarter, 0.8),
    ):
        at = script.at(time_s)
        np.testing.assert_allclose(at.position_m, position, atol=1e-12)
        np.testing.assert_allclose(at.orientation, orientation, atol=1e-12)
        np.testing.assert_allclose(at.joint_values, [joint], atol=1e-12)
    middle = script.at(0.5)
    np.testing.assert_allclose(middle.position_m, (0.2, 0, 0.05), atol=1e-12)
    np.testing.assert_allclose(middle.orientation, (np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)), atol=1e-12)
    np.testing.assert_allclose(middle.joint_values, [0.5], atol=1e-12)


def test_orientation_and_joints_may_be_left_out(tmp_path: Path) -> None:
    script = read(tmp_path, "tool: a\nposes: [{time_s: 0, position_m: {}}, {time_s: 1, position_m: {x: 1}}]")
    at = script.at(0.5)
    np.testing.assert_allclose(at.orientation, (1, 0, 0, 0))
    assert at.joint_values.size == 0


def test_a_tool_starts_and_stops_smoothly(tmp_path: Path) -> None:
    script = read(tmp_path, SCRIPT)
    times = np.arange(0, 3, 1e-3)
    positions = np.array([script.at(t)[0] for t in times])
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 1e-3
    assert speeds.max() < 0.5
    assert np.abs(np.diff(speeds)).max() < 2.5e-3, "no jump of the velocity"
    assert speeds[0] < 1e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tool: a\nposes: [", "not valid YAML"),
        ("tool: a", "the two fields tool and poses"),
        ("tool: a\nposes: [{time_s: 0, position_m: {}}]", "a list of two or more"),
        ("tool: a\nposes: [{time_s: 0}, {time_s: 1}]", r"poses\[0\]: expected time_s, position_m"),
        ("tool: a\nposes: [{time_s: 1, position_m: {}}, {time_s: 2, position_m: {}}]", "times start at 0"),
        ("tool: a\nposes: [{time_s: 0, position_m: {}}, {time_s: 0, position_m: {}}]", r"poses\[1\].time_s: 0; times"),
        ("tool: a\nposes: [{time_s: 0, position_m: {}}, {time_s: .nan, position_m: {}}]", "expected seconds, got nan"),
        (
            "tool: a\nposes: [{time_s: 0, position_m: {u: 1}}, {time_s: 1, position_m: {}}]",
            r"poses\[0\].position_m: Vector3 has no field 'u'",
        ),
        (
            "tool: a\nposes: [{time_s: 0, position_m: {}, orientation: {w: 0}}, {time_s: 1, position_m: {}}]",
            r"poses\[0\].orientation",
        ),
        (
            "tool: a\nposes: [{time_s: 0, position_m: {}}, {time_s: 1, position_m: {}, joint_values: [1]}]",
            r"poses\[1\].joint_values: expected as many",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(tm.InvalidArgumentError, match=message):
        read(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(tm.NotFoundError, match=r"none.yaml: No such file"):
        HandScript.read(tmp_path / "none.yaml")


def test_each_scripted_hand_moves_a_tool_of_its_scene() -> None:
    scripted = [name for name in builtin_scenes() if script_of(name) is not None]
    assert "retract" in scripted
    for name in scripted:
        found = builtin_scene(name)
        assert found is not None
        scene = tm.Scene.from_file(found[0].stem)
        for named, path in scripts_of(name).items():
            script = HandScript.read(path)
            assert script.tool == named
            (tool,) = [tool for tool in scene.message.tools if tool.name == named]
            start = np.array([tool.position_m.x, tool.position_m.y, tool.position_m.z])
            np.testing.assert_allclose(script.positions_m[0], start), "the tool does not jump"
            np.testing.assert_allclose(script.positions_m[-1], start)
            np.testing.assert_allclose(script.joint_values[[0, -1]], [tool.joint_values] * 2)
    assert script_of("demo") is None


def test_a_hand_is_told_that_another_client_holds_its_tool(server: tm.Server) -> None:
    mesh = tm.grid([4, 4, 4], [0.03, 0.03, 0.03])
    block = tm.Scene("block")
    block.add_body(
        "block",
        mesh,
        law="stable_neo_hookean",
        young_modulus_pa=5e3,
        poisson_ratio=0.4,
        density_kg_per_m3=1000,
        fixed_nodes=mesh.nodes[:, 2] < 1e-9,
    )
    above_m = (0.015, 0.015, 0.2)
    block.add_tool("probe", "spherical_probe", position_m=above_m, radius_m=0.01)
    with (
        server.load(block, lockstep=True) as scene,
        scene.tool_stream("probe", valid_for_s=60) as first,
        scene.tool_stream("probe", valid_for_s=60) as second,
    ):
        watch = ClaimWatch(scene, "probe", second.client_id)
        assert watch.check() is None
        ends = time.monotonic() + 30
        while scene.feedback("probe").client_id != first.client_id:
            assert time.monotonic() < ends
            first.send(above_m)
            scene.step()
        assert "another client holds this tool" in str(watch.check())
        assert watch.check() is None, "once"
        assert ClaimWatch(scene, "probe", first.client_id).check() is None
