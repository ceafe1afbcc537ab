"""The page over HTTPS, and its refusal where other machines could read it."""

from __future__ import annotations

import json
import ssl
import sys
from pathlib import Path

import aiohttp
import pytest

pytest.importorskip("cryptography", reason="needs the extra `keys`")

from asynchronous import asynchronous
from gateway_parts import OPERATOR_TOKEN, TOKEN, options, origin

from tensormass._shared.client_keys import ClientKeys
from tensormass_gateway import entry
from tensormass_gateway.command import tell_next_addresses
from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.page_tls import is_loopback
from tensormass_tools.keys.folder import KeyFolder


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    made = KeyFolder(tmp_path / "keys")
    made.init([], 30)
    return made


@pytest.fixture
def page(folder: KeyFolder) -> ClientKeys:
    return folder.add("gateway", "operator", pages=["viewer.example"])


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "viewer.example"])
@asynchronous
async def test_a_page_that_others_reach_needs_a_certificate(viewer: Path, host: str) -> None:
    with pytest.raises(ValueError, match=f"--host {host}: .*\n  tensormass keys add gateway .*--page HOST"):
        await Gateway(options(viewer, host=host)).start()


def test_loopback_is_known() -> None:
    assert all(is_loopback(host) for host in ("127.0.0.1", "127.1.2.3", "::1", "localhost"))
    assert not any(is_loopback(host) for host in ("127.0.0.1.example", "10.0.0.1", "", "*"))


@asynchronous
async def test_the_page_over_https(viewer: Path, folder: KeyFolder, page: ClientKeys) -> None:
    trust = ssl.create_default_context(cafile=str(folder.path / "page-authority.pem"))
    async with serve(options(viewer, page=page)) as gateway, aiohttp.ClientSession() as session:
        assert gateway.url.startswith("https://127.0.0.1:")
        async with session.get(gateway.look_url, ssl=trust) as answer:
            assert answer.status == 200
        origin = gateway.look_url.partition("/?")[0]
        async with session.ws_connect(f"{origin}/stream?token={TOKEN}", origin=origin, ssl=trust) as socket:
            assert (await socket.receive_json(timeout=20))["type"] == "daemon"
        with pytest.raises(aiohttp.ClientError):
            await session.get(gateway.look_url.replace("https:", "http:"))
        old = ssl.create_default_context(cafile=str(folder.path / "page-authority.pem"))
        old.maximum_version = ssl.TLSVersion.TLSv1_1
        with pytest.raises(aiohttp.ClientError):
            await session.get(gateway.look_url, ssl=old)


@asynchronous
async def test_the_page_s_key_is_left_nowhere(
    viewer: Path, page: ClientKeys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    async with serve(options(viewer, page=page)):
        assert not list(tmp_path.glob("tensormass-page-*"))


@asynchronous
async def test_a_code_lets_one_browser_in(viewer: Path) -> None:
    async with serve(options(viewer)) as gateway:
        told: list[str] = []
        gateway.on_code_used(lambda: told.append(gateway.once_url))
        first, page = gateway.once_url, origin(gateway)
        assert "?code=" in first
        code = first.partition("code=")[2]
        jar = aiohttp.CookieJar(unsafe=True)  # takes cookies of addresses
        async with aiohttp.ClientSession(cookie_jar=jar, headers={"Origin": page}) as browser:
            async with browser.post(f"{page}/enter", json={"code": code}) as answer:
                assert answer.status == 204
                cookie = answer.headers["Set-Cookie"]
            assert "HttpOnly" in cookie
            assert "SameSite=Strict" in cookie
            async with browser.ws_connect(f"{page}/stream", origin=page) as socket:
                assert (await socket.receive_json(timeout=20))["operator"]
        assert told == [gateway.once_url] != [first]
        async with aiohttp.ClientSession(headers={"Origin": page}) as another:
            async with another.post(f"{page}/enter", json={"code": code}) as answer:
                assert answer.status == 403
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await another.ws_connect(f"{page}/stream", origin=page)


@pytest.mark.parametrize("terminal", [False, True])
@asynchronous
async def test_the_next_code_is_for_a_terminal_alone(
    viewer: Path, monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    async with serve(options(viewer)) as gateway:
        told: list[str] = []
        tell_next_addresses(gateway, told.append)
        page = origin(gateway)
        async with aiohttp.ClientSession(headers={"Origin": page}) as browser:
            code = gateway.once_url.partition("code=")[2]
            async with browser.post(f"{page}/enter", json={"code": code}) as answer:
                assert answer.status == 204
        assert len(told) == terminal
        assert all(gateway.once_url in text and gateway.look_once_url in text for text in told)


@asynchronous
async def test_sessions_that_look_push_no_operator_out(viewer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry, "MAX_SESSIONS", 2)
    async with serve(options(viewer)) as gateway:
        page = origin(gateway)

        async def enter(token: str) -> dict[str, str]:
            async with (
                aiohttp.ClientSession(headers={"Origin": page}) as browser,
                browser.post(f"{page}/enter", json={"token": token}) as answer,
            ):
                return {name: cookie.value for name, cookie in answer.cookies.items()}

        async def status(cookies: dict[str, str]) -> int:
            async with aiohttp.ClientSession(cookies=cookies) as browser, browser.get(f"{page}/status") as answer:
                return answer.status

        operator = await enter(OPERATOR_TOKEN)
        lookers = [await enter(TOKEN) for _ in range(3)]
        assert await status(operator) == 200
        assert [await status(looker) for looker in lookers] == [403, 200, 200]


@asynchronous
async def test_a_token_becomes_a_cookie_of_its_role(viewer: Path) -> None:
    async with serve(options(viewer)) as gateway:
        page = origin(gateway)
        jar = aiohttp.CookieJar(unsafe=True)
        async with aiohttp.ClientSession(cookie_jar=jar, headers={"Origin": page}) as browser:
            async with browser.post(f"{page}/enter", json={"token": TOKEN}) as answer:
                assert answer.status == 204
            async with browser.ws_connect(f"{page}/stream", origin=page) as socket:
                assert not (await socket.receive_json(timeout=20))["operator"]
            # A wrong token is refused also in a browser that was let in.
            async with browser.get(f"{page}/status", params={"token": "another"}) as answer:
                assert answer.status == 403


@asynchronous
async def test_entering_is_for_the_gateway_s_own_page(viewer: Path) -> None:
    async with serve(options(viewer)) as gateway, aiohttp.ClientSession() as session:
        page = origin(gateway)

        async def enter(body: object, headers: dict[str, str]) -> int:
            async with session.post(f"{page}/enter", data=body, headers=headers) as answer:
                return answer.status

        right = json.dumps({"token": TOKEN})
        assert await enter(right, {}) == 403
        assert await enter(right, {"Origin": "http://evil.example"}) == 403
        assert (
            await enter(
                right, {"Origin": f"http://evil.example:{gateway.port}", "Host": f"evil.example:{gateway.port}"}
            )
            == 403
        )
        assert await enter(json.dumps({"token": "a-wrong-token-of-someone"}), {"Origin": page}) == 403
        assert await enter(json.dumps({"code": ""}), {"Origin": page}) == 403
        assert await enter("[1]", {"Origin": page}) == 400
        assert await enter(b"\xff", {"Origin": page}) == 400
        assert await enter(right, {"Origin": page}) == 204
