"""What browsers choose about their frames, over the gateway's WebSocket."""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from asynchronous import asynchronous
from fake_daemon import FakeDaemon, fake_daemon, frame_of
from gateway_parts import OPERATOR_TOKEN, Page, browse, load, options, origin, publish

from tensormass.v1 import gateway_pb2, stream_pb2
from tensormass_gateway.decoding import FrameDecoder
from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.outbox import Stream


@contextlib.asynccontextmanager
async def watching(viewer: Path, choice: str) -> AsyncIterator[tuple[FakeDaemon, Gateway, stream_pb2.Topology, Page]]:
    """A browser that chose in its address, and has the topology."""
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver", choice=choice) as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            yield daemon, gateway, topology, page


@pytest.mark.parametrize(
    "choice", ["codec=q16", "codec=meshopt", "codec=delta&normals=true", "codec=float32&normals=true"]
)
@asynchronous
async def test_browser_gets_the_codec_of_its_address(viewer: Path, choice: str) -> None:
    async with watching(viewer, choice) as (daemon, gateway, topology, page):
        decoder = FrameDecoder()
        for sequence in (1, 2, 3):
            sent = stream_pb2.Frame.FromString(await publish(daemon, topology, sequence))
            name, payload = await page.binary()
            assert name == "encoded_frame"
            decoded = decoder.decode(name, payload)
            exact = np.frombuffer(sent.positions, "<f4").reshape(-1, 3)
            assert (np.abs(decoded.positions - exact) <= decoded.error_m).all()
            assert (decoded.normals is not None) == ("normals" in choice)
            sent.ClearField("positions")
            assert decoded.head == sent
            await page.send(type="ack", stream="frame", keyframe=decoder.keyframe)
        assert gateway.stats()["browsers"][0]["codec"] in choice


@asynchronous
async def test_browsers_of_one_scene_choose_independently(viewer: Path) -> None:
    async with (
        watching(viewer, "codec=q16") as (daemon, gateway, topology, page),
        browse(gateway, "liver") as plain,
    ):
        await plain.take(Stream.TOPOLOGY)
        sent = await publish(daemon, topology, 1)
        assert await plain.take(Stream.FRAME) == sent
        assert (await page.binary())[0] == "encoded_frame"


@asynchronous
async def test_browser_changes_its_choice(viewer: Path) -> None:
    async with watching(viewer, "codec=q16") as (daemon, _, topology, page):
        await page.send(type="frames", codec="float32", rate_hz=500)
        told = await page.text(lambda message: message["type"] == "frames")
        kept = {"normals": False, "detail": 1}
        assert told == {"type": "frames", "codec": "float32", "rate_hz": 500, **kept, "error": ""}
        sent = await publish(daemon, topology, 1)
        assert await page.take(Stream.FRAME) == sent


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"codec": "h264"}, "codec 'h264' is unknown; take one of float32, q16, delta, meshopt"),
        ({"rate_hz": 0}, "rate_hz 0 is not a number from 0.1 to 1000"),
        ({"rate_hz": -1}, "rate_hz -1"),
        ({"rate_hz": float("nan")}, "rate_hz nan"),
        ({"rate_hz": 1e9}, "rate_hz 1000000000.0"),
        ({"codec": "float32", "level": 1}, "'level' is unknown"),
    ],
)
@asynchronous
async def test_refused_choice_is_answered_and_nothing_is_lost(
    viewer: Path, request_: dict[str, object], said: str
) -> None:
    async with watching(viewer, "codec=q16&rate_hz=900") as (daemon, gateway, topology, page):
        await page.send(type="frames", **request_)
        told = await page.text(lambda message: message["type"] == "frames")
        assert said in told["error"]
        assert (told["codec"], told["rate_hz"]) == ("q16", 900)
        await publish(daemon, topology, 1)
        assert (await page.binary())[0] == "encoded_frame"
        assert gateway.closed_for_errors == 0


@pytest.mark.parametrize(
    "choice", ["codec=h264", "rate_hz=0", "rate_hz=nan", "rate_hz=1e9", "normals=2", "detail=0", "detail=2"]
)
@asynchronous
async def test_refused_choice_in_the_address_is_answered_in_words(viewer: Path, choice: str) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        address = f"{origin(gateway)}/stream?token={OPERATOR_TOKEN}&{choice}"
        async with session.post(address, headers={"Origin": origin(gateway)}) as reply:
            assert reply.status == 400
            assert choice.partition("=")[0] in await reply.text()
        with pytest.raises(aiohttp.WSServerHandshakeError, match="400"):
            await session.ws_connect(address, origin=origin(gateway))
        assert gateway.browser_count == 0


@asynchronous
async def test_keyframe_that_was_never_sent_is_answered_and_the_next_frame_is_one(viewer: Path) -> None:
    async with watching(viewer, "codec=delta") as (daemon, gateway, topology, page):
        await publish(daemon, topology, 1)
        await page.binary()
        await page.send(type="ack", stream="frame", keyframe=77)
        told = await page.text(lambda message: message["type"] == "frames")
        assert "acknowledged keyframe 77, but 1 keyframes were sent" in told["error"]
        await publish(daemon, topology, 2)
        encoded = gateway_pb2.EncodedFrame.FromString((await page.binary())[1])
        assert (encoded.codec, encoded.keyframe) == (gateway_pb2.EncodedFrame.CODEC_Q16, 2)
        assert gateway.closed_for_errors == 0


@asynchronous
async def test_keyframe_of_another_scene_is_no_error(viewer: Path) -> None:
    async with watching(viewer, "codec=delta") as (daemon, _, topology, page):
        daemon.frames["kidney"] = frame_of(load(daemon, "kidney", vertex_count=9), 3)
        await publish(daemon, topology, 1)
        await page.binary()
        await page.send(type="watch", scene="kidney")
        await page.send(type="ack", stream="frame", keyframe=1)
        await page.take(Stream.TOPOLOGY)
        encoded = gateway_pb2.EncodedFrame.FromString((await page.binary())[1])
        assert (encoded.keyframe, encoded.vertex_count) == (2, 9)
        assert await page.nothing_pending()


@asynchronous
async def test_browser_gets_no_more_frames_than_it_asked_for(viewer: Path) -> None:
    async with watching(viewer, "codec=q16&rate_hz=50") as (daemon, _, topology, page):
        await publish(daemon, topology, 1)
        began = time.monotonic()
        for sequence in range(2, 12):
            await page.binary()
            await page.send(type="ack", stream="frame")
            await publish(daemon, topology, sequence)
        await page.binary()
        assert time.monotonic() - began >= 9 / 50  # the first two may follow each other at once
