"""The Origin header: which pages may connect."""

from __future__ import annotations

import contextlib
from urllib.parse import urlsplit

_DEFAULT_PORTS = {"http": 80, "https": 443}
"""Ports that browsers leave out of an Origin."""


def origin_of(text: str) -> str:
    """Returns `text` as browsers write an Origin: scheme://host[:port] in small letters, without a default port.

    Raises ValueError if `text` has more than that, such as a path, or less.
    """
    if text == "null":  # browsers send this for a page opened from a file
        return text
    with contextlib.suppress(ValueError):  # an invalid bracket or port
        parts = urlsplit(text)
        host = parts.hostname or ""
        more = "@" in parts.netloc or parts.path not in ("", "/") or parts.query or parts.fragment
        if parts.scheme and host and host.isascii() and not more:
            name = f"[{host}]" if ":" in host else host
            port = "" if parts.port in (None, _DEFAULT_PORTS.get(parts.scheme)) else f":{parts.port}"
            return f"{parts.scheme}://{name}{port}"
    raise ValueError(f"origin {text!r} is not scheme://host[:port], such as http://viewer.example:8000")
