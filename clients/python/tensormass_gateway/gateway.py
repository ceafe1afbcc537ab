"""The gateway between a daemon and browsers: serves the viewer and forwards the messages of the bus.

A browser speaks neither ZeroMQ nor gRPC. Nothing that a browser does may slow the daemon's step loop or fill memory
here. Each browser therefore has one slot for each stream, which holds the newest message. The next message of a
stream leaves only after the browser has acknowledged the one before. A browser that stops costs a message of memory
for each stream.

    daemon --ZeroMQ--> one SUB socket (CONFLATE) per stream --> a slot per browser and stream --WebSocket--> browser
           <--gRPC--   which scenes there are, their topology

On the WebSocket `/stream?token=...`, binary messages are the bus's own bytes (key, zero byte, protobuf), unchanged. Two
streams are made here, of scenes that this gateway or its program loaded: `rest`, a Frame with the rest positions, and
`field`, an element field on the surface (fields.py). A browser may choose codec, rate, normals and detail, in its
address or by a message `frames` (choice.py). Frames of a chosen codec have the key `encoded_frame` in place of
`frame`. With less detail, `simplified_topology` takes the place of `topology`. Both are acknowledged by the name that
they replace. Text messages are JSON. gateway.proto describes all of them, messages.py writes and reads them.

A browser that breaks this protocol is closed with code 1008 and the reason. A choice that there is not is answered with
its error instead, and the choice before holds. A browser that sends more than its budget is closed alike (`COSTS`,
connections.py).

admission.py says who may connect, connections.py what a connection may do before. journal.py logs whom they refuse.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web
from google.protobuf.message import Message

from tensormass import builtin_scenes
from tensormass.v1 import gateway_pb2, scene_pb2
from tensormass_gateway import connections, metrics
from tensormass_gateway.admission import Admission, check_tokens, checked
from tensormass_gateway.budget import Turns
from tensormass_gateway.choice import Choice, ChoiceError, choice_of
from tensormass_gateway.connections import Connection, Connections, connection_limit
from tensormass_gateway.control import MAX_WAITING, Command, CommandError, Control, Outcome, read_command
from tensormass_gateway.daemon import Daemon
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.journal import Journal
from tensormass_gateway.messages import read, result_to_json, to_json
from tensormass_gateway.options import GatewayOptions
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.page_tls import check_page, page_context
from tensormass_gateway.playback import Playback
from tensormass_gateway.player import Recording
from tensormass_gateway.requests import (
    MAX_COORDINATE_M,
    ProtocolError,
    finite_number,
    finite_numbers,
    is_name,
    printable,
    read_request,
    rotation,
)
from tensormass_gateway.surface import FIELDS
from tensormass_gateway.tasks import background

log = logging.getLogger(__name__)
MAX_BROWSER_MESSAGE_BYTES = 4096
"""A larger message from a browser closes its connection."""

HEARTBEAT_S = 15.0
"""A browser that does not answer a ping for this long is disconnected. It reconnects when it wakes."""

CLOSE_S = 2.0
"""Time in which a browser answers that its connection is closed. Until then it counts."""

COSTS = {"watch": 20, "frames": 20, "field": 20, "control": 5}
"""Further units of a browser's budget (`Connection.frames`) that a request takes, because it is work for all."""

OF_A_BROWSER = ("type", "builtin_scenes", "operator", "poses_allowed")
"""What `/status` leaves out of a daemon's state, because only a browser is told it."""

TURNS_PER_S, MOST_TURNS = 50.0, 32
"""Requests `watch`, `frames` and `field` of all browsers that start in a second, and at once. Later ones wait."""


class Browser(Watcher):
    """One connected viewer."""

    def __init__(
        self, socket: web.WebSocketResponse, connection: Connection, choice: Choice, *, operator: bool
    ) -> None:
        super().__init__()
        self.choose(choice)
        self.socket = socket
        self.connection = connection
        self.operator = operator
        self.place = 0
        """Number of the browser among those that are connected, from 0. The next one takes it over."""
        self.commands: set[asyncio.Task[None]] = set()
        """Commands that are not answered yet."""
        self._states: dict[str, Message] = {}
        self._wake = asyncio.Event()

    @property
    def who(self) -> str:
        """Returns role and address, for the log."""
        return f"{'operator' if self.operator else 'viewer'} {self.connection.who}"

    def choose(self, choice: Choice) -> None:
        """Takes a choice of frames, from the next frame on."""
        self.encoder.choice = choice
        self.outbox.set_rate(choice.rate_hz)

    async def send(self, message: Message) -> None:
        """Sends a text message of gateway.proto."""
        await self.socket.send_json(to_json(message))

    def tell_state(self, state: Message) -> None:
        """Sends a state as soon as the socket takes it. A newer one of the same type replaces one that waits."""
        self._states[state.DESCRIPTOR.full_name] = state
        self._wake.set()

    async def send_states(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._states:
                first = next(iter(self._states))
                await self.send(self._states.pop(first))

    async def send_messages(self) -> None:
        while True:
            message = await self.outbox.take()
            self.connection.frames.earn()  # its acknowledgement
            if isinstance(message, SharedFrame):
                message = await self.encoder.encode(message)
            await self.socket.send_bytes(message)


class Gateway:
    """HTTP server: the viewer's files, and one WebSocket for each browser. Use `serve`."""

    def __init__(
        self,
        options: GatewayOptions,
        known: Mapping[str, scene_pb2.Scene] | None = None,
        recording: Recording | None = None,
    ) -> None:
        if not (options.viewer / "index.html").is_file():
            raise FileNotFoundError(
                f"{options.viewer} holds no built viewer; build it with `npm ci && npm run build` in clients/web, "
                "install a wheel of `make wheel`, or name a folder with --viewer"
            )
        if options.max_browsers < 1:
            raise ValueError(f"max_browsers is {options.max_browsers}; at least one browser must be let in")
        check_tokens(options)
        self.options = options
        self._journal = Journal()
        self._admission = Admission(options, self._journal)
        self._connection_limit = connection_limit(options.max_browsers, tls=options.page is not None)
        self._turns = Turns(TURNS_PER_S, MOST_TURNS)
        self.port = options.port
        self.closed_for_errors = 0
        self._browsers: set[Browser] = set()
        self._daemon: Daemon | Playback
        self._control: Control | Playback
        if recording is None:
            self._daemon = Daemon(options.control, options.poll_interval_s, self._announce, known, options.keys)
            self._control = Control(self._daemon)
        else:
            self._daemon = self._control = Playback(recording, self._announce, self._announce_head)
        self._runner: web.AppRunner | None = None
        self._listener: asyncio.Server | None = None
        self._follower: asyncio.Task[None] | None = None

    @property
    def url(self) -> str:
        """Returns the address to open, with the operators' token. It is good for ever, so nothing prints it."""
        return self._address("token", self.options.operator_token)

    @property
    def look_url(self) -> str:
        """Returns the address for those who only look."""
        return self._address("token", self.options.token)

    @property
    def once_url(self) -> str:
        """Returns the address to open once, with an operator's code."""
        return self._address("code", self._admission.entry.code(operator=True))

    @property
    def look_once_url(self) -> str:
        """Returns the address to open once, for those who only look."""
        return self._address("code", self._admission.entry.code(operator=False))

    def on_code_used(self, tell: Callable[[], None]) -> None:
        """Calls `tell` when a page has used a code up, and another one counts."""
        self._admission.entry.on_used = tell

    @property
    def browser_count(self) -> int:
        return len(self._browsers)

    def stats(self) -> dict[str, Any]:
        """Returns the counters of `/status`, ready for JSON."""
        daemon = to_json(self._daemon.state())
        for name in OF_A_BROWSER:
            del daemon[name]
        return {
            "daemon": daemon,
            "browsers": [
                {
                    "scene": browser.scene,
                    "codec": browser.encoder.choice.codec,
                    "detail": browser.detail,
                    "replaced": browser.outbox.replaced,
                }
                for browser in sorted(self._browsers, key=lambda browser: browser.client_id)
            ],
            "refused_connections": self._admission.refused_connections,
            "closed_for_errors": self.closed_for_errors,
            "malformed_messages": self._daemon.malformed,
        }

    async def metrics(self) -> str:
        """Returns the text of `/metrics`: the daemon's, then the gateway's own."""
        daemon = await self._daemon.metrics()
        counts = metrics.Counts(
            daemon_up=bool(daemon),
            replaced_frames={browser.place: browser.outbox.replaced for browser in self._browsers},
            max_browsers=self.options.max_browsers,
            refused_connections=self._admission.refused_connections,
            closed_for_errors=self.closed_for_errors,
            malformed_messages=self._daemon.malformed,
        )
        return daemon + metrics.to_text(counts)

    def _address(self, name: str, value: str) -> str:
        host = f"[{self.options.host}]" if ":" in self.options.host else self.options.host
        scheme = "http" if self.options.page is None else "https"
        return f"{scheme}://{host}:{self.port}/?{name}={value}"

    async def start(self) -> None:
        """Starts to listen. Raises OSError if the address is taken, ValueError if it needs a certificate."""
        check_page(self.options.host, self.options.page)
        app = web.Application(middlewares=[checked])
        app.add_routes(
            [
                web.get("/", self._page),
                web.get("/stream", self._stream),
                web.post("/stream", self._ask_admission),
                web.post("/enter", self._enter),
                web.get("/status", self._status),
                web.get("/metrics", self._metrics),
                web.static("/assets", self.options.viewer / "assets"),
            ]
        )
        self._runner = web.AppRunner(app, shutdown_timeout=1.0)
        await self._runner.setup()
        assert self._runner.server is not None
        page = self.options.page
        factory = Connections(self._runner.server, self._connection_limit, self._journal, tls=page is not None)
        self._listener = await asyncio.get_running_loop().create_server(
            factory,
            self.options.host,
            self.options.port,
            ssl=page_context(page) if page is not None else None,
            ssl_handshake_timeout=connections.HANDSHAKE_S if page is not None else None,
            ssl_shutdown_timeout=connections.TLS_END_S if page is not None else None,
        )
        self.port = self._admission.entry.port = self._listener.sockets[0].getsockname()[1]
        self._follower = background(self._daemon.follow())

    async def stop(self) -> None:
        """Closes every connection and task."""
        if self._follower is not None:
            self._follower.cancel()
        if self._listener is not None:
            self._listener.close()
        for browser in list(self._browsers):
            for command in browser.commands:
                command.cancel()
            await browser.socket.close(code=WSCloseCode.GOING_AWAY, message=b"the gateway stops")
        if self._runner is not None:
            await self._runner.cleanup()
        await self._daemon.close()

    async def _page(self, request: web.Request) -> web.FileResponse:
        return web.FileResponse(self.options.viewer / "index.html", headers={"Cache-Control": "no-cache"})

    async def _enter(self, request: web.Request) -> web.Response:
        """Changes a token or a code into a cookie (entry.py)."""
        try:
            given = json.loads(await request.read())
            token, code = str(given.get("token", "")), str(given.get("code", ""))
        except (ValueError, AttributeError, RecursionError):
            raise web.HTTPBadRequest(text='send {"code": ...} or {"token": ...}\n') from None
        return self._admission.enter(request, token, code)

    async def _status(self, request: web.Request) -> web.Response:
        self._admission.check_token(request)
        return web.json_response(self.stats(), headers={"Cache-Control": "no-store"})

    async def _metrics(self, request: web.Request) -> web.Response:
        self._admission.check_scraper(request)
        headers = {"Content-Type": metrics.CONTENT_TYPE, "Cache-Control": "no-store"}
        return web.Response(body=(await self.metrics()).encode(), headers=headers)

    async def _ask_admission(self, request: web.Request) -> web.Response:
        self._admission.check(request, len(self._browsers))
        _choice_of(request)
        return web.Response(status=204)

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        self._admission.check(request, len(self._browsers))
        choice = _choice_of(request)
        socket = web.WebSocketResponse(
            timeout=CLOSE_S, heartbeat=HEARTBEAT_S, max_msg_size=MAX_BROWSER_MESSAGE_BYTES, compress=False
        )
        connection = request.protocol
        assert isinstance(connection, Connection)
        connection.become_viewer()
        browser = Browser(socket, connection, choice, operator=self._admission.is_operator(request))
        taken = {each.place for each in self._browsers}
        browser.place = next(place for place in itertools.count() if place not in taken)
        # Counts the browser before the handshake, so that no burst passes the limit.
        self._browsers.add(browser)
        senders: list[asyncio.Task[None]] = []
        try:
            await socket.prepare(request)
            browser.tell_state(self._daemon_state(browser))
            if isinstance(self._daemon, Playback):
                browser.tell_state(self._daemon.head())
            senders = [background(browser.send_messages()), background(browser.send_states())]
            await _unless_refused(self._listen(browser), connection.refused)
        except ProtocolError as error:
            self.closed_for_errors += 1
            self._note_closed(browser, str(error))
            await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode()[:120])
        except ConnectionError as error:  # the browser disconnected during an answer
            log.info("a browser went away: %s", error)
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
                self._note_closed(browser, str(message.data))
                return
            if message.type is not WSMsgType.TEXT:
                raise ProtocolError("a browser sends text messages only")
            request = read_request(message.data)
            # An unknown type costs nothing: it ends the connection.
            cost = COSTS.get(str(request.get("type")), 0)
            if cost and not browser.connection.frames.spend(cost):
                raise ProtocolError(
                    f"more requests {request['type']!r} than a browser may make; make fewer in a second"
                )
            await self._handle(browser, request)

    def _note_closed(self, browser: Browser, reason: str) -> None:
        self._journal.note("closed", who=browser.who, what="stream", scene=browser.scene or "", reason=reason)

    async def _handle(self, browser: Browser, request: dict[str, Any]) -> None:
        match request:
            case {"type": "ack", "stream": str(stream)}:
                if stream not in set(Stream):
                    raise ProtocolError(f"acknowledged {stream!r}, which is not a stream")
                browser.outbox.acknowledge(Stream(stream))
                if stream == Stream.FRAME:
                    await self._take_keyframe(browser, request.get("keyframe"))
            case {"type": "frames"}:
                await self._turns.take()
                await self._choose(browser, {key: value for key, value in request.items() if key != "type"})
            case {"type": "clock", "client_time_ms": client_time_ms}:
                if finite_number(client_time_ms) is None:
                    raise ProtocolError("client_time_ms is not a finite number")
                await browser.send(
                    gateway_pb2.ClockReply(
                        client_time_ms=read(request).clock.client_time_ms,
                        gateway_time_ms=time.time_ns() / 1e6,
                        replaced=browser.outbox.replaced,
                    )
                )
            case {"type": "watch", "scene": str(scene)}:
                if not is_name(scene):
                    raise ProtocolError("a scene's name is 1 to 64 characters of [A-Za-z0-9_-]")
                await self._turns.take()
                self._daemon.watch(browser, read(request).watch.scene)
            case {"type": "control"}:
                # Counted here: a burst is read before its first command starts.
                crowded = len(browser.commands) >= MAX_WAITING
                task = background(self._execute(browser, read_command(request), crowded=crowded))
                browser.commands.add(task)
                task.add_done_callback(browser.commands.discard)
            case {"type": "field", "name": str(name)}:
                if name and name not in FIELDS:
                    raise ProtocolError(f"a field is one of {', '.join(FIELDS)}")
                await self._turns.take()
                self._daemon.show_field(browser, read(request).field.name)
            case {"type": "pose", "tool": str(), "position_m": position_m}:
                if not self.options.allow_poses:
                    raise ProtocolError("this gateway takes no poses (--allow-poses)")
                if not browser.operator:
                    raise ProtocolError("only an operator moves tools")
                position = finite_numbers(position_m, 3)
                if position is None or max(map(abs, position)) > MAX_COORDINATE_M:
                    raise ProtocolError("position_m is not three finite numbers [m]")
                given = request.get("orientation")
                orientation = None if given is None else rotation(given)
                level = finite_numbers([request.get("level", 0)], 1)
                if level is None or not 0 <= level[0] <= 1:
                    raise ProtocolError("level is not a number from 0 to 1")
                self._daemon.move_tool(browser, read(request).pose.tool, position, orientation, level[0])
            case _:
                raise ProtocolError("a message's type or fields are unknown")

    async def _choose(self, browser: Browser, request: dict[str, Any]) -> None:
        error, detail = "", browser.detail
        try:
            browser.choose(browser.encoder.choice.changed(request))
        except ChoiceError as refusal:
            error = str(refusal)
        if browser.detail != detail:
            self._daemon.show_detail(browser)
        await browser.send(browser.encoder.choice.message(error))

    async def _take_keyframe(self, browser: Browser, keyframe: object) -> None:
        try:
            browser.encoder.acknowledge(keyframe)
        except ChoiceError as refusal:
            await browser.send(browser.encoder.choice.message(str(refusal)))

    async def _execute(self, browser: Browser, command: Command, *, crowded: bool) -> None:
        """Executes a command and answers it. Frames keep flowing meanwhile, because a load takes long."""
        error, outcome = "", Outcome(command.scene)
        try:
            if not browser.operator:
                raise CommandError("this address only lets you look; open the operator's address")
            if crowded:
                raise CommandError(f"{MAX_WAITING} commands wait for an answer; wait for them")
            outcome = await self._control.execute(command)
        except CommandError as failure:
            error = str(failure)
        except Exception:  # an error of our own; the operator still gets an answer
            log.exception("%s of scene %s failed", command.action, command.scene)
            error = "the gateway failed; its log says why"
        if error:
            what = f"control {command.action}"
            self._journal.note("refused", who=browser.who, what=what, scene=command.scene, reason=error)
        result = gateway_pb2.CommandResult(
            id=command.id,
            action=command.action,
            scene=outcome.scene,
            error=printable(error),
            adjustments=outcome.adjustments,
            findings=outcome.findings,
        )
        await browser.socket.send_json(result_to_json(result, loaded=outcome.findings is not None))

    def _daemon_state(self, browser: Browser) -> gateway_pb2.DaemonState:
        state = self._daemon.state()
        state.builtin_scenes.extend(builtin_scenes())
        state.operator = browser.operator
        state.poses_allowed = self.options.allow_poses and browser.operator
        return state

    def _announce(self) -> None:
        for browser in self._browsers:
            browser.tell_state(self._daemon_state(browser))

    def _announce_head(self) -> None:
        assert isinstance(self._daemon, Playback)
        for browser in self._browsers:
            browser.tell_state(self._daemon.head())


async def _unless_refused(listening: Coroutine[Any, Any, None], refused: asyncio.Future[str]) -> None:
    """Runs `listening` to its end. Raises ProtocolError with the reason when the connection is refused before."""
    task = asyncio.create_task(listening)
    waited: set[asyncio.Future[Any]] = {task, refused}
    try:
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        if refused.done():
            raise ProtocolError(refused.result())
        task.result()
    finally:
        task.cancel()
        await asyncio.wait({task})


def _choice_of(request: web.Request) -> Choice:
    """Returns the choice in the address of a request, or refuses it with the reason."""
    try:
        return choice_of(request.query)
    except ChoiceError as error:
        raise web.HTTPBadRequest(text=f"{error}\n") from error


@contextlib.asynccontextmanager
async def serve(
    options: GatewayOptions,
    known: Mapping[str, scene_pb2.Scene] | None = None,
    recording: Recording | None = None,
) -> AsyncIterator[Gateway]:
    """Runs a gateway: `async with serve(options) as gateway: print(gateway.url)`.

    Args:
        options: the gateway's address, and who may connect.
        known: messages of scenes that are loaded, by name. Of these the gateway can show element fields.
        recording: served in place of the daemon; None: the daemon is served.

    Raises FileNotFoundError if the viewer is not built, OSError if the address is taken.
    """
    gateway = Gateway(options, known, recording)
    try:
        await gateway.start()
        yield gateway
    finally:
        await gateway.stop()
