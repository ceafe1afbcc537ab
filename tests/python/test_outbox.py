"""The gateway's messages for one browser."""

from __future__ import annotations

import asyncio

import pytest
from asynchronous import asynchronous

from tensormass_gateway.outbox import Outbox, Pace, Stream
from tensormass_gateway.requests import ProtocolError


@asynchronous
async def test_outbox_keeps_the_newest_of_each_stream_and_sends_one_at_a_time() -> None:
    outbox = Outbox()
    for number in range(1000):
        outbox.offer(Stream.FRAME, b"%d" % number)
    outbox.offer(Stream.STATUS, b"status")
    assert [await outbox.take(), await outbox.take()] == [b"status", b"999"]

    outbox.offer(Stream.FRAME, b"next")
    waiting = asyncio.ensure_future(outbox.take())
    await asyncio.sleep(0)
    assert not waiting.done()
    outbox.acknowledge(Stream.FRAME)
    assert await waiting == b"next"


@asynchronous
async def test_outbox_drops_the_frame_that_belongs_to_the_topology_before() -> None:
    outbox = Outbox()
    outbox.offer(Stream.FRAME, b"old")
    outbox.offer(Stream.TOPOLOGY, b"topology")
    assert await outbox.take() == b"topology"
    waiting = asyncio.ensure_future(outbox.take())
    await asyncio.sleep(0)
    assert not waiting.done()
    outbox.offer(Stream.FRAME, b"new")
    assert await waiting == b"new"


@asynchronous
async def test_outbox_holds_frames_back_while_their_topology_waits() -> None:
    outbox = Outbox()
    outbox.offer(Stream.TOPOLOGY, b"topology A")
    assert await outbox.take() == b"topology A"
    outbox.offer(Stream.TOPOLOGY, b"topology B")
    outbox.offer(Stream.FRAME, b"frame of B")
    waiting = asyncio.ensure_future(outbox.take())
    await asyncio.sleep(0)
    assert not waiting.done()
    outbox.acknowledge(Stream.TOPOLOGY)
    assert [await waiting, await outbox.take()] == [b"topology B", b"frame of B"]


@asynchronous
async def test_outbox_counts_the_frames_that_its_browser_misses() -> None:
    outbox = Outbox()

    async def send_frame(*, replaced: int) -> int:
        for number in range(replaced + 1):
            outbox.offer(Stream.FRAME, b"%d" % number)
        assert await outbox.take() == b"%d" % replaced
        outbox.acknowledge(Stream.FRAME)
        return outbox.replaced

    assert await send_frame(replaced=5) == 0  # nobody misses what came before the first
    assert await send_frame(replaced=3) == 3
    for _ in range(4):
        outbox.offer(Stream.STATUS, b"status")
        outbox.offer(Stream.FRAME, b"of the topology before")
    outbox.offer(Stream.TOPOLOGY, b"topology")
    assert [await outbox.take(), await outbox.take()] == [b"topology", b"status"]
    assert await send_frame(replaced=5) == 3
    assert await send_frame(replaced=1) == 4
    outbox.clear()
    assert await send_frame(replaced=5) == 0


@asynchronous
async def test_outbox_refuses_an_acknowledgement_of_nothing() -> None:
    with pytest.raises(ProtocolError, match="none is on its way"):
        Outbox().acknowledge(Stream.FRAME)


@asynchronous
async def test_a_frame_waits_for_its_turn_and_is_then_the_newest() -> None:
    now_s = 0.0
    outbox = Outbox()
    outbox.pace = Pace(lambda: now_s)
    outbox.set_rate(100.0)
    outbox.offer(Stream.FRAME, b"1")
    assert await outbox.take() == b"1"
    outbox.acknowledge(Stream.FRAME)
    outbox.offer(Stream.FRAME, b"2")
    waiting = asyncio.ensure_future(outbox.take())
    # The outbox looks again after 10 ms of real time, but its own clock stands still.
    assert not (await asyncio.wait([waiting], timeout=0.05))[0]
    outbox.offer(Stream.FRAME, b"3")
    now_s = 0.02
    assert await waiting == b"3"


@asynchronous
async def test_other_streams_do_not_wait_for_the_rate_of_frames() -> None:
    outbox = Outbox()
    outbox.pace = Pace(lambda: 0.0)
    outbox.set_rate(0.1)
    outbox.offer(Stream.FRAME, b"1")
    assert await outbox.take() == b"1"
    outbox.acknowledge(Stream.FRAME)
    outbox.offer(Stream.FRAME, b"2")
    outbox.offer(Stream.STATUS, b"status")
    assert await outbox.take() == b"status"
    # Without a rate, the frame that waits leaves at once.
    outbox.set_rate(None)
    assert await outbox.take() == b"2"
