"""Admission of browsers by token, Origin header and number; and the headers of every answer.

There are two tokens: one to look, one for operators, who also control scenes. Whoever knows one of them, or has the
cookie that a page got for it (entry.py), may connect from a page of this gateway or of an --origin, up to a number of
browsers. The Origin header names the page; a program that is not a browser sends the gateway's own, http://host:port.
A browser hides from its page why a WebSocket was refused; POST on the same address tells.
"""

from __future__ import annotations

import ipaddress
import platform
from collections.abc import Callable
from typing import Any, NoReturn
from urllib.parse import urlsplit

from aiohttp import web

from tensormass_gateway.connections import Connection
from tensormass_gateway.entry import Entry, same
from tensormass_gateway.journal import Journal
from tensormass_gateway.options import GatewayOptions
from tensormass_gateway.origins import origin_of

MIN_TOKEN_CHARACTERS = 16
"""A shorter token is refused at the start, because it can be guessed. Those that are made here have 32."""

_NOT_LET_IN = "the token is missing or wrong; use the address that was printed\n"

_NO_SCRAPER = "the token is missing or wrong; send `Authorization: Bearer` with that of --metrics-token-file\n"

_HEADERS = {
    # WebAssembly decodes frames of the codec meshopt.
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; img-src 'self' data: blob:; "
        "object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    # The address holds the token.
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def check_tokens(options: GatewayOptions) -> None:
    """Raises ValueError for a token that can be guessed. Never says the token: the message may end in a log."""
    for option, token in (
        ("--token-file", options.token),
        ("--operator-token-file", options.operator_token),
        ("--metrics-token-file", options.metrics_token),
    ):
        if len(token) < MIN_TOKEN_CHARACTERS:
            raise ValueError(
                f"{option} has {len(token)} characters; a token that nobody guesses has {MIN_TOKEN_CHARACTERS} or "
                f"more: leave {option} out for a random one"
            )


class Admission:
    """Checks of one gateway."""

    def __init__(self, options: GatewayOptions, journal: Journal) -> None:
        self.refused_connections = 0
        self._journal = journal
        self._options = options
        self.entry = Entry(options)
        self._origins = frozenset(origin_of(origin) for origin in options.origins)
        self._own_names = frozenset({options.host.lower(), "localhost", platform.node().lower()})

    def check(self, request: web.Request, browser_count: int) -> None:
        """Refuses a browser that may not connect, by an HTTP error with the reason.

        Args:
            browser_count: how many are connected now.
        """
        self.check_token(request)
        self.check_origin(request)
        if browser_count >= self._options.max_browsers:
            full = f"{self._options.max_browsers} browsers are connected (--max-browsers)\n"
            self._refuse(request, web.HTTPServiceUnavailable(text=full))

    def enter(self, request: web.Request, token: str, code: str) -> web.Response:
        """Answers with the cookie of a new session."""
        self.check_origin(request)
        session = self.entry.enter(token, code)
        if session is None:
            self._refuse(request, web.HTTPForbidden(text=_NOT_LET_IN))
        response = web.Response(status=204)
        response.set_cookie(
            self.entry.cookie, session, httponly=True, samesite="Strict", secure=request.secure, path="/"
        )
        return response

    def check_origin(self, request: web.Request) -> None:
        """Refuses a page that is not this gateway's own, and none of --origin."""
        # A page from elsewhere could make a browser that knows the token connect. The browser names that page here.
        origin = request.headers.get("Origin", "")
        if not origin.isascii():
            self._refuse(request, web.HTTPForbidden(text="the Origin header is not ASCII; send it as a browser does\n"))
        if not origin:
            wanted = f"that of this gateway's page, http://{request.host}, or one given with --origin"
            self._refuse(request, web.HTTPForbidden(text=f"the Origin header is missing; send {wanted}\n"))
        if not self._is_named(origin) and not self._is_own(origin, request.host):
            self._refuse(request, web.HTTPForbidden(text=f"Origin {origin} is not let in; allow it with --origin\n"))

    def _is_named(self, origin: str) -> bool:
        """Tells whether --origin allows pages of `origin`."""
        try:
            return origin_of(origin) in self._origins
        except ValueError:
            return False

    def _is_own(self, origin: str, host: str) -> bool:
        """Tells whether a page of `origin` came from this gateway, which the browser calls `host`."""
        if origin not in (f"http://{host}", f"https://{host}"):
            return False
        # Equal names prove nothing: whoever serves a page can later let its name point here (DNS rebinding) and try
        # tokens. An address cannot be rebound, and nobody else has our own names.
        try:
            name = urlsplit(origin).hostname or ""
            if name not in self._own_names:
                ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def check_token(self, request: web.Request) -> None:
        """Refuses a request that has neither a token nor the cookie of a session."""
        if self.entry.role_of(request) is None:
            self._refuse(request, web.HTTPForbidden(text=_NOT_LET_IN))

    def check_scraper(self, request: web.Request) -> None:
        """Refuses a request that has neither a token in `Authorization: Bearer` nor what `check_token` takes."""
        scheme, _, token = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            token = token.strip()
            if same(token, self._options.metrics_token) or self.entry.role_of_token(token) is not None:
                return
        elif self.entry.role_of(request) is not None:
            return
        self._refuse(request, web.HTTPForbidden(text=_NO_SCRAPER))

    def is_operator(self, request: web.Request) -> bool:
        """Tells whether a request has the operators' token, or the cookie that a page got for it."""
        return self.entry.role_of(request) is True

    def _refuse(self, request: web.Request, error: web.HTTPException) -> NoReturn:
        self.refused_connections += 1
        who = request.protocol.who if isinstance(request.protocol, Connection) else str(request.remote)
        what = f"{request.method} {request.path}"
        self._journal.note("refused", who=who, what=what, reason=error.text or error.reason)
        raise error


@web.middleware
async def checked(request: web.Request, handler: Callable[[web.Request], Any]) -> web.StreamResponse:
    """Answers what a browser would not ask for by a refusal, and adds the headers that each answer has."""
    if isinstance(request.protocol, Connection):
        request.protocol.take_request()
    try:
        if not request.headers.get("Sec-WebSocket-Key", "").isascii():
            raise web.HTTPBadRequest(text="the header Sec-WebSocket-Key is not base64\n")
        response: web.StreamResponse = await handler(request)
    except web.HTTPException as error:
        error.headers.update(_HEADERS)
        raise
    except OSError as error:
        if isinstance(error, ConnectionError):
            raise
        # A name that the file system does not take, such as one of 256 characters.
        missing = f"there is no such file: {error.strerror}\n"
        raise web.HTTPNotFound(text=missing, headers=_HEADERS) from error
    if not response.prepared:
        response.headers.update(_HEADERS)
    return response
