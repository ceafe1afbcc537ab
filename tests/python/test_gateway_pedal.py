"""Poses with power, from a page through the gateway to the daemon."""

from __future__ import annotations

from pathlib import Path

import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import browse, load, options

from tensormass_gateway.daemon import PEDAL_S
from tensormass_gateway.gateway import serve
from tensormass_gateway.outbox import Stream


@asynchronous
async def test_a_pose_with_power_ends_when_the_page_is_gone(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            for level in (0.5, 0):
                await page.send(type="pose", tool="probe", position_m=[0, 0, -1], level=level)
            (_, burning), (_, released) = [await daemon.next_pose(), await daemon.next_pose()]
            assert (burning.level, burning.valid_for_s) == (0.5, PEDAL_S)
            assert released.level == 0
            assert not released.HasField("valid_for_s")


@pytest.mark.parametrize("level", ["1.5", "-0.1", "NaN", '"1"', "null", "true"])
@asynchronous
async def test_refuses_a_level_out_of_range(viewer: Path, level: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await page.socket.send_str(f'{{"type":"pose","tool":"probe","position_m":[0,0,0],"level":{level}}}')
            closed, why = await page.closed()
            assert closed == 1008
            assert "level" in why
