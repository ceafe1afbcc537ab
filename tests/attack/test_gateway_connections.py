"""Strangers that have no token: what they may hold of the gateway, and what they are told."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import resource
import ssl
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from asynchronous import DEADLINE_S, asynchronous
from daemon_parts import make_viewer
from gateway_attacks import OPERATOR_TOKEN, TOKEN, ask, journal, raw_browser
from gateway_parts import options

from tensormass_gateway import connections
from tensormass_gateway.admission import MIN_TOKEN_CHARACTERS
from tensormass_gateway.connections import MAX_REQUEST_BYTES, SPARE_CONNECTIONS, connection_limit
from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.journal import LINES_PER_S
from tensormass_gateway.options import add_arguments, options_from

IDLE_CONNECTIONS = 300
DESCRIPTORS = 256
"""Limit of the attacked program: fewer than there are attackers."""


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    return make_viewer(tmp_path / "dist")


def test_page_and_stream_open_while_a_stranger_holds_every_connection(viewer: Path, tmp_path: Path) -> None:
    program = (
        "import argparse, sys; from tensormass_gateway import command, options; parser = argparse.ArgumentParser();"
        "parser.add_argument('--server'); options.add_arguments(parser); sys.exit(command.run(parser.parse_args()))"
    )
    token = tmp_path / "token"
    token.touch(mode=0o600)
    token.write_text(TOKEN)
    arguments = ["--server", "127.0.0.1:1", "--viewer", str(viewer), "--token-file", str(token)]

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (DESCRIPTORS, DESCRIPTORS))

    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limited,
    ) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline().split("/?")[0].rpartition(":")[2])
            asyncio.run(asyncio.wait_for(hold_and_open(port), DEADLINE_S))
        finally:
            process.terminate()
            said = process.communicate(timeout=DEADLINE_S)[1]
    assert process.returncode == 0
    evicted = [json.loads(line) for line in said.splitlines() if '"evicted"' in line]
    assert evicted[0]["who"].startswith("127.0.0.1:")
    assert "connections are open; the oldest without a viewer made room" in evicted[0]["reason"]


async def hold_and_open(port: int) -> None:
    async with contextlib.AsyncExitStack() as stack, raw_browser(port) as before:
        for _ in range(IDLE_CONNECTIONS):
            _, writer = await asyncio.open_connection("127.0.0.1", port)
            stack.callback(writer.close)
        assert await ask(port, "/") == (200, b"<title>viewer</title>")
        assert (await ask(port, "/assets/main.js"))[0] == 200
        async with raw_browser(port):
            pass
        # The viewer that came first is still there: its protocol error is answered.
        before.writer.write(b"\x81\x00")
        assert (await before.closed())[0] == 1008


@contextlib.asynccontextmanager
async def over_https(folder: Path) -> AsyncIterator[tuple[Gateway, ssl.SSLContext]]:
    """A gateway with a page over HTTPS, and what a browser trusts."""
    keys = pytest.importorskip("tensormass_tools.keys.folder", reason="needs the extra `keys`").KeyFolder(folder / "k")
    keys.init([], 30)
    page = keys.add("gateway", "operator", pages=["viewer.example"])
    trust = ssl.create_default_context(cafile=str(keys.path / "page-authority.pem"))
    async with serve(options(make_viewer(folder / "dist"), page=page)) as gateway:
        yield gateway, trust


@asynchronous
async def test_page_over_https_opens_while_strangers_shake_no_hands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_SHAKING", 4)
    monkeypatch.setattr(connections, "HANDSHAKE_S", 3600.0)
    async with over_https(tmp_path) as (gateway, trust), contextlib.AsyncExitStack() as stack:
        silent = [await asyncio.open_connection("127.0.0.1", gateway.port) for _ in range(20)]
        for _, writer in silent:
            stack.callback(writer.close)
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port, ssl=trust)
        stack.callback(writer.close)
        writer.write(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 200 ")
        for reader, _ in silent[:-4]:
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == b""  # ends only when the gateway ends the connection


@asynchronous
async def test_a_handshake_of_tls_must_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "HANDSHAKE_S", 0.1)
    async with over_https(tmp_path) as (gateway, _):
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b""
        writer.close()


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"])
@asynchronous
async def test_idle_connection_is_closed(viewer: Path, monkeypatch: pytest.MonkeyPatch, sent: bytes) -> None:
    monkeypatch.setattr(connections, "IDLE_S", 0.1)
    async with serve(options(viewer)) as gateway:
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        writer.write(sent)
        with contextlib.suppress(ConnectionError):
            await reader.read()  # ends only when the gateway ends the connection
        writer.close()


@pytest.mark.parametrize(
    "piece", [b"x", b"A: b\r\n", b"Cookie: " + 4000 * b"c" + b"\r\n"], ids=["line", "headers", "long-headers"]
)
@asynchronous
async def test_header_without_end_ends_its_connection(
    viewer: Path, monkeypatch: pytest.MonkeyPatch, piece: bytes
) -> None:
    monkeypatch.setattr(connections, "IDLE_S", 3600.0)
    async with serve(options(viewer)) as gateway:
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        writer.write(b"GET / HTTP/1.1\r\nHost: x\r\n" + piece * (2 * MAX_REQUEST_BYTES // len(piece)))
        with contextlib.suppress(ConnectionError):
            answer = await reader.read()
            assert answer == b"" or answer.startswith(b"HTTP/1.0 400 ")
        writer.close()
        assert (await ask(gateway.port, "/"))[0] == 200


@asynchronous
async def test_many_requests_on_one_connection_are_answered(viewer: Path) -> None:
    request = b"GET / HTTP/1.1\r\nHost: x\r\nCookie: " + 4000 * b"c" + b"\r\n\r\n"
    async with serve(options(viewer)) as gateway:
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        for _ in range(2 * MAX_REQUEST_BYTES // len(request)):
            writer.write(request)
            assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 200 ")
            await reader.readexactly(len("<title>viewer</title>"))
        writer.close()


@pytest.mark.parametrize(
    ("target", "headers", "status"),
    [
        ("/assets/" + 256 * "a", [], 404),
        ("/assets/" + 2500 * "a/", [], 404),
        ("/assets/%00", [], 404),
        (f"/stream?token={TOKEN}", [b"Origin: http://\xff\xfe"], 403),
        (f"/stream?token={TOKEN}&codec=%ff", [b"Origin: http://127.0.0.1:%(port)d"], 400),
        (
            f"/stream?token={TOKEN}",
            [
                b"Origin: http://127.0.0.1:%(port)d",
                b"Connection: Upgrade",
                b"Upgrade: websocket",
                b"Sec-WebSocket-Version: 13",
                b"Sec-WebSocket-Key: \xff",
            ],
            400,
        ),
        ("/status", [b"Host: a:b"], 403),
        ("/status", [b"Host: a:99999"], 403),
    ],
    ids=["long-name", "long-path", "zero-byte", "origin", "codec", "key", "port", "large-port"],
)
@asynchronous
async def test_nonsense_is_refused_clearly(viewer: Path, target: str, headers: list[bytes], status: int) -> None:
    async with serve(options(viewer)) as gateway:
        sent = [header % {b"port": gateway.port} if b"%" in header else header for header in headers]
        answered, body = await ask(gateway.port, target, *sent)
        assert answered == status
        assert body


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        ([b"Content-Type: text/plain; charset=x"], json.dumps({"token": TOKEN}).encode(), 204),
        ([], b"[" * (MAX_REQUEST_BYTES // 2), 400),
        ([], b'{"token": ' + b"[" * (MAX_REQUEST_BYTES // 2), 400),
        ([], b'{"token": "\\ud800"}', 403),
        ([], b'{"code": "\\ud800"}', 403),
        ([b"Host: a:b"], json.dumps({"token": TOKEN}).encode(), 403),
    ],
    ids=["charset", "deep", "deep-token", "token", "code", "port"],
)
@asynchronous
async def test_nonsense_in_place_of_a_token_is_refused_clearly(
    viewer: Path, caplog: pytest.LogCaptureFixture, headers: list[bytes], body: bytes, status: int
) -> None:
    async with serve(options(viewer)) as gateway:
        own = b"Origin: http://127.0.0.1:%d" % gateway.port
        assert (await ask(gateway.port, "/enter", own, *headers, method="POST", body=body))[0] == status
    assert "Traceback" not in caplog.text


@asynchronous
async def test_refusals_are_logged_without_tokens_and_at_a_bounded_rate(
    viewer: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with serve(options(viewer)) as gateway:
        for _ in range(int(2 * LINES_PER_S)):
            assert (await ask(gateway.port, "/status?token=a-secret-that-is-wrong"))[0] == 403
            assert (await ask(gateway.port, "/status?token=a-secret-that-is-\x7f"))[0] in (400, 403)
    lines = journal(caplog)
    assert lines[0]["event"] == "refused"
    assert lines[0]["what"] == "GET /status"
    assert lines[0]["who"].startswith("127.0.0.1:")
    assert lines[0]["reason"].startswith("the token is missing or wrong")
    assert lines[1]["what"] in ("request", "GET /status")
    assert len(lines) < 4 * LINES_PER_S
    assert "a-secret" not in caplog.text


# --- what is refused at the start ------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--token-file", "--operator-token-file"])
@pytest.mark.parametrize("token", ["", "t", (MIN_TOKEN_CHARACTERS - 1) * "s"])
def test_short_token_is_refused_at_the_start(viewer: Path, tmp_path: Path, option: str, token: str) -> None:
    file = tmp_path / "token"
    file.touch(mode=0o600)
    file.write_text(token)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    given = options_from(parser.parse_args(["--viewer", str(viewer), f"{option}={file}"]), "127.0.0.1:1")
    with pytest.raises(ValueError, match=f"^{option} has {len(token)} characters.* for a random one$") as refusal:
        Gateway(given)
    assert len(token) < 2 or token not in str(refusal.value)


@asynchronous
async def test_random_tokens_are_taken_as_before(viewer: Path) -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    gateway = Gateway(options_from(parser.parse_args(["--viewer", str(viewer)]), "127.0.0.1:1"))
    await gateway.stop()
    assert len(gateway.options.token) == len(gateway.options.operator_token) == 32
    assert OPERATOR_TOKEN not in gateway.url


def test_more_browsers_than_there_are_descriptors_are_refused_at_the_start(viewer: Path) -> None:
    with pytest.raises(ValueError, match=r"max_browsers is 1000000: so many need .* raise the limit with `ulimit -n`"):
        Gateway(options(viewer, max_browsers=10**6))
    for browsers in (1, 16, 80):
        assert browsers + SPARE_CONNECTIONS <= connection_limit(browsers, 1024) < 1024 / 2
    assert connection_limit(16, resource.RLIM_INFINITY) == connections.MAX_CONNECTIONS
    assert connection_limit(16, 1024, tls=True) < connection_limit(16, 1024)
