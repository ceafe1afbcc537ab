"""How a page gets in: it changes what its address holds into a cookie, so that no address or history keeps a token.

    printed: /?code=...  --page--> POST /enter {"code": ...}   --> cookie of a session; the code is used up
    given:   /?token=... --page--> POST /enter {"token": ...}  --> cookie of a session

The cookie is HttpOnly, so no script reads it, and SameSite=Strict, so no other page sends it. Other
programs may give the token with each request instead (admission.py).
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable

from aiohttp import web

from tensormass_gateway.options import GatewayOptions

MAX_SESSIONS = 256
"""Pages of each role that are let in at once. The oldest makes room, so lookers push no operator out."""

_LOOK, _OPERATE = False, True


class Entry:
    """Codes that are printed, and sessions of pages that got in."""

    def __init__(self, options: GatewayOptions) -> None:
        self._options = options
        self._codes = {_LOOK: new_secret(), _OPERATE: new_secret()}
        self._sessions: dict[str, bool] = {}
        """Whether each is an operator's; oldest first."""
        self.port = options.port
        """The port on which the gateway listens."""
        self.on_used: Callable[[], None] = lambda: None
        """Called when a code was used up, and another one counts."""

    def code(self, *, operator: bool) -> str:
        """Returns the code that counts now."""
        return self._codes[operator]

    def enter(self, token: str, code: str) -> str | None:
        """Returns a new session for a token or a code; None if neither is right."""
        operator = self.role_of_token(token)
        by_code = operator is None
        if operator is None:
            used = [role for role, right in self._codes.items() if same(code, right)]
            if not used:
                return None
            operator = used[0]
            self._codes[operator] = new_secret()
        session = new_secret()
        self._sessions[session] = operator
        alike = [each for each, role in self._sessions.items() if role == operator]
        for oldest in alike[:-MAX_SESSIONS]:
            del self._sessions[oldest]
        if by_code:
            self.on_used()
        return session

    def role_of(self, request: web.Request) -> bool | None:
        """Returns whether a request is an operator's; None if it is nobody's. A token counts alone, so that who gives a
        wrong one is told so, also in a browser that was let in before."""
        token = request.query.get("token")
        if token is not None:
            return self.role_of_token(token)
        return self._sessions.get(request.cookies.get(self.cookie, ""))

    def role_of_token(self, token: str) -> bool | None:
        if same(token, self._options.operator_token):
            return _OPERATE
        return _LOOK if same(token, self._options.token) else None

    @property
    def cookie(self) -> str:
        """Returns the cookie's name. Browsers share cookies among the ports of a host."""
        return f"tensormass-{self.port}"


def new_secret() -> str:
    return secrets.token_urlsafe(24)


def same(given: str, right: str) -> bool:
    """Compares in a time that does not depend on the given text."""
    return hmac.compare_digest(given.encode(errors="surrogatepass"), right.encode())
