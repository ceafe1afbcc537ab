"""Viewers that ask for less detail: topology, frames, rest and fields at the same vertices, whatever comes when."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from asynchronous import asynchronous
from fake_daemon import FakeDaemon, fake_daemon
from gateway_parts import Page, browse, options
from surfaces import distance_to, frame_at, pressed, two_balls

from tensormass.v1 import gateway_pb2, stream_pb2
from tensormass_gateway import streams
from tensormass_gateway.choice import Choice, Codec
from tensormass_gateway.decoding import DecodedFrame, DecodedTopology, FrameDecoder, FrameError, decode_topology
from tensormass_gateway.detail import MAX_LEVELS, VERSIONS, Level
from tensormass_gateway.encoding import SharedFrame, encode
from tensormass_gateway.fields import FieldPoll
from tensormass_gateway.gateway import serve
from tensormass_gateway.normals import Triangles
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.streams import SceneStreams

TOPOLOGY, PLACES = two_balls()
TRIANGLES = sum(len(body.triangles) // 12 for body in TOPOLOGY.bodies)


def shared(positions: npt.NDArray[np.float64], topology: stream_pb2.Topology = TOPOLOGY) -> SharedFrame:
    frame = frame_at(topology, 3, positions)
    return SharedFrame(b"frame\0" + frame.SerializeToString(), b"encoded_frame\0", frame, Triangles(topology))


def level_of(detail: float, positions: npt.NDArray[np.float64] = PLACES) -> Level:
    return Level(TOPOLOGY, shared(positions), detail)


def triangle_count(topology: stream_pb2.Topology) -> int:
    return sum(len(body.triangles) // 12 for body in topology.bodies)


def triangles_in_frame(topology: stream_pb2.Topology) -> npt.NDArray[np.int64]:
    """Triangles of all bodies, counted over the whole frame."""
    packed = [
        np.frombuffer(body.triangles, "<u4").astype(np.int64).reshape(-1, 3) + body.first_vertex
        for body in topology.bodies
    ]
    return np.concatenate(packed)


def watched_levels(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The details of the levels that are made from now on."""
    made: list[float] = []

    def make(topology: stream_pb2.Topology, first: SharedFrame, detail: float) -> Level:
        made.append(detail)
        return Level(topology, first, detail)

    monkeypatch.setattr(streams, "Level", make)
    return made


# --- one level -------------------------------------------------------------------------------------------------------


def test_a_level_keeps_the_picture_and_its_places() -> None:
    topology = stream_pb2.Topology()
    topology.CopyFrom(TOPOLOGY)
    body = topology.bodies[0]
    corners = np.frombuffer(body.triangles, "<u4")
    # Each vertex has one place, which names it.
    body.texture_image = b"png"
    body.texture_coordinates = np.stack([corners, corners], axis=1).astype("<f4").tobytes()
    level = Level(topology, shared(PLACES, topology), 0.25)
    simplified = level.topology.bodies[0]
    assert simplified.texture_image == b"png"
    assert level.topology.bodies[1].texture_coordinates == b""
    kept = level.vertices[np.frombuffer(simplified.triangles, "<u4")]
    np.testing.assert_array_equal(np.frombuffer(simplified.texture_coordinates, "<f4"), np.repeat(kept, 2))

    body.texture_coordinates = body.texture_coordinates[:-8]
    with pytest.raises(ValueError, match="texture coordinates for"):
        Level(topology, shared(PLACES, topology), 0.25)


@pytest.mark.parametrize("detail", [0.5, 0.25, 0.1])
def test_topology_of_a_level_has_the_share_and_is_whole_in_itself(detail: float) -> None:
    level = level_of(detail)
    first = 0
    for body, whole in zip(level.topology.bodies, TOPOLOGY.bodies, strict=True):
        assert body.first_vertex == first
        assert len(body.triangles) == pytest.approx(detail * len(whole.triangles), abs=36)
        used = np.unique(np.frombuffer(body.triangles, "<u4"))
        assert used.tolist() == list(range(body.vertex_count))
        own = level.vertices[first : first + body.vertex_count] - whole.first_vertex
        assert (np.diff(own) > 0).all()
        first += body.vertex_count
        if whole.nodes:
            assert np.frombuffer(body.nodes, "<u4").tolist() == np.frombuffer(whole.nodes, "<u4")[own].tolist()
        fixed = set(own[np.frombuffer(body.fixed_vertices, "<u4")])
        assert fixed == set(np.frombuffer(whole.fixed_vertices, "<u4")) & set(own)
    assert fixed == set()
    assert np.frombuffer(level.topology.bodies[0].fixed_vertices, "<u4").size > 0
    assert level.topology.tools == TOPOLOGY.tools
    assert triangles_in_frame(TOPOLOGY).shape[0] == TRIANGLES


def test_a_level_has_a_version_of_its_own_that_names_its_vertices() -> None:
    versions = [level_of(detail).version for detail in (0.5, 0.5, 0.25)]
    assert versions[0] == versions[1] != versions[2]
    assert all(TOPOLOGY.version < version <= TOPOLOGY.version + VERSIONS for version in versions)
    elsewhere = level_of(0.5, pressed(PLACES, 0.05))
    assert elsewhere.vertices.tolist() != level_of(0.5).vertices.tolist()
    assert elsewhere.version != versions[0]


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("codec", Codec)
def test_frames_of_a_level_are_the_whole_frame_at_its_vertices(codec: Codec, normals: bool) -> None:
    level, choice = level_of(0.25), Choice(codec, normals=normals, detail=0.25)
    moved = pressed(PLACES, 0.02)
    whole = shared(moved)
    message, _ = encode(level.frame(whole, b"frame\0"), choice, None, 1)
    key, payload = message.split(b"\0", 1)
    assert key == b"encoded_frame"
    decoded = FrameDecoder().decode(key.decode(), payload)
    exact = moved.astype(np.float32)[level.vertices].astype(float)
    assert (np.abs(decoded.positions - exact) <= decoded.error_m).all()
    assert decoded.head.topology_version == level.version
    assert (decoded.head.sequence, len(decoded.head.tools)) == (3, 1)
    assert whole.head.topology_version == TOPOLOGY.version
    if normals:
        assert decoded.normals is not None
        expected = Triangles(level.topology).directions(np.ascontiguousarray(exact.T.astype(np.float32)))
        assert np.abs(decoded.normals - expected).max() < 0.01
    assert 0 < decoded.detail_error_m < 0.02


def test_the_stated_error_bounds_the_distance_in_each_frame_and_grows_with_a_dent() -> None:
    level = level_of(0.2)
    triangles = triangles_in_frame(level.topology)
    stated = []
    for depth in (0.0, 0.03, 0.08):
        shape = pressed(PLACES, depth).astype(np.float32).astype(float)
        error_m = level.frame(shared(shape), b"").detail_error_m
        exact = distance_to(shape, shape[level.vertices], triangles)
        assert exact.max() <= error_m + 1e-9
        stated.append(error_m)
    assert stated[0] < 0.01
    assert stated[0] < stated[1] < stated[2]


def test_a_frame_that_is_not_finite_passes_with_the_vertices_of_the_level() -> None:
    level, places = level_of(0.25), PLACES.copy()
    places[level.vertices[5], 1] = np.nan
    message, _ = encode(level.frame(shared(places), b"frame\0"), Choice(Codec.Q16, detail=0.25), None, 1)
    key, payload = message.split(b"\0", 1)
    assert key == b"frame"
    frame = stream_pb2.Frame.FromString(payload)
    positions = np.frombuffer(frame.positions, "<f4").reshape(-1, 3)
    np.testing.assert_array_equal(positions, places.astype(np.float32)[level.vertices])
    assert frame.topology_version == level.version


def test_decoded_topology_names_the_vertices_of_the_whole() -> None:
    level = level_of(0.25)
    decoded = decode_topology("simplified_topology", level.message().SerializeToString())
    assert decoded.topology == level.topology
    assert decoded.whole_vertices.tolist() == level.vertices.tolist()
    assert decoded.whole_version == TOPOLOGY.version
    whole = decode_topology("topology", TOPOLOGY.SerializeToString())
    assert whole.whole_vertices.tolist() == list(range(len(PLACES)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda message: setattr(message, "whole_vertices", message.whole_vertices[:-4]), "name the vertices of"),
        (lambda message: setattr(message, "whole_vertices", message.whole_vertices[:-1]), "name the vertices of"),
        (lambda message: setattr(message, "whole_vertex_count", 20), "a vertex is beyond the 20 of the whole"),
        (lambda message: setattr(message, "whole_vertices", bytes(len(message.whole_vertices))), "do not ascend"),
        (lambda message: message.topology.bodies.add(vertex_count=1), "name the vertices of"),
    ],
)
def test_damaged_topology_of_a_level_is_refused(
    change: Callable[[gateway_pb2.SimplifiedTopology], object], said: str
) -> None:
    message = level_of(0.25).message()
    change(message)
    with pytest.raises(FrameError, match=said):
        decode_topology("simplified_topology", message.SerializeToString())
    with pytest.raises(FrameError, match="not protobuf"):
        decode_topology("simplified_topology", b"\xff\xff")


# --- through the gateway ---------------------------------------------------------------------------------------------


class Viewer:
    """A page that draws what it gets. A frame that does not fit its topology fails the test."""

    def __init__(self, page: Page) -> None:
        self.page, self.decoder = page, FrameDecoder()
        self.topology: DecodedTopology | None = None
        self.streams: list[str] = []

    async def frame(self) -> DecodedFrame:
        """Takes messages up to the next frame."""
        while True:
            name, payload = await self.page.binary()
            self.streams.append(name)
            match name:
                case "topology" | "simplified_topology":
                    self.topology = decode_topology(name, payload)
                    await self.page.send(type="ack", stream="topology")
                case "frame" | "encoded_frame":
                    decoded = self.decoder.decode(name, payload)
                    await self.page.send(type="ack", stream="frame", keyframe=self.decoder.keyframe)
                    assert self.topology is not None
                    assert decoded.head.topology_version == self.topology.topology.version
                    assert len(decoded.positions) == len(self.topology.whole_vertices)
                    return decoded
                case _:
                    await self.page.send(type="ack", stream=name)

    @property
    def share(self) -> float:
        assert self.topology is not None
        return triangle_count(self.topology.topology) / TRIANGLES


async def publish(daemon: FakeDaemon, sequence: int, topology: stream_pb2.Topology = TOPOLOGY) -> None:
    frame = frame_at(topology, sequence, pressed(PLACES, 1e-3 * sequence))
    await daemon.publish(topology.scene, "frame", frame.SerializeToString())


def show(daemon: FakeDaemon, topology: stream_pb2.Topology = TOPOLOGY) -> None:
    """Makes a paused scene of it: it has a frame, and publishes none by itself."""
    daemon.topologies[topology.scene] = topology
    daemon.frames[topology.scene] = frame_at(topology, 1, pressed(PLACES, 1e-3))


def right(decoded: DecodedFrame, viewer: Viewer) -> bool:
    """Whether a viewer has the positions of the frame that was published."""
    assert viewer.topology is not None
    exact = pressed(PLACES, 1e-3 * decoded.head.sequence).astype(np.float32)[viewer.topology.whole_vertices]
    return bool((np.abs(decoded.positions.astype(float) - exact) <= decoded.error_m).all())


@pytest.mark.parametrize("codec", Codec)
@asynchronous
async def test_viewer_gets_its_share_of_the_triangles_and_frames_that_fit(viewer: Path, codec: Codec) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        choice = f"codec={codec}&detail=0.25&normals=true"
        async with browse(gateway, "balls", choice=choice) as page, browse(gateway, "balls") as plain:
            shown, whole = Viewer(page), Viewer(plain)
            assert right(await shown.frame(), shown)
            assert right(await whole.frame(), whole)
            assert shown.streams == ["simplified_topology", "encoded_frame"]
            assert whole.streams == ["topology", "frame"]
            assert shown.share == pytest.approx(0.25, abs=0.01)
            await daemon.wait_subscribed("balls", "frame")
            for sequence in (2, 3, 4):
                await publish(daemon, sequence)
                decoded = await shown.frame()
                assert (decoded.head.sequence, right(decoded, shown)) == (sequence, True)
                assert decoded.normals is not None
                assert decoded.detail_error_m > 0
                assert (await whole.frame()).detail_error_m == 0
            assert {each["detail"] for each in gateway.stats()["browsers"]} == {0.25, 1.0}


@asynchronous
async def test_viewers_of_a_detail_share_its_level_and_a_late_one_gets_it_at_once(
    viewer: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = watched_levels(monkeypatch)
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        async with (
            browse(gateway, "balls", choice="detail=0.3") as first,
            browse(gateway, "balls", choice="detail=0.301&codec=delta") as second,
        ):
            for each in (Viewer(first), Viewer(second)):
                assert right(await each.frame(), each)
            async with browse(gateway, "balls", choice="detail=0.3&codec=q16") as late:
                shown = Viewer(late)
                assert right(await shown.frame(), shown)
            assert made == [0.3]


@asynchronous
async def test_detail_changes_in_between_and_the_topology_comes_before_its_frames(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        async with browse(gateway, "balls", choice="codec=delta") as page:
            shown = Viewer(page)
            await shown.frame()
            await daemon.wait_subscribed("balls", "frame")
            for sequence, detail in enumerate((0.4, 0.1, 1, 0.4, 0.1), start=2):
                await page.send(type="frames", detail=detail)
                told = await page.text(lambda message: message["type"] == "frames")
                assert (told["detail"], told["codec"], told["error"]) == (detail, "delta", "")
                decoded = await shown.frame()  # the newest one again, in the new detail
                assert (decoded.head.sequence, right(decoded, shown)) == (sequence - 1, True)
                assert shown.share == pytest.approx(detail, abs=0.01)
                await publish(daemon, sequence)
                assert right(await shown.frame(), shown)


@pytest.mark.parametrize("detail", [0, 1.01, -1, "0.5", None, True])
@asynchronous
async def test_refused_detail_is_answered_and_changes_nothing(viewer: Path, detail: object) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        async with browse(gateway, "balls", choice="detail=0.5") as page:
            shown = Viewer(page)
            await shown.frame()
            await page.send(type="frames", detail=detail)
            told = await page.text(lambda message: message["type"] == "frames")
            assert "is not a share of the triangles from 0.01 to 1" in told["error"]
            assert told["detail"] == 0.5
            assert await page.nothing_pending()


@asynchronous
async def test_a_reloaded_scene_is_simplified_anew_and_no_frame_of_the_old_one_comes_after(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        async with browse(gateway, "balls", choice="codec=q16&detail=0.25") as page:
            shown = Viewer(page)
            await shown.frame()
            before = shown.topology
            await daemon.wait_subscribed("balls", "frame")
            other = stream_pb2.Topology()
            other.CopyFrom(TOPOLOGY)
            other.version += 10**9
            daemon.topologies["balls"] = other
            await publish(daemon, 2, other)
            assert right(await shown.frame(), shown)
            assert shown.topology is not None
            assert before is not None
            assert shown.topology.whole_version == other.version
            assert shown.topology.topology.version > before.topology.version + 10**8


@asynchronous
async def test_others_get_their_frames_while_a_surface_is_simplified(
    viewer: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, released = threading.Event(), threading.Event()

    def slow(*given: Any) -> Level:  # noqa: ANN401
        begun.set()
        assert released.wait(20)
        return Level(*given)

    monkeypatch.setattr(streams, "Level", slow)
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon)
        async with browse(gateway, "balls", choice="detail=0.25") as page, browse(gateway, "balls") as other:
            whole, shown = Viewer(other), Viewer(page)
            await whole.frame()
            await daemon.wait_subscribed("balls", "frame")
            assert await asyncio.to_thread(begun.wait, 10)
            for sequence in (2, 3):
                await publish(daemon, sequence)
                assert (await whole.frame()).head.sequence == sequence
            assert await page.nothing_pending()
            released.set()
            decoded = await shown.frame()
            assert (decoded.head.sequence, right(decoded, shown)) == (3, True)


@asynchronous
async def test_a_scene_that_cannot_be_simplified_is_shown_whole(viewer: Path) -> None:
    broken = stream_pb2.Topology()
    broken.CopyFrom(TOPOLOGY)
    broken.bodies[0].triangles = np.array([0, 1, 10**6], "<u4").tobytes()
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        show(daemon, broken)
        async with browse(gateway, "balls", choice="detail=0.25&codec=q16") as page:
            shown = Viewer(page)
            assert right(await shown.frame(), shown)
            assert shown.streams[0] == "topology"


# --- rest and fields -------------------------------------------------------------------------------------------------


class Streams(SceneStreams):
    server, known = "s", None

    def __init__(self) -> None:
        super().__init__("balls")
        self.set_topology(TOPOLOGY)


def watcher_of(detail: float) -> Watcher:
    watcher = Watcher()
    watcher.encoder.choice = Choice(detail=detail)
    return watcher


async def until_quiet(scene: SceneStreams) -> None:
    while scene._awaited:
        await asyncio.gather(*scene._tasks)


async def taken(watcher: Watcher) -> dict[str, Any]:
    """All that waits, by stream."""
    found: dict[str, Any] = {}
    while watcher.outbox._waiting:
        message = await watcher.outbox.take()
        key, payload = (b"frame", message) if isinstance(message, SharedFrame) else (message.split(b"\0", 1))
        name = key.decode().rpartition("/")[2]
        watcher.outbox.acknowledge(Stream(name.removeprefix("simplified_")))
        found[name] = payload
    return found


@asynchronous
async def test_rest_positions_are_those_of_the_level() -> None:
    scene, watcher = Streams(), watcher_of(0.25)
    rest = stream_pb2.Frame(topology_version=TOPOLOGY.version, positions=PLACES.astype("<f4").tobytes())
    scene.publish(Stream.REST, scene.message(Stream.REST, rest))
    scene.add(watcher)
    assert await taken(watcher) == {}
    scene.publish(Stream.FRAME, shared(PLACES))
    await until_quiet(scene)
    found = await taken(watcher)
    assert list(found) == ["simplified_topology", "rest", "frame"]
    topology = decode_topology("simplified_topology", found["simplified_topology"])
    shown = stream_pb2.Frame.FromString(found["rest"])
    assert shown.topology_version == topology.topology.version
    assert shown.positions == PLACES.astype("<f4")[topology.whole_vertices].tobytes()


@asynchronous
async def test_a_frame_of_another_topology_is_neither_simplified_nor_shown() -> None:
    scene, watcher = Streams(), watcher_of(0.25)
    scene.add(watcher)
    alien = shared(PLACES)
    alien.head.topology_version += 1
    scene.publish(Stream.FRAME, alien)
    scene.publish(Stream.FRAME, shared(PLACES[:-1]))
    assert not scene._awaited
    scene.publish(Stream.FRAME, shared(PLACES))
    await until_quiet(scene)
    assert list(await taken(watcher)) == ["simplified_topology", "frame"]
    scene.publish(Stream.FRAME, alien)
    scene.publish(Stream.FRAME, shared(PLACES[:-1]))
    assert await taken(watcher) == {}


@asynchronous
async def test_a_viewer_that_tries_many_details_leaves_few_levels_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    made = watched_levels(monkeypatch)
    scene, watcher, steady = Streams(), watcher_of(0.05), watcher_of(0.06)
    scene.publish(Stream.FRAME, shared(PLACES))
    scene.add(steady)
    await until_quiet(scene)
    scene.add(watcher)
    # Without a pause in between, only the first and the last are made.
    for percent in range(10, 40):
        watcher.encoder.choice = Choice(detail=percent / 100)
        scene.show_detail(watcher)
    await until_quiet(scene)
    assert made in ([0.06, 0.39], [0.06, 0.05, 0.39])
    for percent in range(40, 40 + 2 * MAX_LEVELS):
        watcher.encoder.choice = Choice(detail=percent / 100)
        scene.show_detail(watcher)
        await until_quiet(scene)
    assert len(scene._levels) == MAX_LEVELS
    assert {0.06, watcher.detail} <= scene._levels.keys()


@asynchronous
async def test_a_field_has_a_value_for_each_vertex_that_a_viewer_shows() -> None:
    scene, simple, whole = Streams(), watcher_of(0.25), watcher_of(1)
    values = np.arange(len(PLACES), dtype=np.float32)
    surface: Any = type("Surface", (), {"bodies": {}, "values": lambda self, name, replies: values})()
    source: Any = scene
    source.step, source.control = 5, None
    poll = FieldPoll(source)
    for watcher in (simple, whole):
        watcher.field = "pressure"
        scene.add(watcher)
    # The level is not made, so only the other viewer can get values.
    assert [watcher for watcher, _ in poll._due("pressure", 5)] == [whole]
    scene.publish(Stream.FRAME, shared(PLACES))
    await until_quiet(scene)
    source.step = 0  # as without replies
    await poll._send("pressure", TOPOLOGY, surface)
    for watcher in (simple, whole):
        found = await taken(watcher)
        name = "simplified_topology" if watcher is simple else "topology"
        topology = decode_topology(name, found[name])
        head, _, packed = found["field"].partition(b"\n")
        assert json.loads(head)["topology_version"] == str(topology.topology.version)
        assert packed == values[topology.whole_vertices].tobytes()
    assert poll._due("pressure", 0) == []
    # A viewer whose topology came anew has lost its field, although no step was made.
    scene.show_detail(simple)
    poll.forget(simple)
    assert [watcher for watcher, _ in poll._due("pressure", 0)] == [simple]


def test_the_background_tasks_of_a_scene_do_not_pile_up() -> None:
    async def run() -> int:
        scene = Streams()
        scene.publish(Stream.FRAME, shared(PLACES))
        for percent in range(50, 60):
            watcher = watcher_of(percent / 100)
            scene.add(watcher)
            await until_quiet(scene)
            scene.watchers.discard(watcher)
        return len(scene._tasks)

    assert asyncio.run(run()) <= 2
