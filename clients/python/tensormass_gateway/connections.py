"""Connections of the gateway: how many, how long they may idle, and which WebSocket frames they may send.

    socket --> Connection: header in 15 s and 32 KiB --> aiohttp: HTTP --> admission (admission.py)
                  |                                                             | a viewer
                  +--> FrameGate: masked frames, within a budget  <-------------+

A stranger without a token can open connections, so their number stays below the limit of descriptors of this process.
When all are taken, the oldest that is not a viewer makes room. An honest page therefore loads while a stranger holds
hundreds of connections: it needs its own for milliseconds. Connections that shake hands of TLS are bounded alike.
"""

from __future__ import annotations

import asyncio
import resource
from typing import Any, Protocol

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from tensormass_gateway.budget import Budget
from tensormass_gateway.journal import Journal

MAX_CONNECTIONS = 512
"""Connections at once, viewers included."""

SPARE_CONNECTIONS = 16
"""Connections beyond the viewers that there must be, to load pages."""

MAX_SHAKING = 64
"""Connections that shake hands of TLS at once. When one more comes, the oldest makes room."""

HANDSHAKE_S = 5.0
"""Time for TLS's handshake."""

TLS_END_S = 2.0
"""Time in which a browser answers that TLS ends."""

IDLE_S = 15.0
"""A connection without a whole request for this long is closed."""

MAX_REQUEST_BYTES = 32 << 10
"""Bytes of a request, headers included. A longer one ends its connection."""

MAX_HEADERS = 64
MAX_HEADER_BYTES = 8190
"""Bytes of one line of a header."""

FRAMES_PER_S = 400.0
"""WebSocket frames that a viewer may send in a second, in the long run. Each message that it gets allows one more."""

MOST_FRAMES = 400.0
"""Frames that it may send at once, after a pause."""

_DESCRIPTORS_OF_PROGRAM = 64
_DESCRIPTORS_A_VIEWER = 8
_DESCRIPTORS_A_CONNECTION = 2
"""The socket, and the file that it is sent."""

UNMASKED = "frames of a browser are masked (RFC 6455, section 5.1)"
TOO_MANY_FRAMES = f"more than {FRAMES_PER_S:g} messages a second"


def connection_limit(max_browsers: int, descriptors: int | None = None, *, tls: bool = False) -> int:
    """Returns how many connections may be open at once.

    Args:
        max_browsers: viewers at once.
        descriptors: that this process may have; None: asks the system.
        tls: further connections shake hands.

    Raises ValueError if so many viewers need more descriptors.
    """
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0] if descriptors is None else descriptors
    if soft == resource.RLIM_INFINITY:
        soft = 1 << 20
    held = _DESCRIPTORS_OF_PROGRAM + _DESCRIPTORS_A_VIEWER * max_browsers + (MAX_SHAKING if tls else 0)
    limit = (soft - held) // _DESCRIPTORS_A_CONNECTION
    least = max_browsers + SPARE_CONNECTIONS
    if limit < least:
        raise ValueError(
            f"max_browsers is {max_browsers}: so many need {held + _DESCRIPTORS_A_CONNECTION * least} open files, and "
            f"this process may have {soft}; raise the limit with `ulimit -n`, or let fewer browsers in"
        )
    return min(limit, max(MAX_CONNECTIONS, least))


class Connections:
    """The open connections of one gateway. Called, it makes one: the factory that asyncio's server needs."""

    def __init__(self, server: web.Server, limit: int, journal: Journal, *, tls: bool) -> None:
        self._tls = tls
        self.limit = limit
        self.journal = journal
        self._server = server
        self._strangers: dict[Connection, None] = {}
        """Connections that are not viewers, oldest first."""
        self._viewers: set[Connection] = set()
        self._shaking: dict[asyncio.Task[Any], None] = {}
        """Tasks of asyncio that wait for TLS's handshake, oldest first."""

    def __call__(self) -> Connection:
        if self._tls:
            self._bound_handshakes()
        return Connection(self, self._server)

    def __len__(self) -> int:
        return len(self._strangers) + len(self._viewers)

    def add(self, connection: Connection) -> None:
        """Takes a new connection. If all are taken, ends the oldest that is not a viewer."""
        self._strangers[connection] = None
        if len(self) > self.limit:
            oldest = next(iter(self._strangers))
            oldest.evict(f"{self.limit} connections are open; the oldest without a viewer made room")
            self.remove(oldest)

    def keep(self, connection: Connection) -> None:
        """Takes note that a connection is a viewer's. It is not ended to make room."""
        self._strangers.pop(connection, None)
        self._viewers.add(connection)

    def _bound_handshakes(self) -> None:
        # asyncio tells of a connection after its handshake. Until then there is only the task that called us, and
        # ends the connection when it is cancelled.
        task = asyncio.current_task()
        assert task is not None
        self._shaking[task] = None
        task.add_done_callback(lambda done: self._shaking.pop(done, None))
        if len(self._shaking) > MAX_SHAKING:
            oldest = next(iter(self._shaking))
            del self._shaking[oldest]
            asyncio.get_running_loop().call_soon(oldest.cancel)  # not before its handshake has begun
            reason = f"{MAX_SHAKING} connections shake hands; the oldest made room"
            self.journal.note("evicted", who="nobody yet", what="connection", reason=reason)

    def remove(self, connection: Connection) -> None:
        self._strangers.pop(connection, None)
        self._viewers.discard(connection)


class Connection(web.RequestHandler):
    """One connection: aiohttp's, within limits."""

    def __init__(self, connections: Connections, server: web.Server) -> None:
        super().__init__(
            server,
            loop=asyncio.get_running_loop(),
            access_log=None,  # type: ignore[arg-type]
            keepalive_timeout=IDLE_S,
            max_headers=MAX_HEADERS,
            max_line_size=MAX_HEADER_BYTES,
            max_field_size=MAX_HEADER_BYTES,
        )
        self.who = "nobody yet"
        """Address of the peer, host:port."""
        self.frames = Budget(FRAMES_PER_S, MOST_FRAMES)
        """Frames and requests that a viewer may still send."""
        self.refused: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        """Done when a frame breaks a limit: the reason for closing."""
        self._connections = connections
        self._request_bytes = 0
        self._is_viewer = False
        self._transport: asyncio.Transport | None = None
        self._no_request: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        peer = transport.get_extra_info("peername")
        self.who = f"{peer[0]}:{peer[1]}" if peer else "unknown"
        self._connections.add(self)
        super().connection_made(transport)
        # aiohttp before 3.14 waits for the first request for ever.
        self._no_request = asyncio.get_running_loop().call_later(IDLE_S, self._abort)

    def connection_lost(self, error: BaseException | None) -> None:
        self._connections.remove(self)
        self._end_wait()
        super().connection_lost(error)

    def data_received(self, data: bytes) -> None:
        if not self._is_viewer:
            self._request_bytes += len(data)
            if self._request_bytes > MAX_REQUEST_BYTES:
                self.evict(f"a request has more than {MAX_REQUEST_BYTES} bytes")
                return
        super().data_received(data)

    def take_request(self) -> None:
        """Takes note that a whole request has come."""
        self._request_bytes = 0
        self._end_wait()

    def become_viewer(self) -> None:
        """Takes note that this is a viewer's: it is bounded by its frames from now on."""
        self._is_viewer = True
        self._connections.keep(self)

    def set_parser(self, parser: Any, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        super().set_parser(FrameGate(parser, self.frames, self._refuse), *args, **kwargs)  # type: ignore[arg-type]

    def evict(self, reason: str) -> None:
        """Ends the connection at once, whatever waits to be sent."""
        self._connections.journal.note("evicted", who=self.who, what="connection", reason=reason)
        self._abort()

    def log_exception(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401
        """Logs a failed request: a line for a malformed one, a traceback for an error of our own."""
        error = kwargs.get("exc_info")
        if isinstance(error, HttpProcessingError):
            # The error's own text holds the address, and that may hold a token.
            reason = f"malformed: {type(error).__name__}"
            self._connections.journal.note("refused", who=self.who, what="request", reason=reason)
        else:
            super().log_exception(*args, **kwargs)

    def _refuse(self, reason: str) -> None:
        if not self.refused.done():
            self.refused.set_result(reason)

    def _end_wait(self) -> None:
        if self._no_request is not None:
            self._no_request.cancel()
            self._no_request = None

    def _abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()


class Reader(Protocol):
    """The parts of aiohttp's reader of WebSocket frames that a connection calls."""

    def feed_data(self, data: bytes) -> tuple[bool, bytes]: ...
    def feed_eof(self) -> None: ...


class FrameGate:
    """Lets WebSocket frames through to aiohttp's reader, which accepts unmasked ones and any number.

        0       1       2         2, 4 or 10
        | opcode| M len | (length) | mask (4) | payload ...

    After a frame that breaks a limit it lets nothing through.
    """

    def __init__(self, reader: Reader, budget: Budget, refuse: Any) -> None:  # noqa: ANN401
        """Makes a gate.

        Args:
            reader: gets the bytes, unchanged.
            budget: of frames.
            refuse: called once, with the reason, at a frame that breaks a limit.
        """
        self._reader = reader
        self._budget = budget
        self._refuse = refuse
        self._closed = False
        self._head = b""
        """First bytes of a frame whose length is not known yet."""
        self._payload_left = 0

    def feed_data(self, data: bytes) -> tuple[bool, bytes]:
        if self._closed:
            return False, b""
        if reason := self._check(bytes(data)):
            self._closed = True
            self._refuse(reason)
            return False, b""
        return self._reader.feed_data(data)

    def feed_eof(self) -> None:
        self._reader.feed_eof()

    def _check(self, data: bytes) -> str:
        """Returns why a frame that begins in `data` must be refused; empty if it may pass."""
        data = self._head + data
        at = self._payload_left
        while at + 2 <= len(data):
            length = data[at + 1] & 0x7F
            if not data[at + 1] & 0x80:
                return UNMASKED
            extended = {126: 2, 127: 8}.get(length, 0)
            if at + 2 + extended > len(data):
                break
            if not self._budget.spend():
                return TOO_MANY_FRAMES
            if extended:
                length = int.from_bytes(data[at + 2 : at + 2 + extended], "big")
            at += 2 + extended + 4 + length
        self._head = data[at:]
        self._payload_left = max(0, at - len(data))
        return ""
