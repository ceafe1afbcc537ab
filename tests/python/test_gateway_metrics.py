"""What Prometheus scrapes of the gateway, and whom the gateway tells."""

from __future__ import annotations

from pathlib import Path

import aiohttp
import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import OPERATOR_TOKEN, TOKEN, browse, load, options, origin, publish

from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.outbox import Stream

METRICS_TOKEN = "a-scrapers-token"


async def scrape(
    gateway: Gateway, authorization: str | None = f"Bearer {METRICS_TOKEN}", query: str = ""
) -> tuple[int, str]:
    headers = {} if authorization is None else {"Authorization": authorization}
    async with (
        aiohttp.ClientSession(headers=headers) as session,
        session.get(f"{origin(gateway)}/metrics{query}") as reply,
    ):
        if reply.status == 200:
            assert reply.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
            assert reply.headers["Cache-Control"] == "no-store"
        return reply.status, await reply.text()


def samples(text: str) -> dict[str, float]:
    lines = (line for line in text.splitlines() if not line.startswith("#"))
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines)}


@asynchronous
async def test_the_daemons_metrics_come_first_and_the_gateways_own_after_them(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, metrics_token=METRICS_TOKEN)) as gateway:
        daemon.metrics = "# HELP x X.\n# TYPE x gauge\nx 3\n"
        status, text = await scrape(gateway)
        assert status == 200
        assert text.startswith(daemon.metrics)
        found = samples(text)
        assert found["tensormass_gateway_daemon_up"] == 1
        assert found["tensormass_gateway_browsers"] == 0
        assert found["tensormass_gateway_browsers_limit"] == 16


@asynchronous
async def test_without_a_daemon_there_are_the_gateways_own(viewer: Path) -> None:
    async with serve(options(viewer, metrics_token=METRICS_TOKEN)) as gateway:
        status, text = await scrape(gateway)
        assert status == 200
        assert samples(text)["tensormass_gateway_daemon_up"] == 0


@asynchronous
async def test_drops_are_counted_for_each_browser_and_places_are_used_again(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, metrics_token=METRICS_TOKEN)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as first:
            await daemon.wait_subscribed("liver", "frame")
            await first.take(Stream.TOPOLOGY)
            async with browse(gateway):
                found = samples((await scrape(gateway))[1])
                assert found["tensormass_gateway_browsers"] == 2
                assert found['tensormass_gateway_frames_replaced_total{browser="1"}'] == 0
            # The first frame is not acknowledged, so those after it replace each other.
            await publish(daemon, topology, 1)
            assert (await first.binary())[0] == Stream.FRAME
            sequence = 2
            while samples((await scrape(gateway))[1]).get('tensormass_gateway_frames_replaced_total{browser="0"}') == 0:
                for _ in range(2):
                    await publish(daemon, topology, sequence)
                    sequence += 1
                await first.send(type="ack", stream="frame")
                assert (await first.binary())[0] == Stream.FRAME
            async with browse(gateway):
                assert 'tensormass_gateway_frames_replaced_total{browser="1"}' in samples((await scrape(gateway))[1])


@pytest.mark.parametrize("token", [METRICS_TOKEN, TOKEN, OPERATOR_TOKEN])
@asynchronous
async def test_every_token_may_scrape(viewer: Path, token: str) -> None:
    async with serve(options(viewer, metrics_token=METRICS_TOKEN)) as gateway:
        assert (await scrape(gateway, f"Bearer {token}"))[0] == 200


@pytest.mark.parametrize(
    "authorization", [None, "", "Bearer", "Bearer ", "Bearer a-scrapers-toke", f"Basic {METRICS_TOKEN}", METRICS_TOKEN]
)
@asynchronous
async def test_others_may_not_and_are_told_what_to_send(viewer: Path, authorization: str | None) -> None:
    async with serve(options(viewer, metrics_token=METRICS_TOKEN)) as gateway:
        status, text = await scrape(gateway, authorization)
        assert status == 403
        assert "--metrics-token-file" in text
        assert METRICS_TOKEN not in text
        assert gateway.stats()["refused_connections"] == 1
        # An address ends in logs, so the scrapers' token counts in the header alone.
        assert (await scrape(gateway, authorization, f"?token={METRICS_TOKEN}"))[0] == 403


@asynchronous
async def test_the_scrapers_token_is_for_nothing_else(viewer: Path) -> None:
    async with (
        serve(options(viewer, metrics_token=METRICS_TOKEN)) as gateway,
        aiohttp.ClientSession(headers={"Authorization": f"Bearer {METRICS_TOKEN}"}) as session,
    ):
        async with session.get(f"{origin(gateway)}/status?token={METRICS_TOKEN}") as reply:
            assert reply.status == 403
        async with session.post(f"{origin(gateway)}/enter", json={"token": METRICS_TOKEN}) as reply:
            assert reply.status == 403
