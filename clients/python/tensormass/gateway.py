"""Stands between a daemon and browsers: serves the viewer and forwards what the bus brings.

A browser speaks neither ZeroMQ nor gRPC, and nothing that a browser does may reach the daemon's step loop or fill
memory here. So each browser has one slot for the newest message of each stream, and the next message of a stream
leaves only after the browser has acknowledged the one before. A browser that stops costs three messages of memory.

    daemon --ZeroMQ--> one SUB socket (CONFLATE) per stream --> a slot per browser and stream --WebSocket--> browser
           <--gRPC--   which scenes there are, their topology

On the WebSocket `/stream?token=...`, binary messages are the bus's own bytes (key, zero byte, protobuf), unchanged.
Text messages are JSON objects with a `type`:

    gateway -> browser   daemon  connected, server, backend, device, version, poses_allowed, scenes [{name, state}]
                         clock   client_time_ms (as asked), gateway_time_ms, replaced (messages replaced in the slots)
    browser -> gateway   watch   scene
                         ack     stream
                         clock   client_time_ms
                         pose    tool, position_m [3]     (only with --allow-poses)

Who may connect: whoever knows the token, from a page of this gateway (Origin), up to a number of browsers.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import enum
import hmac
import json
import logging
import math
import os
import secrets
import signal
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import zmq
import zmq.asyncio
from aiohttp import WSCloseCode, WSMsgType, web
from google.protobuf.message import DecodeError, Message

from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

log = logging.getLogger("tensormass.gateway")

MAX_BROWSER_MESSAGE_BYTES = 4096
"""A larger message from a browser closes its connection."""
MAX_BUS_MESSAGE_BYTES = 512 << 20
"""A larger message from the daemon is dropped by ZeroMQ."""
MAX_COORDINATE_M = 1e6
"""The daemon refuses poses beyond it as well."""
HEARTBEAT_S = 15.0
"""A browser that answers no ping for so long is disconnected; it reconnects when it wakes."""
RPC_TIMEOUT_S = 5.0

DEFAULT_VIEWER = Path(__file__).resolve().parents[2] / "web" / "dist"

_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    # The address holds the token.
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Stream(enum.StrEnum):
    """The streams that a browser gets, in the order in which they leave: a frame needs its topology."""

    TOPOLOGY = "topology"
    STATUS = "status"
    FRAME = "frame"


class ProtocolError(Exception):
    """A browser sent what it must not; the message goes back as the reason for closing."""


@dataclass(frozen=True)
class GatewayOptions:
    """How a gateway listens and whom it lets in."""

    control: str = "127.0.0.1:50051"
    """The daemon's control address, host:port."""
    host: str = "127.0.0.1"
    port: int = 0
    """0: a free one."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    max_browsers: int = 16
    origins: tuple[str, ...] = ()
    """Origins let in beside the gateway's own address."""
    allow_poses: bool = False
    viewer: Path = DEFAULT_VIEWER
    poll_interval_s: float = 1.0
    """How often the daemon is asked for its scenes, and how soon its return is noticed."""


class Outbox:
    """What waits for one browser: the newest message of each stream, and at most one of each on its way."""

    def __init__(self) -> None:
        self.replaced = 0
        """Messages that a newer one replaced before they left."""
        self._waiting: dict[Stream, bytes] = {}
        self._on_the_way: set[Stream] = set()
        self._changed = asyncio.Event()

    def offer(self, stream: Stream, message: bytes) -> None:
        """Puts `message` into its slot; what waited there is replaced."""
        if stream is Stream.TOPOLOGY:
            # A frame that waits belongs to the topology before.
            self._waiting.pop(Stream.FRAME, None)
        if stream in self._waiting:
            self.replaced += 1
        self._waiting[stream] = message
        self._changed.set()

    def clear(self) -> None:
        """Forgets what waits, when the browser turns to another scene."""
        self._waiting.clear()

    def acknowledge(self, stream: Stream) -> None:
        """Lets the next message of `stream` leave. Raises ProtocolError if none is on its way."""
        if stream not in self._on_the_way:
            raise ProtocolError(f"acknowledged a {stream} message, but none is on its way")
        self._on_the_way.remove(stream)
        self._changed.set()

    async def take(self) -> bytes:
        """Waits for a message that may leave."""
        while True:
            for stream in Stream:
                if stream in self._waiting and stream not in self._on_the_way:
                    self._on_the_way.add(stream)
                    return self._waiting.pop(stream)
            self._changed.clear()
            await self._changed.wait()


class Browser:
    """One connected viewer."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.outbox = Outbox()
        self.scene: str | None = None
        self.client_id = secrets.randbits(63) | 1
        self.pose_sequence = 0
        self._daemon_state: dict[str, Any] | None = None
        self._wake = asyncio.Event()

    def tell_daemon_state(self, state: dict[str, Any]) -> None:
        """Sends the newest state of the daemon as soon as the socket takes it; older ones are replaced."""
        self._daemon_state = state
        self._wake.set()

    async def send_daemon_states(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            await self.socket.send_json(self._daemon_state)

    async def send_messages(self) -> None:
        while True:
            await self.socket.send_bytes(await self.outbox.take())


class Feed:
    """The streams of one scene, received once for all browsers that watch it."""

    def __init__(self, scene: str, daemon: Daemon) -> None:
        self.scene = scene
        self.watchers: set[Browser] = set()
        self.topology: stream_pb2.Topology | None = None
        self._daemon = daemon
        self._latest: dict[Stream, bytes] = {}
        self._last_sequence = 0
        self._tasks: list[asyncio.Task[None]] = []

    def open(self) -> None:
        """Subscribes anew. What was known is forgotten: it may come from a daemon that is no more."""
        self.close()
        receivers = {
            Stream.TOPOLOGY: self._on_topology,
            Stream.STATUS: self._on_status,
            Stream.FRAME: self._on_frame,
        }
        self._tasks = [_task(self._receive(stream, handler)) for stream, handler in receivers.items()]
        self._tasks.append(_task(self._fetch_first()))

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        self._latest.clear()
        self.topology = None
        self._last_sequence = 0

    def add(self, browser: Browser) -> None:
        """The browser gets what is known at once and everything new from now on."""
        self.watchers.add(browser)
        for stream in Stream:
            if stream in self._latest:
                browser.outbox.offer(stream, self._latest[stream])

    async def _receive(self, stream: Stream, handler: Callable[[bytes], Coroutine[Any, Any, None]]) -> None:
        prefix = self._key(stream)
        with self._daemon.zeromq.socket(zmq.SUB) as socket:
            # CONFLATE keeps one message of the socket, so every stream has a socket of its own.
            socket.setsockopt(zmq.CONFLATE, 1)
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.MAXMSGSIZE, MAX_BUS_MESSAGE_BYTES)
            socket.subscribe(prefix)
            socket.connect(self._daemon.version.zeromq_publish_endpoint)
            while True:
                message: bytes = await socket.recv()
                try:
                    await handler(message[len(prefix) :])
                except DecodeError:
                    self._daemon.malformed += 1
                    log.warning("scene %s: a %s message of %d bytes is not protobuf", self.scene, stream, len(message))
                except grpc.aio.AioRpcError as error:
                    log.warning("scene %s: no topology for its frames: %s", self.scene, error.details())

    async def _fetch_first(self) -> None:
        """Asks for what the bus would bring late (the topology) or never (the frame of a scene that stands still)."""
        try:
            await self._fetch_topology()
            if Stream.FRAME not in self._latest:
                reply = await self._daemon.control.GetFrame(
                    control_pb2.GetFrameRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
                )
                if Stream.FRAME not in self._latest and reply.frame.positions:
                    self._publish(Stream.FRAME, self._message(Stream.FRAME, reply.frame))
        except grpc.aio.AioRpcError as error:
            # The scene went away meanwhile, or the daemon did; the next poll will tell.
            log.info("scene %s: %s", self.scene, error.details())

    async def _fetch_topology(self) -> None:
        reply = await self._daemon.control.GetTopology(
            control_pb2.GetTopologyRequest(scene=self.scene), timeout=RPC_TIMEOUT_S
        )
        self._set_topology(reply.topology)

    def _set_topology(self, topology: stream_pb2.Topology) -> None:
        if topology != self.topology:
            self.topology = topology
            self._latest.pop(Stream.FRAME, None)
            self._publish(Stream.TOPOLOGY, self._message(Stream.TOPOLOGY, topology))

    async def _on_topology(self, payload: bytes) -> None:
        self._set_topology(stream_pb2.Topology.FromString(payload))

    async def _on_status(self, payload: bytes) -> None:
        stream_pb2.SceneStatus.FromString(payload)
        self._publish(Stream.STATUS, self._key(Stream.STATUS) + payload)

    async def _on_frame(self, payload: bytes) -> None:
        frame = stream_pb2.Frame.FromString(payload)
        # Each stream has a socket of its own, so a frame may overtake its topology. A sequence that does not rise is a
        # scene that was loaded anew and may look different under the same version.
        known = self.topology is not None and self.topology.version == frame.topology_version
        if not known or frame.sequence <= self._last_sequence:
            await self._fetch_topology()
        self._last_sequence = frame.sequence
        self._publish(Stream.FRAME, self._key(Stream.FRAME) + payload)

    def _publish(self, stream: Stream, message: bytes) -> None:
        self._latest[stream] = message
        for browser in self.watchers:
            browser.outbox.offer(stream, message)

    def _key(self, stream: Stream) -> bytes:
        return f"tensormass/{self._daemon.version.server}/{self.scene}/{stream}\0".encode()

    def _message(self, stream: Stream, message: Message) -> bytes:
        return self._key(stream) + message.SerializeToString()


class Daemon:
    """The daemon as seen from here: found over gRPC, followed over ZeroMQ, lost and found again."""

    def __init__(self, options: GatewayOptions, on_change: Callable[[], None]) -> None:
        self.zeromq = zmq.asyncio.Context()
        self.version = control_pb2.GetVersionResponse()
        self.connected = False
        self.malformed = 0
        """Messages of the bus that were no protobuf."""
        self.scenes: list[stream_pb2.SceneStatus] = []
        self._options = options
        self._on_change = on_change
        self._channel = grpc.aio.insecure_channel(
            options.control,
            options=[
                ("grpc.max_receive_message_length", MAX_BUS_MESSAGE_BYTES),
                ("grpc.enable_http_proxy", 0),
                # A daemon that comes back is found within a poll or two, not after gRPC's two minutes.
                ("grpc.max_reconnect_backoff_ms", max(100, int(1000 * options.poll_interval_s))),
            ],
        )
        self.control = control_pb2_grpc.ControlStub(self._channel)
        self._feeds: dict[str, Feed] = {}
        self._pose_socket: zmq.Socket[bytes] | None = None

    async def follow(self) -> None:
        """Keeps `version` and `scenes` true until cancelled."""
        while True:
            try:
                version = await self.control.GetVersion(control_pb2.GetVersionRequest(), timeout=RPC_TIMEOUT_S)
                reply = await self.control.ListScenes(control_pb2.ListScenesRequest(), timeout=RPC_TIMEOUT_S)
            except grpc.aio.AioRpcError as error:
                if self.connected:
                    log.warning("daemon at %s is gone: %s", self._options.control, error.details())
                self._lose()
            else:
                self._find(version, list(reply.scenes))
            await asyncio.sleep(self._options.poll_interval_s)

    async def close(self) -> None:
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()
        await self._channel.close()
        self.zeromq.destroy(linger=0)

    def watch(self, browser: Browser, scene: str) -> None:
        """Moves `browser` to `scene`, which need not be loaded yet."""
        self.leave(browser)
        browser.outbox.clear()
        browser.scene = scene
        feed = self._feeds.get(scene)
        if feed is None:
            feed = self._feeds[scene] = Feed(scene, self)
            if any(status.scene == scene for status in self.scenes):
                feed.open()
        feed.add(browser)

    def leave(self, browser: Browser) -> None:
        """Ends the subscription of a scene with its last watcher."""
        feed = self._feeds.get(browser.scene) if browser.scene is not None else None
        if feed is not None:
            feed.watchers.discard(browser)
            if not feed.watchers:
                feed.close()
                del self._feeds[feed.scene]

    def move_tool(self, browser: Browser, tool: str, position_m: tuple[float, float, float]) -> None:
        """Sends a pose on behalf of `browser`. Raises ProtocolError on an unknown tool."""
        feed = self._feeds.get(browser.scene) if browser.scene is not None else None
        if feed is None or feed.topology is None or not self.connected:
            return
        if tool not in {shape.name for shape in feed.topology.tools}:
            raise ProtocolError(f"scene {feed.scene!r} has no tool {tool!r}")
        browser.pose_sequence += 1
        pose = stream_pb2.ToolPose(
            sequence=browser.pose_sequence,
            client_time_ns=time.time_ns(),
            client_id=browser.client_id,
            position_m=scene_pb2.Vector3(x=position_m[0], y=position_m[1], z=position_m[2]),
        )
        key = f"tensormass/{self.version.server}/{feed.scene}/tool/{tool}/pose\0".encode()
        if self._pose_socket is None:
            # A plain socket of the same context: it never waits, so it needs no event loop.
            self._pose_socket = zmq.Context.shadow(self.zeromq.underlying).socket(zmq.PUSH)
            self._pose_socket.setsockopt(zmq.LINGER, 0)
            # Few, so that a stuck daemon gets no old poses when it wakes; not CONFLATE, which would mix tools.
            self._pose_socket.setsockopt(zmq.SNDHWM, 4)
            self._pose_socket.connect(self.version.zeromq_pose_endpoint)
        # Taken at once or dropped: the next pose is better than this one late.
        with contextlib.suppress(zmq.Again):
            self._pose_socket.send(key + pose.SerializeToString(), flags=zmq.NOBLOCK)

    def state(self) -> dict[str, Any]:
        return {
            "type": "daemon",
            "connected": self.connected,
            "server": self.version.server,
            "version": self.version.version,
            "backend": self.version.backend,
            "device": self.version.device,
            "poses_allowed": self._options.allow_poses,
            "scenes": [
                {
                    "name": status.scene,
                    "state": stream_pb2.SceneStatus.State.Name(status.state).removeprefix("STATE_").lower(),
                }
                for status in self.scenes
            ],
        }

    def _find(self, version: control_pb2.GetVersionResponse, scenes: list[stream_pb2.SceneStatus]) -> None:
        before = self.state()
        if not self.connected or _identity(version) != _identity(self.version):
            self._forget()
            self.connected, self.version = True, version
        known = {status.scene for status in self.scenes}
        present = {status.scene for status in scenes}
        for feed in self._feeds.values():
            if feed.scene in present - known:
                feed.open()
            elif feed.scene in known - present:
                feed.close()
        self.scenes = scenes
        if self.state() != before:
            self._on_change()

    def _lose(self) -> None:
        if self.connected:
            self._forget()
            self._on_change()

    def _forget(self) -> None:
        """What comes back, under whatever name, is another daemon with other scenes and endpoints."""
        self.connected = False
        self.scenes = []
        for feed in self._feeds.values():
            feed.close()
        self._close_pose_socket()

    def _close_pose_socket(self) -> None:
        if self._pose_socket is not None:
            self._pose_socket.close(linger=0)
            self._pose_socket = None


class Gateway:
    """The HTTP side: the viewer's files and one WebSocket for each browser. Use `serve`."""

    def __init__(self, options: GatewayOptions) -> None:
        if not (options.viewer / "index.html").is_file():
            raise FileNotFoundError(
                f"{options.viewer} holds no built viewer; build it with `npm ci && npm run build` in clients/web"
            )
        if options.max_browsers < 1:
            raise ValueError(f"max_browsers is {options.max_browsers}; at least one browser must be let in")
        self.options = options
        self.port = options.port
        self.refused_connections = 0
        self.closed_for_errors = 0
        self._browsers: set[Browser] = set()
        self._daemon = Daemon(options, self._announce)
        self._origins: frozenset[str] = frozenset()
        self._runner: web.AppRunner | None = None
        self._follower: asyncio.Task[None] | None = None

    @property
    def url(self) -> str:
        """The address to open, with the token."""
        host = f"[{self.options.host}]" if ":" in self.options.host else self.options.host
        return f"http://{host}:{self.port}/?token={self.options.token}"

    @property
    def browser_count(self) -> int:
        return len(self._browsers)

    def stats(self) -> dict[str, Any]:
        """What `/status` answers: JSON-ready counters."""
        return {
            "daemon": self._daemon.state(),
            "browsers": [
                {"scene": browser.scene, "replaced": browser.outbox.replaced}
                for browser in sorted(self._browsers, key=lambda browser: browser.client_id)
            ],
            "refused_connections": self.refused_connections,
            "closed_for_errors": self.closed_for_errors,
            "malformed_messages": self._daemon.malformed,
        }

    async def start(self) -> None:
        """Listens. Raises OSError if the address is taken."""
        app = web.Application(middlewares=[_secure_headers])
        app.add_routes(
            [
                web.get("/", self._page),
                web.get("/stream", self._stream),
                web.get("/status", self._status),
                web.static("/assets", self.options.viewer / "assets"),
            ]
        )
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        await self._runner.setup()
        await web.TCPSite(self._runner, self.options.host, self.options.port).start()
        self.port = self._runner.addresses[0][1]
        own = (self.options.host, "localhost", "127.0.0.1", "[::1]")
        self._origins = frozenset({f"http://{host}:{self.port}" for host in own} | set(self.options.origins))
        self._follower = _task(self._daemon.follow())

    async def stop(self) -> None:
        """Closes every connection and task."""
        if self._follower is not None:
            self._follower.cancel()
        for browser in list(self._browsers):
            await browser.socket.close(code=WSCloseCode.GOING_AWAY, message=b"the gateway stops")
        if self._runner is not None:
            await self._runner.cleanup()
        await self._daemon.close()

    async def _page(self, request: web.Request) -> web.FileResponse:
        return web.FileResponse(self.options.viewer / "index.html", headers={"Cache-Control": "no-cache"})

    async def _status(self, request: web.Request) -> web.Response:
        self._check_token(request)
        return web.json_response(self.stats(), headers={"Cache-Control": "no-store"})

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        self._check_token(request)
        # A page elsewhere could make a browser that knows the token connect; that browser names the page here.
        if request.headers.get("Origin") not in self._origins:
            self._refuse(web.HTTPForbidden(text="Origin is not let in; allow it with --origin\n"))
        if len(self._browsers) >= self.options.max_browsers:
            self._refuse(
                web.HTTPServiceUnavailable(
                    text=f"{self.options.max_browsers} browsers are connected (--max-browsers)\n"
                )
            )
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=MAX_BROWSER_MESSAGE_BYTES, compress=False)
        browser = Browser(socket)
        # Counted before the handshake waits, so that no burst passes the limit.
        self._browsers.add(browser)
        senders: list[asyncio.Task[None]] = []
        try:
            await socket.prepare(request)
            browser.tell_daemon_state(self._daemon.state())
            senders = [_task(browser.send_messages()), _task(browser.send_daemon_states())]
            await self._listen(browser)
        except ProtocolError as error:
            self.closed_for_errors += 1
            await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode()[:120])
        finally:
            self._browsers.discard(browser)
            self._daemon.leave(browser)
            for sender in senders:
                sender.cancel()
        return socket

    async def _listen(self, browser: Browser) -> None:
        async for message in browser.socket:
            if message.type is WSMsgType.ERROR:
                self.closed_for_errors += 1
                return
            if message.type is not WSMsgType.TEXT:
                raise ProtocolError("a browser sends text messages only")
            try:
                request = json.loads(message.data)
            except ValueError as error:
                raise ProtocolError("a message is not JSON") from error
            if not isinstance(request, dict):
                raise ProtocolError("a message is not a JSON object")
            await self._handle(browser, request)

    async def _handle(self, browser: Browser, request: dict[str, Any]) -> None:
        match request:
            case {"type": "ack", "stream": str(stream)}:
                if stream not in set(Stream):
                    raise ProtocolError(f"acknowledged {stream!r}, which is no stream")
                browser.outbox.acknowledge(Stream(stream))
            case {"type": "clock", "client_time_ms": int() | float() as client_time_ms}:
                await browser.socket.send_json(
                    {
                        "type": "clock",
                        "client_time_ms": client_time_ms,
                        "gateway_time_ms": time.time_ns() / 1e6,
                        "replaced": browser.outbox.replaced,
                    }
                )
            case {"type": "watch", "scene": str(scene)}:
                if not _is_name(scene):
                    raise ProtocolError("a scene's name is 1 to 64 characters of [A-Za-z0-9_-]")
                self._daemon.watch(browser, scene)
            case {"type": "pose", "tool": str(tool), "position_m": [x, y, z]}:
                if not self.options.allow_poses:
                    raise ProtocolError("this gateway takes no poses (--allow-poses)")
                if not all(
                    isinstance(value, int | float) and math.isfinite(value) and abs(value) <= MAX_COORDINATE_M
                    for value in (x, y, z)
                ):
                    raise ProtocolError("position_m is not three finite numbers [m]")
                self._daemon.move_tool(browser, tool, (float(x), float(y), float(z)))
            case _:
                raise ProtocolError("a message's type or fields are unknown")

    def _check_token(self, request: web.Request) -> None:
        given = request.query.get("token", "")
        if not hmac.compare_digest(given.encode(), self.options.token.encode()):
            self._refuse(web.HTTPForbidden(text="the token is missing or wrong; use the address that was printed\n"))

    def _refuse(self, error: web.HTTPException) -> None:
        self.refused_connections += 1
        raise error

    def _announce(self) -> None:
        for browser in self._browsers:
            browser.tell_daemon_state(self._daemon.state())


@contextlib.asynccontextmanager
async def serve(options: GatewayOptions) -> AsyncIterator[Gateway]:
    """A running gateway: `async with serve(options) as gateway: print(gateway.url)`.

    Raises FileNotFoundError if the viewer is not built, OSError if the address is taken.
    """
    gateway = Gateway(options)
    try:
        await gateway.start()
        yield gateway
    finally:
        await gateway.stop()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The gateway's options, for `tensormass view` and `tensormass run`."""
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s, loopback)")
    parser.add_argument("--port", type=int, default=0, help="port to listen on; 0: a free one (default)")
    parser.add_argument("--token", default=None, help="what a browser must know (default: random)")
    parser.add_argument("--max-browsers", type=int, default=16, help="browsers at once (default: %(default)s)")
    parser.add_argument(
        "--origin",
        action="append",
        default=[],
        metavar="URL",
        help="let in pages of this origin too, such as http://viewer.example:8000 (repeatable)",
    )
    parser.add_argument("--allow-poses", action="store_true", help="let browsers move tools (default: they only look)")
    parser.add_argument("--viewer", type=Path, default=DEFAULT_VIEWER, help="folder of the built viewer")
    parser.add_argument(
        "--gateway-ready-file",
        type=Path,
        default=None,
        metavar="PATH",
        help="write {url, host, port, token, pid} as JSON when listening",
    )


def options_from(args: argparse.Namespace, control: str) -> GatewayOptions:
    """What `add_arguments` parsed, for the daemon at `control` (host:port)."""
    optional = {} if args.token is None else {"token": args.token}
    return GatewayOptions(
        control=control,
        host=args.host,
        port=args.port,
        max_browsers=args.max_browsers,
        origins=tuple(args.origin),
        allow_poses=args.allow_poses,
        viewer=args.viewer,
        **optional,
    )


def write_ready_file(path: Path, gateway: Gateway) -> None:
    """Written at once and readable by its owner only: it holds the token."""
    content = {
        "url": gateway.url,
        "host": gateway.options.host,
        "port": gateway.port,
        "token": gateway.options.token,
        "pid": os.getpid(),
    }
    with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=path.name, delete=False) as file:
        json.dump(content, file)
    os.replace(file.name, path)


def run(args: argparse.Namespace) -> int:
    """Serves until SIGINT or SIGTERM. `args` come from `add_arguments` and hold `server`, the control address."""
    try:
        asyncio.run(_run(args))
    except (OSError, ValueError) as error:
        print(f"tensormass: gateway: {error}", file=sys.stderr)
        return 1
    return 0


async def _run(args: argparse.Namespace) -> None:
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with serve(options_from(args, args.server)) as gateway:
        if args.gateway_ready_file is not None:
            write_ready_file(args.gateway_ready_file, gateway)
        if getattr(args, "json", False):
            print(json.dumps({"url": gateway.url}), flush=True)
        else:
            print(f"viewer: {gateway.url}", flush=True)
        await stopped.wait()


@web.middleware
async def _secure_headers(request: web.Request, handler: Callable[[web.Request], Any]) -> web.StreamResponse:
    try:
        response: web.StreamResponse = await handler(request)
    except web.HTTPException as error:
        error.headers.update(_HEADERS)
        raise
    if not response.prepared:
        response.headers.update(_HEADERS)
    return response


def _task(work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """A task whose failure is logged; a lost connection is no failure."""

    def report(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            if isinstance(error, ConnectionError):
                log.info("a browser went away: %s", error)
            else:
                log.error("a task failed", exc_info=error)

    task = asyncio.get_running_loop().create_task(work)
    task.add_done_callback(report)
    return task


def _identity(version: control_pb2.GetVersionResponse) -> tuple[str, str, str]:
    return version.server, version.zeromq_publish_endpoint, version.zeromq_pose_endpoint


def _is_name(text: str) -> bool:
    return 0 < len(text) <= 64 and all(c.isascii() and (c.isalnum() or c in "_-") for c in text)
