"""Browsers that are sockets of the test, and the gateway that they talk to."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiohttp
from fake_daemon import FakeDaemon, frame_of, triangle_topology
from google.protobuf import json_format

from tensormass.v1 import gateway_pb2, stream_pb2
from tensormass_gateway.gateway import Gateway
from tensormass_gateway.options import GatewayOptions
from tensormass_gateway.outbox import Stream

TOKEN = "a-token-of-a-test"
OPERATOR_TOKEN = "an-operators-token"


def options(viewer: Path, control: str = "127.0.0.1:1", **change: object) -> GatewayOptions:
    given: dict[str, Any] = {"token": TOKEN, "operator_token": OPERATOR_TOKEN, "poll_interval_s": 0.05, **change}
    return GatewayOptions(control=control, viewer=viewer, **given)


def as_described(text: dict[str, Any]) -> dict[str, Any]:
    """Returns a text message of the gateway. It must be one of gateway.proto, with all fields that are always there."""
    fields = {name: value for name, value in text.items() if name != "type"}
    message = json_format.ParseDict({text["type"]: fields}, gateway_pb2.GatewayMessage())
    described = getattr(message, text["type"]).DESCRIPTOR.fields
    # Only the result of a load has findings.
    always = {field.name for field in described if not field.has_presence and field.name != "findings"}
    assert always <= fields.keys(), f"{text} lacks {always - fields.keys()}"
    return text


class Page:
    """A browser's end of the WebSocket."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.daemon: dict[str, Any] = {}
        """First message about a daemon that answers."""
        self._texts: list[dict[str, Any]] = []
        self._binaries: list[bytes] = []

    async def send(self, **message: object) -> None:
        await self.socket.send_json(message)

    async def command(self, action: str, scene: str, **fields: object) -> dict[str, Any]:
        """Sends a command and returns its result."""
        await self.send(type="control", id=7, action=action, scene=scene, **fields)
        return await self.text(lambda message: message["type"] == "result")

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
            self._texts.append(as_described(json.loads(message.data)))
        else:
            raise AssertionError(f"the gateway closed: {message}")


def origin(gateway: Gateway) -> str:
    return f"http://127.0.0.1:{gateway.port}"


@contextlib.asynccontextmanager
async def browse(
    gateway: Gateway, scene: str | None = None, token: str = OPERATOR_TOKEN, choice: str = ""
) -> AsyncIterator[Page]:
    """A browser that watches `scene`. `choice` is what its address says of its frames, such as `codec=q16`."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{origin(gateway)}/stream?token={token}&{choice}", origin=origin(gateway)) as socket,
    ):
        page = Page(socket)
        page.daemon = await page.text(lambda message: message["type"] == "daemon" and not message["problem"])
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
