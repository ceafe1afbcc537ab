"""Whom the gateway lets in, and what it says to the others."""

from __future__ import annotations

import argparse
import asyncio
import platform
from pathlib import Path

import aiohttp
import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import TOKEN, browse, options, origin
from yarl import URL

from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.options import add_arguments


@asynchronous
async def test_page_is_served_with_headers_that_keep_the_token_here(viewer: Path) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        async with session.get(gateway.url) as reply:
            assert reply.status == 200
            assert "viewer" in await reply.text()
            assert reply.headers["Referrer-Policy"] == "no-referrer"
            policy = reply.headers["Content-Security-Policy"]
            assert "default-src 'self'" in policy
            # Without it no browser decodes the codec meshopt; unsafe-eval would allow more.
            assert "script-src 'self' 'wasm-unsafe-eval';" in policy
        async with session.get(f"{origin(gateway)}/assets/main.js") as reply:
            assert reply.status == 200
        (viewer.parent / "secret").write_text("not the viewer's")
        for path in ("../../secret", "%2e%2e/%2e%2e/secret", "..%2f..%2fsecret", "%2e%2e%2findex.html"):
            # Encoded: else the client itself goes up before it asks.
            async with session.get(URL(f"{origin(gateway)}/assets/{path}", encoded=True)) as reply:
                assert reply.status in (403, 404)


@pytest.mark.parametrize("token", ["", "a-token-of-a-tes", "a-token-of-a-test2", "ä-token-of-a-test"])
@asynchronous
async def test_wrong_token_is_refused(viewer: Path, token: str) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await session.ws_connect(f"{origin(gateway)}/stream", params={"token": token}, origin=origin(gateway))
        async with session.get(f"{origin(gateway)}/status", params={"token": token}) as reply:
            assert reply.status == 403
            assert "use the address that was printed" in await reply.text()
            assert reply.headers["Referrer-Policy"] == "no-referrer"
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


@asynchronous
async def test_own_name_is_known_however_it_is_written(viewer: Path) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(platform, "node", lambda: "Trainer")
        own = Gateway(options(viewer, host="Viewer.Example"))
    for host in ("trainer:8000", "viewer.example:8000"):
        assert own._admission._is_own(f"http://{host}", host)
    assert not own._admission._is_own("http://other.example:8000", "other.example:8000")
    await own.stop()


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

        async def ask(token: str = TOKEN, page: str | None = origin(gateway)) -> tuple[int, str]:
            async with (
                aiohttp.ClientSession(headers={} if page is None else {"Origin": page}) as session,
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
        for nothing in (None, ""):
            assert await ask(page=nothing) == (
                403,
                f"the Origin header is missing; send that of this gateway's page, {origin(gateway)}, or one given with "
                "--origin\n",
            )
        async with browse(gateway):
            assert await ask() == (503, "1 browsers are connected (--max-browsers)\n")


@pytest.mark.parametrize(
    ("named", "sent"),
    [
        ("http://viewer.example:8000", "http://viewer.example:8000"),
        ("http://viewer.example:8000/", "http://viewer.example:8000"),  # as copied from the address bar
        ("http://viewer.example:8000", "http://viewer.example:8000/"),  # from a program that copied it as well
        ("HTTP://Viewer.Example", "http://viewer.example"),
        ("https://viewer.example:443/", "https://viewer.example"),
        ("http://[FD00::7]:8000/", "http://[fd00::7]:8000"),
        ("null", "null"),
    ],
)
@asynchronous
async def test_named_origin_is_let_in(viewer: Path, named: str, sent: str) -> None:
    async with (
        serve(options(viewer, origins=(named,))) as gateway,
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{origin(gateway)}/stream?token={TOKEN}", origin=sent) as socket,
    ):
        assert "no daemon" in (await socket.receive_json())["problem"]


@pytest.mark.parametrize(
    "wrong",
    [
        "",
        "viewer.example:8000",
        "//viewer.example",
        "http://",
        "http://viewer.example/page",
        "http://viewer.example?token=1",
        "http://user@viewer.example",
        "http://viewer.example:port",
        "http://[viewer",
        "http://wörter.example",
    ],
)
def test_origin_that_could_never_match_is_refused_at_the_start(
    viewer: Path, wrong: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ValueError, match="not scheme://host"):
        Gateway(options(viewer, origins=(wrong,)))
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    with pytest.raises(SystemExit):
        parser.parse_args([f"--origin={wrong}"])
    said = f"argument --origin: origin {wrong!r} is not scheme://host[:port], such as http://viewer.example:8000\n"
    assert capsys.readouterr().err.endswith(said)


@asynchronous
async def test_browsers_beyond_the_limit_are_refused_until_one_leaves(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, max_browsers=1)) as gateway:
        async with browse(gateway):
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                async with browse(gateway):
                    pass
        while gateway.browser_count > 0:
            await asyncio.sleep(0)
        async with browse(gateway):
            assert gateway.browser_count == 1
