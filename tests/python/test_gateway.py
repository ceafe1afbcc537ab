"""The gateway between a daemon that says what it is told to and browsers that are sockets of the test."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import platform
import signal
import stat
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from asynchronous import DEADLINE_S, asynchronous
from fake_daemon import Endpoints, FakeDaemon, fake_daemon, frame_of, triangle_topology

from tensormass.feeds import Stream
from tensormass.gateway import Gateway, GatewayOptions, add_arguments, serve
from tensormass.v1 import stream_pb2

TOKEN = "a-token"


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    folder = tmp_path / "dist"
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<title>viewer</title>")
    (folder / "assets" / "main.js").write_text("1;")
    return folder


def options(viewer: Path, control: str = "127.0.0.1:1", **change: object) -> GatewayOptions:
    return GatewayOptions(control=control, token=TOKEN, viewer=viewer, poll_interval_s=0.05, **change)


class Page:
    """A browser's end of the WebSocket."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self._texts: list[dict[str, Any]] = []
        self._binaries: list[bytes] = []

    async def send(self, **message: object) -> None:
        await self.socket.send_json(message)

    async def text(self, wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The next text message that is `wanted`; others before it are dropped."""
        while True:
            while self._texts:
                message = self._texts.pop(0)
                if wanted(message):
                    return message
            await self._receive()

    async def binary(self) -> tuple[str, bytes]:
        """The next binary message: stream and payload."""
        while not self._binaries:
            await self._receive()
        key, payload = self._binaries.pop(0).split(b"\0", 1)
        return key.decode().rpartition("/")[2], payload

    async def take(self, stream: Stream) -> bytes:
        """The payload of the next binary message, which must be of `stream`; acknowledges it."""
        name, payload = await self.binary()
        assert name == stream
        await self.send(type="ack", stream=stream)
        return payload

    async def nothing_pending(self) -> bool:
        """Whether nothing came before the answer to a request made now: the gateway answers in order."""
        await self.send(type="clock", client_time_ms=1)
        await self.text(lambda message: message["type"] == "clock")
        return not self._binaries

    async def replaced(self, count: int) -> None:
        """Waits until so many frames were replaced in the slot of this browser."""
        while True:
            await self.send(type="clock", client_time_ms=1)
            if (await self.text(lambda message: message["type"] == "clock"))["replaced"] >= count:
                return

    async def closed(self) -> tuple[int | None, str]:
        """Reads until the gateway closes; code and reason."""
        while True:
            message = await self.socket.receive()
            if message.type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSING, aiohttp.WSMsgType.CLOSED):
                return self.socket.close_code, str(message.extra or "")

    async def _receive(self) -> None:
        message = await self.socket.receive()
        if message.type is aiohttp.WSMsgType.BINARY:
            self._binaries.append(message.data)
        elif message.type is aiohttp.WSMsgType.TEXT:
            self._texts.append(json.loads(message.data))
        else:
            raise AssertionError(f"the gateway closed: {message}")


def origin(gateway: Gateway) -> str:
    return f"http://127.0.0.1:{gateway.port}"


@contextlib.asynccontextmanager
async def browse(gateway: Gateway, scene: str | None = None) -> AsyncIterator[Page]:
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=origin(gateway)) as socket,
    ):
        page = Page(socket)
        await page.text(lambda message: message["type"] == "daemon" and not message["problem"])
        if scene is not None:
            await page.send(type="watch", scene=scene)
        yield page


def load(daemon: FakeDaemon, scene: str = "liver", version: int = 1, vertex_count: int = 3) -> stream_pb2.Topology:
    topology = triangle_topology(scene, version, vertex_count)
    daemon.topologies[scene] = topology
    return topology


async def publish(daemon: FakeDaemon, topology: stream_pb2.Topology, sequence: int) -> bytes:
    frame = frame_of(topology, sequence).SerializeToString()
    await daemon.publish(topology.scene, "frame", frame)
    return frame


# --- who is let in ---------------------------------------------------------------------------------------------------


@asynchronous
async def test_page_is_served_with_headers_that_keep_the_token_here(viewer: Path) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        async with session.get(gateway.url) as reply:
            assert reply.status == 200
            assert "viewer" in await reply.text()
            assert reply.headers["Referrer-Policy"] == "no-referrer"
            assert "default-src 'self'" in reply.headers["Content-Security-Policy"]
        async with session.get(f"{origin(gateway)}/assets/main.js") as reply:
            assert reply.status == 200
        async with session.get(f"{origin(gateway)}/assets/../index.html/../../secret") as reply:
            assert reply.status == 404


@pytest.mark.parametrize("token", ["", "a-toke", "a-token2", "ä-token"])
@asynchronous
async def test_wrong_token_is_refused(viewer: Path, token: str) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(f"{origin(gateway)}/stream", params={"token": token}, origin=origin(gateway))
        async with session.get(f"{origin(gateway)}/status", params={"token": token}) as reply:
            assert reply.status == 403
            assert "use the address that was printed" in await reply.text()
        assert gateway.stats()["refused_connections"] == 2


@pytest.mark.parametrize("foreign", ["http://evil.example", "null", "", None])
@asynchronous
async def test_page_from_elsewhere_is_refused(viewer: Path, foreign: str | None) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=foreign)


@pytest.mark.parametrize(
    "host", ["192.168.7.7:8000", "[fd00::7]:8000", "10.0.0.7", "localhost:9000", f"{platform.node().lower()}:8000"]
)
@pytest.mark.parametrize("scheme", ["http", "https"])
@asynchronous
async def test_own_page_is_let_in_by_whatever_address_it_was_opened(viewer: Path, scheme: str, host: str) -> None:
    async with (
        serve(options(viewer)) as gateway,
        aiohttp.ClientSession(headers={"Host": host}) as session,
        session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=f"{scheme}://{host}") as socket,
    ):
        assert "no daemon" in (await socket.receive_json())["problem"]


@pytest.mark.parametrize(
    ("host", "claimed"),
    [
        ("evil.example:8000", "http://evil.example:8000"),  # a name that was rebound to this machine
        ("192.168.7.7:8000", "http://192.168.7.7:9000"),
        ("192.168.7.7:8000", "http://192.168.7.8:8000"),
        ("192.168.7.7:8000", "ftp://192.168.7.7:8000"),
        ("[:8000", "http://[:8000"),
    ],
)
@asynchronous
async def test_name_that_may_be_rebound_and_other_addresses_are_refused(viewer: Path, host: str, claimed: str) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession(headers={"Host": host}) as session:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=claimed)


@asynchronous
async def test_page_can_ask_why_its_websocket_is_refused(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, max_browsers=1)) as gateway:

        async def ask(token: str = TOKEN, page: str = origin(gateway)) -> tuple[int, str]:
            async with (
                aiohttp.ClientSession(headers={"Origin": page}) as session,
                session.post(f"{origin(gateway)}/stream", params={"token": token}) as reply,
            ):
                return reply.status, await reply.text()

        assert await ask() == (204, "")
        assert await ask(token="another") == (
            403,
            "the token is missing or wrong; use the address that was printed\n",
        )
        assert await ask(page="http://evil.example") == (
            403,
            "Origin http://evil.example is not let in; allow it with --origin\n",
        )
        async with browse(gateway):
            assert await ask() == (503, "1 browsers are connected (--max-browsers)\n")


@asynchronous
async def test_named_origin_is_let_in(viewer: Path) -> None:
    named = "http://viewer.example:8000"
    async with (
        serve(options(viewer, origins=(named,))) as gateway,
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=named) as socket,
    ):
        assert "no daemon" in (await socket.receive_json())["problem"]


@asynchronous
async def test_browsers_beyond_the_limit_are_refused_until_one_leaves(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, max_browsers=1)) as gateway:
        async with browse(gateway):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                async with browse(gateway):
                    pass
        while gateway.browser_count:
            await asyncio.sleep(0)
        async with browse(gateway):
            assert gateway.browser_count == 1


# --- what is forwarded -----------------------------------------------------------------------------------------------


@asynchronous
async def test_bytes_of_the_bus_reach_the_browser_unchanged(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == topology
            await daemon.wait_subscribed("liver", "frame")
            await daemon.wait_subscribed("liver", "status")
            sent = await publish(daemon, topology, 1)
            assert await page.take(Stream.FRAME) == sent
            status = stream_pb2.SceneStatus(scene="liver", step=5).SerializeToString()
            await daemon.publish("liver", "status", status)
            assert await page.take(Stream.STATUS) == status


@asynchronous
async def test_next_frame_leaves_only_after_the_acknowledgement_and_is_the_newest(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as slow, browse(gateway, "liver") as quick:
            for page in (slow, quick):
                await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            first = await publish(daemon, topology, 1)
            assert await slow.binary() == ("frame", first)
            assert await quick.take(Stream.FRAME) == first
            for sequence in range(2, 11):
                newest = await publish(daemon, topology, sequence)
                # The quick one is not held up by the slow one.
                assert await quick.take(Stream.FRAME) == newest
            assert await slow.nothing_pending()
            await slow.send(type="ack", stream="frame")
            assert await slow.binary() == ("frame", newest)
            await slow.replaced(8)


@asynchronous
async def test_late_browser_gets_what_is_known_at_once(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as first:
            await first.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            sent = await publish(daemon, topology, 1)
            await first.take(Stream.FRAME)
            async with browse(gateway, "liver") as second:
                await second.take(Stream.TOPOLOGY)
                assert await second.take(Stream.FRAME) == sent


@asynchronous
async def test_scene_that_stands_still_is_shown(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        daemon.frames["liver"] = frame_of(load(daemon), 3)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            assert stream_pb2.Frame.FromString(await page.take(Stream.FRAME)) == daemon.frames["liver"]


@asynchronous
async def test_frame_that_overtakes_its_topology_waits_for_it(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            cut = load(daemon, version=2, vertex_count=5)
            sent = await publish(daemon, cut, 1)  # and nothing on the topology stream
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == cut
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_sequence_that_falls_back_makes_the_topology_asked_for_anew(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        before = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, before, 100)
            await page.take(Stream.FRAME)
            after = load(daemon, vertex_count=6)
            sent = await publish(daemon, after, 1)
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == after
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_scenes_that_come_and_go_are_told(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        load(daemon)
        told = await page.text(lambda message: message["type"] == "daemon" and bool(message["scenes"]))
        assert told["scenes"] == ["liver"]
        del daemon.topologies["liver"]
        await page.text(lambda message: message["type"] == "daemon" and not message["scenes"])


@asynchronous
async def test_scene_that_went_is_not_shown_to_who_comes_late(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as first:
            await first.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            del daemon.topologies["liver"]
            await first.text(lambda message: message["type"] == "daemon" and not message["scenes"])
            await daemon.wait_subscribed("liver", "frame", count=0)
            async with browse(gateway, "liver") as second:
                assert await second.nothing_pending()
                again = load(daemon, vertex_count=4)
                for page in (first, second):
                    assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == again


@asynchronous
async def test_streams_that_nobody_watches_are_not_received(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        load(daemon, "kidney")
        async with browse(gateway, "liver") as page:
            await daemon.wait_subscribed("liver", "frame")
            await page.send(type="watch", scene="kidney")
            await daemon.wait_subscribed("kidney", "frame")
            await daemon.wait_subscribed("liver", "frame", count=0)
        await daemon.wait_subscribed("kidney", "frame", count=0)


# --- faults ----------------------------------------------------------------------------------------------------------


@asynchronous
async def test_daemon_without_zeromq_is_told(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        daemon.publishes = False
        told = await page.text(lambda message: message["type"] == "daemon" and bool(message["problem"]))
        assert "--zeromq-publish" in told["problem"]


@pytest.mark.parametrize("same_ports", [True, False])
@asynchronous
async def test_daemon_that_comes_back_is_found(viewer: Path, same_ports: bool) -> None:
    async with contextlib.AsyncExitStack() as stack:
        async with fake_daemon() as first:
            endpoints = first.endpoints
            gateway = await stack.enter_async_context(serve(options(viewer, first.control, allow_poses=True)))
            topology = load(first)
            page = await stack.enter_async_context(browse(gateway, "liver"))
            await page.take(Stream.TOPOLOGY)
            await first.wait_subscribed("liver", "frame")
            await publish(first, topology, 50)
            await page.take(Stream.FRAME)
            await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
            await first.next_pose()
        lost = await page.text(lambda message: message["type"] == "daemon" and bool(message["problem"]))
        assert f"no daemon answers on 127.0.0.1:{endpoints.control}" in lost["problem"]

        again = endpoints if same_ports else Endpoints(control=endpoints.control)
        second = await stack.enter_async_context(fake_daemon(again))
        topology = load(second, vertex_count=9)
        told = await page.text(lambda message: message["type"] == "daemon" and bool(message["scenes"]))
        assert told["problem"] == ""
        assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == topology
        await second.wait_subscribed("liver", "frame")
        sent = await publish(second, topology, 1)
        assert await page.take(Stream.FRAME) == sent
        await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
        await second.next_pose()


@asynchronous
async def test_daemon_that_was_replaced_between_two_polls_is_noticed(viewer: Path) -> None:
    async with fake_daemon(server="before") as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            daemon.server = "after"
            await daemon.wait_subscribed("liver", "frame")
            sent = await publish(daemon, topology, 1)
            await page.take(Stream.TOPOLOGY)
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_garbage_on_the_bus_is_counted_and_survived(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            for count, stream in enumerate(Stream, start=1):
                await daemon.wait_subscribed("liver", stream)
                await daemon.publish("liver", stream, b"\xff\xff\xff")
                while gateway.stats()["malformed_messages"] < count:
                    await asyncio.sleep(0)
            sent = await publish(daemon, topology, 1)
            assert await page.take(Stream.FRAME) == sent


@pytest.mark.parametrize(
    ("message", "code", "reason"),
    [
        ("no JSON", 1008, "not JSON"),
        ("[1]", 1008, "not a JSON object"),
        ('{"type":"ack","stream":"frame"}', 1008, "none is on its way"),
        ('{"type":"ack","stream":"pose"}', 1008, "no stream"),
        ('{"type":"ack","stream":["frame"]}', 1008, "unknown"),
        ('{"type":"watch","scene":"../x"}', 1008, "64 characters"),
        ('{"type":"watch","scene":"a/b#"}', 1008, "64 characters"),
        ('{"type":"pose","tool":"probe","position_m":[0,0,0]}', 1008, "takes no poses"),
        ('{"type":"sudo"}', 1008, "unknown"),
        (" " * 5000, 1009, ""),
        (b"binary", 1008, "text messages only"),
    ],
)
@asynchronous
async def test_browser_that_breaks_the_protocol_is_closed(
    viewer: Path, message: str | bytes, code: int, reason: str
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        async with browse(gateway) as page:
            if isinstance(message, bytes):
                await page.socket.send_bytes(message)
            else:
                await page.socket.send_str(message)
            closed, why = await page.closed()
            assert closed == code
            assert reason in why
        while gateway.browser_count:
            await asyncio.sleep(0)
        assert gateway.stats()["closed_for_errors"] == 1


# --- poses -----------------------------------------------------------------------------------------------------------


@asynchronous
async def test_allowed_poses_reach_the_daemon(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            for x in (0.5, 0.25):
                await page.send(type="pose", tool="probe", position_m=[x, 0, -1])
            poses = [await daemon.next_pose(), await daemon.next_pose()]
            assert [key for key, _ in poses] == ["tensormass/fake/liver/tool/probe/pose"] * 2
            assert [pose.sequence for _, pose in poses] == [1, 2]
            assert [pose.position_m.x for _, pose in poses] == [0.5, 0.25]
            assert poses[0][1].client_id == poses[1][1].client_id != 0


@asynchronous
async def test_pose_that_crosses_a_new_topology_costs_nothing(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "topology")
            other = triangle_topology("liver", version=2)
            other.tools[0].name = "saw"
            await daemon.publish("liver", "topology", other.SerializeToString())
            assert await page.binary() == ("topology", other.SerializeToString())
            await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
            await page.send(type="ack", stream="topology")
            await page.send(type="pose", tool="saw", position_m=[0, 0, 0])
            key, _ = await daemon.next_pose()
            assert key == "tensormass/fake/liver/tool/saw/pose"


@pytest.mark.parametrize(
    ("tool", "position", "reason"),
    [("saw", "[0,0,0]", "no tool 'saw'"), ("probe", "[NaN,0,0]", "finite"), ("probe", "[1e9,0,0]", "finite")],
)
@asynchronous
async def test_wrong_pose_is_refused(viewer: Path, tool: str, position: str, reason: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await page.socket.send_str(f'{{"type":"pose","tool":"{tool}","position_m":{position}}}')
            code, why = await page.closed()
            assert code == 1008
            assert reason in why


# --- as a program ----------------------------------------------------------------------------------------------------


def test_viewer_that_is_not_built_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="npm run build"):
        Gateway(options(tmp_path))


def test_arguments_stay_on_loopback_unless_told_otherwise() -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args([])
    assert (args.host, args.port, args.allow_poses) == ("127.0.0.1", 0, False)


def test_program_prints_its_address_writes_the_ready_file_and_ends_on_sigterm(viewer: Path, tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    program = (
        "import argparse, sys; from tensormass import gateway; parser = argparse.ArgumentParser();"
        "parser.add_argument('--server'); gateway.add_arguments(parser); sys.exit(gateway.run(parser.parse_args()))"
    )
    arguments = ["--server", "127.0.0.1:1", "--viewer", str(viewer), "--gateway-ready-file", str(ready)]
    with subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            said = json.loads(ready.read_text())
            assert line == f"viewer: {said['url']}\n"
            assert said["url"] == f"http://127.0.0.1:{said['port']}/?token={said['token']}"
            assert len(said["token"]) >= 32
            assert stat.S_IMODE(ready.stat().st_mode) == 0o600
            assert said["pid"] == process.pid
            os.kill(process.pid, signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
        finally:
            process.kill()
