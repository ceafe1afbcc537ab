"""Attachments that are added and removed while a scene steps, through the whole daemon and with several clients."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_parts import small_daemon
from service_parts import DEADLINE_S, change_from_two_clients, record_changes

import tensormass as tm
from tensormass._src.streams import Transport
from tensormass.v1 import stream_pb2

#: A block that hangs from springs of 200 N/m below another one that is fixed; 0.108 kg.
SCENE = """
name: clipped
stepping: {dt_s: 0.005}
bodies:
  - name: above
    mesh: {grid: {origin_m: {z: 0.06}, size_m: {x: 0.06, y: 0.06, z: 0.03}, cells_x: 2, cells_y: 2, cells_z: 1}}
    law: {stable_neo_hookean: {young_modulus_pa: 200000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: -1, y: -1, z: 0.05}, max_m: {x: 1, y: 1, z: 1}}}]
  - name: below
    mesh: {grid: {size_m: {x: 0.06, y: 0.06, z: 0.03}, cells_x: 2, cells_y: 2, cells_z: 1}}
    law: {stable_neo_hookean: {young_modulus_pa: 200000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 20
    sets: [{name: top, regions: [{box: {min_m: {x: -1, y: -1, z: 0.029}, max_m: {x: 1, y: 1, z: 0.031}}}]}]
attachments:
  - name: ligament
    body: below
    region: {set: top}
    other: above
    other_region: {box: {min_m: {x: -1, y: -1, z: 0.059}, max_m: {x: 1, y: 1, z: 0.061}}}
    stiffness_n_per_m: 200
gravity_m_per_s2: {z: -9.81}
streams: {frame_rate_hz: 60}
editing: {}
"""
WEIGHT_N = 0.06 * 0.06 * 0.03 * 1000 * 9.81
TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")


def scene_of() -> tm.Scene:
    return tm.Scene.from_yaml(SCENE)


def bottom(scene: tm.SceneHandle) -> np.ndarray:
    """Nodes of the fixed block at which the other one hangs."""
    return np.flatnonzero(scene.positions("above")[:, 2] < 0.0601)


def clip(scene: tm.SceneHandle, name: str = "clip", **arguments: Any) -> None:  # noqa: ANN401
    scene.attach(name, "below", "top", "above", bottom(scene), **{"stiffness_n_per_m": 600.0, **arguments})


def names(scene: tm.SceneHandle) -> list[str]:
    return [attachment.name for attachment in scene.topology().attachments]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    """A daemon with both transports."""
    with small_daemon(zenoh=True) as server:
        yield server


def test_a_clip_takes_a_share_of_the_load(server: tm.Server) -> None:
    """In statics springs in parallel share a load by their stiffness; two that come later take that of more."""
    with server.load(scene_of(), lockstep=True) as scene:
        scene.step(600)
        hanging_m = scene.positions("below")[:, 2].mean()
        tensions_n = scene.frame().springs("ligament").tensions_n.sum()
        assert tensions_n == pytest.approx(WEIGHT_N, rel=0.01)
        clip(scene)
        assert names(scene) == ["ligament", "clip"]
        assert (scene.frame().springs("clip").tensions_n < 1e-5).all(), "it starts without a force"
        scene.step(20)
        assert scene.positions("below")[:, 2].mean() == pytest.approx(hanging_m, abs=1e-6)
        scene.edit(sever={"ligament": None})
        scene.step(600)
        frame = scene.frame()
        assert frame.springs("clip").tensions_n.sum() == pytest.approx(WEIGHT_N, rel=0.01)
        assert hanging_m - scene.positions("below")[:, 2].mean() == pytest.approx(WEIGHT_N / 600, rel=0.02)
        assert frame.springs("ligament").broken.all()
        scene.detach("clip")
        scene.step(20)
        assert scene.positions("below")[:, 2].mean() < hanging_m - 0.02, "nothing holds it any more"
        scene.reset()
        assert names(scene) == ["ligament"]
        assert scene.status().broken_springs == 0


def test_a_clip_closes_to_its_length(server: tm.Server) -> None:
    with server.load(scene_of(), lockstep=True) as scene:
        scene.step(200)
        clip(scene, stiffness_n_per_m=5000.0, rest_length_m=0.01)
        scene.step(400)
        lengths_m = scene.frame().springs("clip").lengths_m
        assert lengths_m.mean() == pytest.approx(0.01 + WEIGHT_N / 5000, rel=0.02)
        scene.reset()
        assert names(scene) == ["ligament"], "a reset takes it out"
        with pytest.raises(tm.NotFoundError, match="no attachment 'clip' was added"):
            scene.detach("clip")


def test_events_tell_which(server: tm.Server) -> None:
    with server.load(scene_of(), lockstep=True) as scene, scene.events(timeout_s=DEADLINE_S) as events:
        clip(scene, "first")
        clip(scene, "weak", rest_length_m=0, breaking_force_n=1e-3)
        scene.step(2)
        scene.detach("first", "weak")
        told = [next(events) for _ in range(5)]
        assert [(one.kind, one.attachment) for one in told] == [
            ("attachment_added", "first"),
            ("attachment_added", "weak"),
            ("broken", "weak"),
            ("attachment_removed", "first"),
            ("attachment_removed", "weak"),
        ]
        assert told[0].text == "attachment 'first' was added: 9 springs"


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_streams_follow(server: tm.Server, transport: Transport) -> None:
    with (
        server.load(scene_of()) as scene,
        tm.connect(server.address) as other,
        scene.frames(transport, timeout_s=DEADLINE_S) as frames,
    ):
        assert next(frames).springs("ligament").broken.sum() == 0
        clip(other.scene("clipped"))

        def until(done: Callable[[tm.Frame], bool]) -> tm.Frame:
            return next(frame for frame in frames if done(frame))

        frame = until(lambda one: len(one.topology.attachments) == 2)
        assert len(frame.springs("clip").ends_m) == 9
        other.scene("clipped").detach("clip")
        frame = until(lambda one: len(one.topology.attachments) == 1)
        assert len(frame.attachment_points) == 18
        # Who comes late sees the same.
        with other.scene("clipped").frames(transport, timeout_s=DEADLINE_S) as late:
            assert len(next(late).topology.attachments) == 1


def test_clients_at_the_same_time(server: tm.Server) -> None:
    """Each call is done as a whole, or refused."""
    with server.load(scene_of()) as scene:

        def change(other: tm.SceneHandle) -> None:
            clip(other)
            other.detach("clip")

        change_from_two_clients(server, scene, change)
        assert set(names(scene)) <= {"ligament", "clip"}
        assert scene.status().state == stream_pb2.SceneStatus.STATE_RUNNING


def test_a_snapshot_needs_its_attachments(server: tm.Server) -> None:
    with server.load(scene_of(), lockstep=True) as scene:
        scene.step(5)
        before = scene.snapshot()
        clip(scene)
        with pytest.raises(tm.FailedPreconditionError, match="or of other values"):
            scene.restore(before)
        scene.detach("clip")
        scene.restore(before)


def test_a_recording_is_repeated_and_shown(server: tm.Server, tmp_path: Path) -> None:
    def change(other: tm.SceneHandle) -> None:
        clip(other)
        time.sleep(0.2)
        other.detach("clip")

    with server.load(scene_of()) as scene:
        path = record_changes(server, scene, SCENE, tmp_path, change)
    from tensormass_tools.recording.index import RecordingIndex

    index = RecordingIndex(path)
    counts = set()
    for i in range(len(index.times_s)):
        frame = index.frame(i)
        topology = index.topology_of(frame)
        assert topology.version == frame.topology_version
        assert len(frame.attachment_points) == 12 * topology.attachment_point_count
        counts.add(len(topology.attachments))
    assert counts == {1, 2}
    assert {"attachment_added", "attachment_removed"} <= {mark.kind for mark in index.marks}
