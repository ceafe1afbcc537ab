"""Surfaces that change while a scene steps, and events: what the SDK makes of their messages."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from asynchronous import asynchronous
from changing_scene import (
    FAN,
    NOTHING,
    VERSION,
    ChangingScene,
    Face,
    body_changes,
    changes,
    events,
    faces_of,
    packed,
)
from fake_daemon import FakeDaemon, fake_daemon, frame_of, triangle_topology

import tensormass as tm
from tensormass._shared.surfaces import Surface
from tensormass.v1 import changes_pb2, event_pb2, stream_pb2

DEADLINE_S = 10.0
SEEDS = range(8)


def test_a_surface_leaves_out_what_is_dead_and_has_what_was_appended() -> None:
    topology = ChangingScene(0).topology
    surface = Surface(topology, changes(body_changes(), NOTHING))
    triangles, faces = surface.triangles(0, 2 * FAN + 1)
    assert [0, 4, 5] not in triangles.tolist()
    assert triangles[-1].tolist() == [0, 1, FAN]
    assert faces.tolist() == [0] * (FAN - 3) + [2]
    positions = np.arange(2 * FAN + 1)
    assert surface.vertices(0, positions)[-1] == 2 * FAN
    assert surface.vertices(1, positions).tolist() == list(range(FAN, 2 * FAN))
    assert surface.is_changed
    # A frame from before: the appended triangle waits for its vertex.
    assert len(surface.triangles(0, 2 * FAN)[0]) == FAN - 3
    assert not surface.parts[0].coagulation.any()
    pale = Surface(topology, changes(body_changes(coagulation=bytes([255] * (FAN + 1))), NOTHING))
    assert (pale.parts[0].coagulation == 255).all()
    assert pale.parts[1].coagulation.tolist() == [0] * FAN
    unknown = Surface(topology, changes(body_changes(appended_kinds=b"\x09"), NOTHING))
    assert unknown.triangles(0, 2 * FAN + 1)[1][-1] == 0
    assert not Surface(topology, changes(revision=9, appended=0)).is_changed


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (changes(version=7), "changes of topology 7 do not belong to"),
        (changes(NOTHING), "changes of 1 bodies do not fit the 2 of the topology"),
        (changes(body_changes(dead_triangles=b"abc"), NOTHING), "'left': 3 bytes of dead_triangles"),
        (changes(body_changes(dead_triangles=packed([3, 3])), NOTHING), "dead_triangles do not ascend"),
        (changes(body_changes(dead_triangles=packed([FAN - 1])), NOTHING), f"dead triangle {FAN - 1} of {FAN - 1}"),
        (changes(body_changes(appended_vertices=packed([2 * FAN - 1])), NOTHING), "appended vertices are at 79 to 79"),
        (changes(body_changes(appended_vertices=packed([2 * FAN + 1])), NOTHING), "appended vertices are at 81 to 81"),
        (changes(NOTHING, body_changes(appended_triangles=packed([0, FAN + 1, 1]))), "'right': .* vertex 41 of 41"),
        (changes(body_changes(appended_triangles=packed([0, 1])), NOTHING), "8 bytes of appended_triangles"),
        (changes(body_changes(appended_kinds=b"\1\1"), NOTHING), "2 kinds of 1 appended triangles"),
        (changes(body_changes(coagulation=b"\1"), NOTHING), f"coagulation of 1 of {FAN + 1} vertices"),
    ],
)
def test_changes_that_do_not_fit_are_refused(message: changes_pb2.SurfaceChanges, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Surface(ChangingScene(0).topology, message)


# --- the SDK


class Bus:
    """Subscriptions that keep the newest message, as those of ZeroMQ."""

    def __init__(self) -> None:
        self.frame: stream_pb2.Frame | None = None
        self.newest_changes: changes_pb2.SurfaceChanges | None = None

    def receive(self, timeout_s: float) -> stream_pb2.Frame:
        frame, self.frame = self.frame, None
        assert frame is not None
        return frame

    def newest(self) -> changes_pb2.SurfaceChanges | None:
        newest, self.newest_changes = self.newest_changes, None
        return newest

    def close(self) -> None:
        pass


def stream_of(server: tm.Server, bus: Any) -> tm.FrameStream:  # noqa: ANN401
    return tm.FrameStream(tm.SceneHandle(server, "s", None), bus, DEADLINE_S, lambda: bus)


def drawn(frame: tm.Frame) -> set[Face]:
    found: set[Face] = set()
    for body, surface in enumerate(frame.topology.bodies):
        found |= faces_of(body, frame.vertices(surface.name), frame.triangles(surface.name), frame.faces(surface.name))
    return found


@asynchronous
async def with_daemon(work: Callable[[FakeDaemon], object]) -> None:
    async with fake_daemon() as daemon:
        await asyncio.to_thread(work, daemon)


@pytest.mark.parametrize("seed", SEEDS)
def test_readers_of_the_sdk_show_what_a_fresh_one_shows(seed: int) -> None:
    """Readers that join before, during and after changes, and read seldom, with messages in any order."""
    scene = ChangingScene(seed)
    random = scene.random

    def work(daemon: FakeDaemon) -> None:
        daemon.topologies["s"] = scene.topology
        with tm.connect(daemon.control) as server:
            readers: list[tuple[Bus, tm.FrameStream]] = []
            for round_ in range(40):
                daemon.frames["s"], daemon.changes["s"] = scene.frame(), scene.changes()
                if round_ % 13 == 0:
                    bus = Bus()
                    stream = stream_of(server, bus)
                    assert drawn(next(stream)) == scene.history[scene.revision]
                    readers.append((bus, stream))
                if random.random() < 0.6:
                    scene.change()
                frame = scene.frame()
                tells = random.random() < 0.5  # changes go out less often than frames
                for bus, stream in readers:
                    if tells:
                        bus.newest_changes = scene.changes()
                    if random.random() < 0.3:
                        continue  # reads nothing this time
                    bus.frame = frame
                    shown = next(stream)
                    assert shown.revision == scene.revision
                    assert drawn(shown) == scene.seen(shown.surface.revision, len(shown.positions))
            daemon.frames["s"], daemon.changes["s"] = scene.frame(), scene.changes()
            fresh = drawn(tm.SceneHandle(server, "s", None).frame())
            assert fresh == scene.history[scene.revision]
            for bus, stream in readers:
                bus.newest_changes, bus.frame = scene.changes(), scene.frame()
                assert drawn(next(stream)) == fresh

    with_daemon(work)


def test_changes_that_do_not_fit_end_no_stream_of_the_sdk() -> None:
    scene = ChangingScene(1)

    def work(daemon: FakeDaemon) -> None:
        daemon.topologies["s"] = scene.topology
        daemon.frames["s"] = scene.frame()
        with tm.connect(daemon.control) as server:
            handle = tm.SceneHandle(server, "s", None)
            assert drawn(handle.frame()) == scene.history[0]
            daemon.changes["s"] = changes(NOTHING, revision=3)
            with pytest.raises(tm.InternalError, match="changes of 1 bodies do not fit"):
                handle.frame()
            del daemon.changes["s"]
            assert drawn(handle.frame()) == scene.history[0]
            scene.change()
            daemon.frames["s"], daemon.changes["s"] = scene.frame(), scene.changes()
            assert drawn(handle.frame()) == scene.history[1]
            # Another scene under the same name, without changes.
            daemon.topologies["s"] = other = triangle_topology("s", version=VERSION + 5, vertex_count=5)
            daemon.frames["s"] = frame_of(other, 1)
            del daemon.changes["s"]
            assert handle.frame().triangles("fan").tolist() == [[0, 1, 2], [0, 2, 3], [0, 3, 4]]

    with_daemon(work)


class Events:
    def __init__(self, *messages: event_pb2.SceneEvents) -> None:
        self.messages = list(messages)

    def receive(self, timeout_s: float) -> event_pb2.SceneEvents:
        assert timeout_s == np.inf
        return self.messages.pop(0)


def test_each_event_comes_once() -> None:
    messages = Events(events(5, 6), events(5, 6), events(5, 8), events(20, 21), events(1, 2, VERSION + 1), events(3, 9))
    stream = tm.EventStream(messages, None)  # type: ignore[arg-type]
    found = [next(stream) for _ in range(8)]
    assert [event.sequence for event in found] == [5, 6, 7, 8, 20, 21, 1, 2]
    assert stream.missed_count == 11
    assert found[0].position_m is None
    assert found[1].position_m is not None
    assert found[1].position_m.tolist() == [1, 0, 0]
    assert (found[0].kind, found[0].body, found[0].value) == ("ablated", "liver", 1e-9)
    newer = event_pb2.SceneEvents(topology_version=1)
    newer.events.add(sequence=1, kind=99)
    assert next(tm.EventStream(Events(newer), None)).kind == "99"  # type: ignore[arg-type]
