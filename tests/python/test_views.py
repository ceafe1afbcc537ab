"""One run under a scripted hand, seen over ZeroMQ, over zenoh, through the gateway, and by GetFrame.

The viewers of the gateway take each codec, in full and in less detail.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt
from asynchronous import asynchronous
from gateway_parts import Page, browse, options
from service_parts import DEADLINE_S, block

import tensormass as tm
from tensormass._src.streams import Transport
from tensormass.v1 import stream_pb2
from tensormass_gateway.choice import Codec
from tensormass_gateway.decoding import DecodedFrame, DecodedTopology, FrameDecoder, decode_topology
from tensormass_gateway.gateway import serve

TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")
#: Heights of the probe [m]: it sinks into the block, slides out of it and jumps back.
SCRIPT = [*np.linspace(0.08, 0.055, 12), *np.linspace(0.055, 0.07, 6), 0.09, 0.058]
STEPS_EACH = 4
DETAILS = (1, 0.3)


class Bus:
    """A subscriber of the bus."""

    def __init__(self, scene: tm.SceneHandle, transport: Transport) -> None:
        self.subscription = scene._connection.data_plane.subscribe(scene.name, "frame", stream_pb2.Frame, transport)

    def has_joined(self) -> bool:
        """Whether a frame has arrived in the last moment."""
        try:
            self.subscription.receive(timeout_s=0.1)
        except tm.DeadlineExceededError:
            return False
        return True

    def positions(self, step: int) -> npt.NDArray[np.float32]:
        while (frame := self.subscription.receive(DEADLINE_S)).step < step:
            pass
        assert frame.step == step
        return np.frombuffer(frame.positions, "<f4").reshape(-1, 3)


class Browser:
    """A viewer of the gateway."""

    def __init__(self, page: Page) -> None:
        self.page, self.decoder = page, FrameDecoder()
        self.topology: DecodedTopology | None = None

    async def frame(self, step: int) -> DecodedFrame:
        while True:
            stream, payload = await self.page.binary()
            if stream in ("topology", "simplified_topology"):
                self.topology = decode_topology(stream, payload)
            if stream not in ("frame", "encoded_frame"):
                await self.page.send(type="ack", stream=stream.removeprefix("simplified_"))
                continue
            decoded = self.decoder.decode(stream, payload)
            await self.page.send(type="ack", stream="frame", keyframe=self.decoder.keyframe)
            if decoded.head.step >= step:
                assert decoded.head.step == step
                assert self.topology is not None
                assert decoded.head.topology_version == self.topology.topology.version
                return decoded


@asynchronous
async def test_every_way_shows_the_same_positions(viewer: Path) -> None:
    async with contextlib.AsyncExitStack() as stack:
        server = stack.enter_context(await asyncio.to_thread(tm.launch, backend="cpu", cpu_threads=1))
        scene = stack.enter_context(await asyncio.to_thread(server.load, block(), lockstep=True))
        buses = {transport: Bus(scene, transport) for transport in TRANSPORTS}
        for bus in buses.values():
            while not await asyncio.to_thread(bus.has_joined):
                await asyncio.to_thread(scene.step)
        gateway = await stack.enter_async_context(serve(options(viewer, server.address)))
        browsers = {}
        for choice in itertools.product(Codec, DETAILS):
            codec, detail = choice
            page = await stack.enter_async_context(browse(gateway, scene.name, choice=f"codec={codec}&detail={detail}"))
            browsers[choice] = Browser(page)
            await browsers[choice].frame((await asyncio.to_thread(scene.frame)).step)
        deepest_m, keyframes = 0.0, set()
        first = (await asyncio.to_thread(scene.frame)).positions
        for height_m in SCRIPT:
            await asyncio.to_thread(scene.move_tool, "probe", (0.05, 0.05, height_m))
            step = (await asyncio.to_thread(scene.step, STEPS_EACH)).step
            exact = (await asyncio.to_thread(scene.frame)).positions
            for bus in buses.values():
                assert np.array_equal(await asyncio.to_thread(bus.positions, step), exact)
            for (codec, detail), browser in browsers.items():
                decoded = await browser.frame(step)
                assert browser.topology is not None
                vertices = browser.topology.whole_vertices
                error_m = np.abs(decoded.positions.astype(float) - exact[vertices])
                assert (error_m <= decoded.error_m).all()
                assert (codec is Codec.FLOAT32) == (not decoded.error_m.any())
                assert decoded.error_m.max() < 2e-6  # half of 0.1 m / 65535, and rounding
                assert (len(vertices) < len(exact)) == (decoded.detail_error_m > 0) == (detail < 1)
            keyframes.add(browsers[Codec.DELTA, 1].decoder.keyframe)
            deepest_m = max(deepest_m, float(np.abs(exact - first).max()))
        # The tissue moved far, so that some frames were keyframes, and others differences.
        assert deepest_m > 5e-3
        assert 1 < len(keyframes) < len(SCRIPT)
