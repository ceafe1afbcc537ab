"""Tools that are added and removed while a scene steps, through the whole daemon and with several clients."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_parts import small_daemon
from service_parts import BLOCK, DEADLINE_S, block, change_from_two_clients, record_changes

import tensormass as tm
from tensormass._src.streams import Transport
from tensormass.v1 import stream_pb2

HOOK: dict[str, Any] = {"position_m": (0.02, 0.02, 0.09), "radius_m": 0.01}
TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")


def names(scene: tm.SceneHandle) -> list[str]:
    return [tool.name for tool in scene.topology().tools]


def until(done: Callable[[], Any]) -> Any:  # noqa: ANN401
    """Asks again until the answer is true."""
    deadline = time.monotonic() + DEADLINE_S
    while not (answer := done()):
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return answer


def test_a_tool_comes_presses_and_goes(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.step(3)
        version = scene.topology().version
        scene.add_tool("hook", "spherical_probe", **HOOK)
        assert names(scene) == ["probe", "hook"]
        assert scene.topology().version > version
        assert scene.step(20).step == 23
        scene.move_tool("hook", (0.02, 0.02, 0.055))
        scene.step(40)
        assert scene.feedback("hook").force_n[2] > 0
        assert scene.feedback("probe").force_n[2] == 0
        assert [tool.tool for tool in scene.status().tools] == ["probe", "hook"]
        assert scene.frame().tools["hook"].touching
        pressed_m = scene.positions("tissue")[:, 2].sum()
        scene.remove_tool("hook")
        with pytest.raises(tm.NotFoundError, match="has no tool 'hook'; it has: probe"):
            scene.feedback("hook")
        with pytest.raises(tm.NotFoundError, match="has no tool 'hook'"):
            scene.move_tool("hook", (0, 0, 1))
        scene.remove_tool("probe")
        assert names(scene) == []
        assert scene.step(50).tools == []
        assert scene.positions("tissue")[:, 2].sum() > pressed_m, "tissue springs back"
        scene.reset()
        assert names(scene) == [], "a reset keeps the tools"
        scene.add_tool("hook", "capsule", position_m=(0.05, 0.05, 0.2), radius_m=0.005, length_m=0.1)
        scene.move_tool("hook", (0.05, 0.05, 0.1))
        assert scene.step(5).tools[0].tool == "hook"


def test_events_tell_which(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene, scene.events(timeout_s=DEADLINE_S) as events:
        scene.add_tool("hook", "spherical_probe", **HOOK)
        scene.remove_tool("probe")
        first, second = next(events), next(events)
        assert (first.kind, first.tool, first.text) == ("tool_added", "hook", "tool 'hook' was added")
        assert (second.kind, second.tool, second.text) == ("tool_removed", "probe", "tool 'probe' was removed")
        with scene.events(timeout_s=DEADLINE_S) as late:
            assert [next(late).tool, next(late).tool] == ["hook", "probe"]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    """A daemon with both transports."""
    with small_daemon(zenoh=True) as server:
        yield server


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_streams_follow(server: tm.Server, transport: Transport) -> None:
    with (
        server.load(block()) as scene,
        tm.connect(server.address) as other,
        scene.frames(transport, timeout_s=DEADLINE_S) as frames,
        scene.feedbacks("probe", transport) as felt,
    ):
        assert set(next(frames).tools) == {"probe"}
        other.scene("block").add_tool("hook", "spherical_probe", **HOOK)
        frame = until(lambda: next((one for one in frames if len(one.tools) == 2), None))
        assert set(frame.tools) == {"probe", "hook"}
        with scene.tool_stream("hook", transport, valid_for_s=0.5) as poses, scene.feedbacks("hook", transport) as hook:
            for _ in range(20):
                poses.send((0.02, 0.02, 0.055))
                time.sleep(0.01)
            until(lambda: hook.receive(DEADLINE_S).claimed)
            other.scene("block").remove_tool("hook")
            last = until(lambda: next(iter([one for one in [hook.receive(DEADLINE_S)] if one.removed]), None))
            assert last.force_n.z == 0
            poses.send((0.02, 0.02, 0.055))  # nobody takes it
            # Added again, the name is this client's to claim.
            other.scene("block").add_tool("hook", "spherical_probe", **HOOK)

            def claims() -> bool:
                poses.send((0.02, 0.02, 0.06))
                return hook.receive(DEADLINE_S).claimed

            until(claims)
        assert felt.receive(DEADLINE_S).tool == "probe"
        # Who comes late sees the same.
        with other.scene("block").frames(transport, timeout_s=DEADLINE_S) as late:
            assert set(next(late).tools) == {"probe", "hook"}


def test_refuses_in_words(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.step(2)
        before = scene.positions("tissue")
        with pytest.raises(tm.AlreadyExistsError, match=r"edit.add_tools\[0\]: the scene has a tool 'probe' already"):
            scene.add_tool("probe", "spherical_probe", **HOOK)
        with pytest.raises(tm.NotFoundError, match=r"edit.remove_tools\[1\]: .*no tool 'needle'; it has: probe"):
            scene.remove_tool("probe", "needle")
        with pytest.raises(tm.InvalidArgumentError, match="radius_m"):
            scene.add_tool("hook", "spherical_probe", position_m=(0, 0, 1), radius_m=-1)
        with pytest.raises(tm.InvalidArgumentError, match="cautery"):
            scene.add_tool("hook", "spherical_probe", **HOOK, cautery_power_w=30)
        with pytest.raises(tm.InvalidArgumentError, match="there is no kind 'hok'"):
            scene.add_tool("hook", "hok", **HOOK)
        with pytest.raises(tm.InvalidArgumentError, match="is empty"):
            scene.remove_tool()
        for i in range(15):
            scene.add_tool(f"t{i}", "spherical_probe", **HOOK)
        with pytest.raises(tm.ResourceExhaustedError, match="limits::kMaxTools = 16"):
            scene.add_tool("hook", "spherical_probe", **HOOK)
        assert (scene.positions("tissue") == before).all()


def test_findings_of_a_tool_inside_tissue(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        findings = scene.add_tool("deep", "spherical_probe", position_m=(0.05, 0.05, 0.025), radius_m=0.015)
        assert {finding.tool for finding in findings} == {"deep"}
        assert "tool_inside_tissue" in {tm.FindingWarning(finding).code for finding in findings}
        scene.step(60)


def test_clients_at_the_same_time(server: tm.Server) -> None:
    """Each call is done as a whole, or refused."""
    with server.load(block()) as scene:

        def change(other: tm.SceneHandle) -> None:
            other.add_tool("hook", "spherical_probe", **HOOK)
            other.remove_tool("hook")

        change_from_two_clients(server, scene, change)
        assert set(names(scene)) <= {"probe", "hook"}
        assert scene.status().state == stream_pb2.SceneStatus.STATE_RUNNING


def test_a_recording_is_repeated_and_shown(server: tm.Server, tmp_path: Path) -> None:
    def change(other: tm.SceneHandle) -> None:
        other.add_tool("hook", "spherical_probe", **HOOK)
        other.move_tool("hook", (0.02, 0.02, 0.055))
        time.sleep(0.2)
        other.remove_tool("hook")

    with server.load(block()) as scene:
        path = record_changes(server, scene, BLOCK, tmp_path, change)
    from tensormass_tools.recording.index import RecordingIndex

    index = RecordingIndex(path)
    counts = {len(index.frame(i).tools) for i in range(len(index.times_s))}
    assert counts == {1, 2}
    for i in range(len(index.times_s)):
        frame = index.frame(i)
        assert [tool.name for tool in index.topology_of(frame).tools] == [tool.tool for tool in frame.tools]
    assert {"tool_added", "tool_removed"} <= {mark.kind for mark in index.marks}
