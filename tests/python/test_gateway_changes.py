"""Surfaces that change while a scene steps: what the gateway sends to pages of every codec."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from asynchronous import asynchronous
from changing_scene import NOTHING, VERSION, ChangingScene, Face, changes, events, faces_of

from tensormass._shared.surfaces import Surface
from tensormass.v1 import changes_pb2, control_pb2, event_pb2, stream_pb2
from tensormass_gateway.choice import Choice, Codec
from tensormass_gateway.decoding import DecodedFrame, FrameDecoder, decode_topology
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.feed import Feed
from tensormass_gateway.normals import Triangles
from tensormass_gateway.outbox import Stream, Watcher

DEADLINE_S = 10.0
SEEDS = range(8)


class Page:
    """A page that takes the messages of a feed, decodes them and acknowledges."""

    def __init__(self, choice: Choice) -> None:
        self.watcher = Watcher()
        self.watcher.encoder.choice = choice
        self.decoder = FrameDecoder()
        self.topology: stream_pb2.Topology | None = None
        self.whole = True
        self.changes: changes_pb2.SurfaceChanges | None = None
        self.frame: DecodedFrame | None = None

    async def take(self) -> None:
        """Takes all that waits."""
        outbox = self.watcher.outbox
        while any(outbox._may_leave(stream) for stream in Stream):
            message = await outbox.take()
            if isinstance(message, SharedFrame):
                message = await self.watcher.encoder.encode(message)
            key, payload = message.split(b"\0", 1)
            stream = key.decode().rpartition("/")[2]
            slot = {"encoded_frame": "frame", "simplified_topology": "topology"}.get(stream, stream)
            match slot:
                case "topology":
                    self.topology, self.whole = decode_topology(stream, payload).topology, stream == slot
                    self.changes = self.frame = None
                case "changes":
                    self.changes = changes_pb2.SurfaceChanges.FromString(payload)
                    assert self.topology is not None
                    assert self.changes.topology_version == self.topology.version
                case "frame":
                    self.frame = self.decoder.decode(stream, payload)
                    self.watcher.encoder.acknowledge(self.decoder.keyframe)
            outbox.acknowledge(Stream(slot))

    def surface(self) -> Surface:
        assert self.topology is not None
        return Surface(self.topology, self.changes)

    def drawn(self) -> set[Face]:
        assert self.frame is not None
        surface, positions = self.surface(), self.frame.positions
        found: set[Face] = set()
        for body in range(2):
            found |= faces_of(body, surface.vertices(body, positions), *surface.triangles(body, len(positions)))
        return found


class Control:
    def __init__(self, scene: ChangingScene) -> None:
        self.scene = scene

    async def GetTopology(self, *_: object, timeout: float) -> control_pb2.GetTopologyResponse:  # noqa: N802
        return control_pb2.GetTopologyResponse(topology=self.scene.topology)


def feed_of(scene: ChangingScene) -> Feed:
    version = control_pb2.GetVersionResponse(server="s")
    daemon: Any = SimpleNamespace(control=Control(scene), known={}, version=version, malformed=0)
    return Feed("s", daemon)


async def until(done: Callable[[], bool]) -> None:
    async with asyncio.timeout(DEADLINE_S):
        while not done():
            await asyncio.sleep(0.002)


CHOICES = [
    Choice(),
    Choice(codec=Codec.Q16),
    Choice(codec=Codec.DELTA, normals=True),
    Choice(codec=Codec.MESHOPT),
    Choice(codec=Codec.DELTA, detail=0.5),
]


@pytest.mark.parametrize("seed", SEEDS)
@asynchronous
async def test_pages_show_what_a_fresh_one_shows(seed: int) -> None:
    """Pages of every codec that join before, during and after changes; one reads seldom, one stops for long."""
    scene = ChangingScene(seed)
    feed, random = feed_of(scene), scene.random
    pages: list[Page] = []
    for round_ in range(45):
        if round_ % 11 == 0:
            for choice in CHOICES:
                pages.append(Page(choice))
                feed.add(pages[-1].watcher)
        if random.random() < 0.6:
            scene.change()
        messages = [(feed._on_frame, scene.frame().SerializeToString())]
        if random.random() < 0.5:
            messages.insert(int(random.integers(0, 2)), (feed._on_changes, scene.changes().SerializeToString()))
        for handler, payload in messages:
            await handler(payload)
        for number, page in enumerate(pages):
            stopped = number % 3 == 0 and 10 < round_ < 40
            if stopped or random.random() < 0.3:
                continue
            await page.take()
            if page.frame is None or not page.whole:
                continue
            assert page.topology is not None
            # What a page knows of the surface may be older or newer than its frame, and fits in any case.
            assert page.drawn() == scene.seen(page.surface().revision, len(page.frame.positions))
    if scene.history[scene.revision] == scene.history[0]:
        scene.change()
    fresh = Page(Choice())
    feed.add(fresh.watcher)
    await feed._on_changes(scene.changes().SerializeToString())
    await feed._on_frame(scene.frame().SerializeToString())
    for page in [*pages, fresh]:
        await page.take()
        assert page.drawn() == scene.history[scene.revision]
    feed.close()


@asynchronous
async def test_a_page_with_less_detail_gets_the_whole_while_the_surface_differs() -> None:
    scene = ChangingScene(3)
    feed, page = feed_of(scene), Page(Choice(codec=Codec.Q16, detail=0.5))
    feed.add(page.watcher)

    async def show() -> None:
        await feed._on_changes(scene.changes().SerializeToString())
        await feed._on_frame(scene.frame().SerializeToString())

    await show()
    await until(lambda: feed.shown_version(page.watcher) is not None)
    await page.take()
    assert not page.whole
    simplified = feed.shown_version(page.watcher)
    while scene.history[scene.revision] == scene.history[0]:
        scene.change()
    await show()
    await page.take()
    assert page.whole
    assert feed.shown_version(page.watcher) == VERSION
    assert page.drawn() == scene.history[scene.revision]
    # A reset takes the changes back: the level that was made is shown again.
    scene._start()
    scene.revision += 1
    await show()
    await page.take()
    assert not page.whole
    assert feed.shown_version(page.watcher) == simplified
    assert page.frame is not None
    assert page.frame.head.revision == scene.revision
    feed.close()


@asynchronous
async def test_a_new_revision_is_a_keyframe() -> None:
    """The number of vertices alone does not tell: an appended vertex may be another one after a reset."""
    scene = ChangingScene(0)
    feed, page = feed_of(scene), Page(Choice(codec=Codec.DELTA))
    feed.add(page.watcher)
    frame, numbers = scene.frame(), []
    for revision in (0, 0, 1, 1, 2):
        frame.sequence += 1
        frame.revision = revision
        await feed._on_frame(frame.SerializeToString())
        await page.take()
        numbers.append(page.decoder.keyframe)
    assert numbers == [1, 1, 2, 2, 3]


@asynchronous
async def test_the_gateway_drops_changes_that_do_not_fit_or_are_old() -> None:
    scene = ChangingScene(5)
    feed, page = feed_of(scene), Page(Choice())
    feed.add(page.watcher)
    await feed._on_changes(scene.changes().SerializeToString())
    scene.change()
    old = scene.changes()
    scene.change()
    for message in (scene.changes(), old, changes(NOTHING, revision=99)):
        await feed._on_changes(message.SerializeToString())
    await page.take()
    assert page.changes == scene.changes()
    assert feed._daemon.malformed == 1


@asynchronous
async def test_events_go_to_every_page() -> None:
    feed, page = feed_of(ChangingScene(0)), Page(Choice(codec=Codec.Q16, detail=0.5))
    feed.add(page.watcher)
    await feed._on_events(events(1, 3).SerializeToString())
    message = await page.watcher.outbox.take()
    assert isinstance(message, bytes)
    assert event_pb2.SceneEvents.FromString(message.split(b"\0", 1)[1]) == events(1, 3)


def test_normals_are_those_of_the_triangles_that_are_there() -> None:
    scene = ChangingScene(7)
    while not scene.appended:
        scene.change()
    surface = Surface(scene.topology, scene.changes())
    positions = scene.random.random((3, surface.vertex_count)).astype(np.float32)
    found = Triangles(scene.topology, surface).directions(positions)
    sums = np.zeros((surface.vertex_count, 3))
    for _, _, corners in scene.history[scene.revision]:
        a, b, c = (positions[:, corner].astype(np.float64) for corner in corners)
        for corner in corners:
            sums[corner] += np.cross(b - a, c - a)
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    wanted = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 0)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
