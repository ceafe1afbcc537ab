"""The streams of one scene in the gateway, from a daemon whose answers come when a test lets them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any

import pytest
from asynchronous import asynchronous
from fake_daemon import frame_of, triangle_topology

from tensormass.v1 import control_pb2, stream_pb2
from tensormass_gateway.feed import Feed
from tensormass_gateway.outbox import Outbox, Stream, Watcher


class Control:
    """Answers with `topology` and `frame`; `before_frame` happens while the frame is asked for."""

    def __init__(self, topology: stream_pb2.Topology) -> None:
        self.topology = topology
        self.frame = stream_pb2.Frame()
        self.before_frame: Callable[[], Awaitable[None]] | None = None

    async def GetTopology(self, *_: object, timeout: float) -> control_pb2.GetTopologyResponse:  # noqa: N802
        return control_pb2.GetTopologyResponse(topology=self.topology)

    async def GetFrame(self, *_: object, timeout: float) -> control_pb2.GetFrameResponse:  # noqa: N802
        if self.before_frame is not None:
            await self.before_frame()
        return control_pb2.GetFrameResponse(frame=self.frame)


def feed_of(control: Control) -> tuple[Feed, Outbox]:
    """A feed and what waits for the one who watches it."""
    daemon: Any = SimpleNamespace(control=control, known={}, version=control_pb2.GetVersionResponse(server="s"))
    feed, watcher = Feed("liver", daemon), Watcher()
    feed.add(watcher)
    return feed, watcher.outbox


async def taken(outbox: Outbox) -> list[tuple[str, bytes]]:
    """All that waits, as (stream, payload)."""
    found = []
    while outbox._waiting:
        message = await outbox.take()
        key, payload = (message if isinstance(message, bytes) else message.message).split(b"\0", 1)
        stream = key.decode().rpartition("/")[2]
        outbox.acknowledge(Stream(stream))
        found.append((stream, payload))
    return found


@asynchronous
async def test_a_frame_that_was_asked_for_does_not_replace_a_newer_one() -> None:
    topology = triangle_topology("liver")
    control = Control(topology)
    feed, outbox = feed_of(control)
    control.frame, newer = frame_of(topology, 3), frame_of(topology, 4).SerializeToString()
    control.before_frame = lambda: feed._on_frame(newer)
    await feed._fetch_first()
    assert await taken(outbox) == [("topology", topology.SerializeToString()), ("frame", newer)]


@asynchronous
async def test_a_frame_without_positions_is_not_shown() -> None:
    feed, outbox = feed_of(Control(triangle_topology("liver")))
    await feed._fetch_first()
    assert [stream for stream, _ in await taken(outbox)] == ["topology"]


@pytest.mark.parametrize("again", [5, 4])
@asynchronous
async def test_a_sequence_that_does_not_rise_may_be_of_another_topology(again: int) -> None:
    control = Control(triangle_topology("liver"))
    feed, outbox = feed_of(control)
    await feed._on_frame(frame_of(control.topology, 5).SerializeToString())
    await taken(outbox)
    control.topology = triangle_topology("liver", vertex_count=6)
    frame = frame_of(control.topology, again).SerializeToString()
    await feed._on_frame(frame)
    assert await taken(outbox) == [("topology", control.topology.SerializeToString()), ("frame", frame)]


@asynchronous
async def test_a_browser_that_joins_after_a_new_topology_gets_no_old_frame() -> None:
    control = Control(triangle_topology("liver"))
    feed, _ = feed_of(control)
    await feed._on_frame(frame_of(control.topology, 5).SerializeToString())
    other = triangle_topology("liver", version=2).SerializeToString()
    await feed._on_topology(other)
    late = Watcher()
    feed.add(late)
    assert await taken(late.outbox) == [("topology", other)]
