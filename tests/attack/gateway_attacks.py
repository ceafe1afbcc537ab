"""Parts of the attacks on the gateway: raw sockets, because no client library breaks the protocol."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
from collections.abc import AsyncIterator
from typing import Any

import pytest

TOKEN = "a-token-of-a-test"
OPERATOR_TOKEN = "an-operators-token"


def frame(payload: bytes, *, opcode: int = 1, masked: bool = True, fin: bool = True) -> bytes:
    """A WebSocket frame. Its mask is zero, so that the payload stays readable."""
    head = bytes([opcode | (0x80 if fin else 0)])
    mask = 0x80 if masked else 0
    if len(payload) < 126:
        head += bytes([mask | len(payload)])
    elif len(payload) < 1 << 16:
        head += bytes([mask | 126]) + len(payload).to_bytes(2, "big")
    else:
        head += bytes([mask | 127]) + len(payload).to_bytes(8, "big")
    return head + (bytes(4) if masked else b"") + payload


def text(**message: object) -> bytes:
    return frame(json.dumps(message).encode())


class RawBrowser:
    """A WebSocket that was shaken hands with, byte by byte."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        self._reader = reader

    async def closed(self) -> tuple[int | None, str]:
        """Reads to the gateway's close frame, or to the end of the connection: code and reason."""
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                first, second = await self._reader.readexactly(2)
                length = second & 0x7F
                if length >= 126:
                    length = int.from_bytes(await self._reader.readexactly(2 if length == 126 else 8), "big")
                payload = await self._reader.readexactly(length)
                if first & 0xF == 8:
                    return int.from_bytes(payload[:2], "big"), payload[2:].decode()
        return None, ""


async def ask(port: int, target: str, *headers: bytes, method: str = "GET", body: bytes = b"") -> tuple[int, bytes]:
    """Sends a request as it is; status and body, or (0, b"") if the gateway ends the connection."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    lines = [f"{method} {target} HTTP/1.1".encode(), *headers]
    if not any(header.startswith(b"Host:") for header in headers):
        lines.append(b"Host: 127.0.0.1:%d" % port)
    if body:
        lines.append(b"Content-Length: %d" % len(body))
    try:
        writer.write(b"\r\n".join([*lines, b"", body]))
        head = await reader.readuntil(b"\r\n\r\n")
        lengths = [
            line.partition(b":")[2] for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:")
        ]
        return int(head.split()[1]), await reader.readexactly(int(lengths[0]) if lengths else 0)
    except (ConnectionError, asyncio.IncompleteReadError):
        return 0, b""
    finally:
        writer.close()


@contextlib.asynccontextmanager
async def raw_browser(port: int, token: str = TOKEN) -> AsyncIterator[RawBrowser]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    key = base64.b64encode(os.urandom(16)).decode()
    try:
        head = f"GET /stream?token={token} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
        head += "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        writer.write(f"{head}Sec-WebSocket-Key: {key}\r\n\r\n".encode())
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101 ")
        yield RawBrowser(reader, writer)
    finally:
        writer.close()


def journal(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    """The gateway's lines about refusals."""
    return [json.loads(record.getMessage()) for record in caplog.records if record.name == "tensormass_gateway.journal"]
