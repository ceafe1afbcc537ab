"""Viewers that send too much or wrong frames: they are closed with a reason, and the others do not notice."""

from __future__ import annotations

import asyncio
import json
import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from asynchronous import asynchronous
from daemon_parts import make_viewer
from fake_daemon import fake_daemon
from gateway_attacks import RawBrowser, frame, journal, raw_browser, text
from gateway_parts import browse, load, options, publish

from tensormass_gateway import connections
from tensormass_gateway.budget import Budget
from tensormass_gateway.connections import MOST_FRAMES, TOO_MANY_FRAMES, UNMASKED, FrameGate
from tensormass_gateway.gateway import serve
from tensormass_gateway.outbox import Stream

FLOOD = 1250
"""Messages that the attacker sends at once: so many a second left no frame for others."""

FEW = 100
"""Fewer than a viewer may send at once, but too many requests."""


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    return make_viewer(tmp_path / "dist")


@pytest.fixture(autouse=True)
def nothing_grows_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Budgets do not grow while a test runs, however slow the machine is."""
    monkeypatch.setattr(connections, "FRAMES_PER_S", 1e-6)


async def flood(attacker: RawBrowser, message: bytes, count: int) -> tuple[int | None, str]:
    attacker.writer.write(count * message)
    return await attacker.closed()


@pytest.mark.parametrize(
    ("message", "count", "reason"),
    [
        (text(type="watch", scene="liver"), FLOOD, TOO_MANY_FRAMES),
        (text(type="watch", scene="liver"), FEW, "more requests 'watch'"),
        (text(type="watch", scene="nothing"), FEW, "more requests 'watch'"),
        (text(type="frames", codec="q16"), FLOOD, TOO_MANY_FRAMES),
        (text(type="frames", codec="q16"), FEW, "more requests 'frames'"),
        (text(type="field", name="pressure"), FEW, "more requests 'field'"),
        (text(type="control", id=1, action="pause", scene="liver"), FEW, "more requests 'control'"),
        (text(type="clock", client_time_ms=1), FLOOD, TOO_MANY_FRAMES),
        (frame(b"", opcode=9), FLOOD, TOO_MANY_FRAMES),
        (frame(b"{", fin=False) + frame(b"", opcode=0, fin=False) * 5, FLOOD, TOO_MANY_FRAMES),
    ],
    ids=["watch", "few-watch", "nothing", "frames", "few-frames", "field", "control", "clock", "ping", "fragments"],
)
@asynchronous
async def test_flood_ends_the_viewer_and_the_others_get_their_frames(
    viewer: Path, message: bytes, count: int, reason: str
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as honest, raw_browser(gateway.port) as attacker:
            await honest.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            attack = asyncio.create_task(flood(attacker, message, count))
            sequence = 0
            while not attack.done() or sequence < 10:
                sequence += 1
                sent = await publish(daemon, topology, sequence)
                assert await honest.take(Stream.FRAME) == sent
            code, why = await attack
            assert code == 1008
            assert reason in why
            assert "second" in why


@asynchronous
async def test_viewer_of_a_fast_scene_is_not_closed(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            for sequence in range(1, int(2 * MOST_FRAMES)):
                sent = await publish(daemon, topology, sequence)
                assert await page.take(Stream.FRAME) == sent


@pytest.mark.parametrize("opcode", [1, 8, 9, 10])
@asynchronous
async def test_unmasked_frame_ends_the_viewer(viewer: Path, caplog: pytest.LogCaptureFixture, opcode: int) -> None:
    async with serve(options(viewer)) as gateway, raw_browser(gateway.port) as attacker:
        attacker.writer.write(text(type="watch", scene="liver") + frame(b"", opcode=opcode, masked=False))
        assert await attacker.closed() == (1008, UNMASKED)
        closed = [line for line in journal(caplog) if line["event"] == "closed"]
        assert [line["reason"] for line in closed] == [UNMASKED]


@pytest.mark.parametrize("seed", range(20))
def test_gate_finds_each_frame_wherever_the_bytes_are_cut(seed: int) -> None:
    chance = random.Random(seed)
    sizes = [chance.choice([0, 1, 125, 126, 127, 4000, 65535, 65536, 70000]) for _ in range(chance.randint(1, 12))]
    data = b"".join(frame(chance.randbytes(size), fin=chance.random() < 0.5) for size in sizes)
    budget = Budget(1e-9, len(sizes) + 1, clock=lambda: 0.0)
    refused: list[str] = []
    passed = bytearray()

    class Reader:
        def feed_data(self, data: bytes) -> tuple[bool, bytes]:
            passed.extend(data)
            return False, b""

        def feed_eof(self) -> None:
            raise AssertionError("nothing ends here")

    gate = FrameGate(Reader(), budget, refused.append)
    at = 0
    while at < len(data):
        size = chance.choice([1, 2, 3, 9, 4096, 100_000])
        gate.feed_data(data[at : at + size])
        at += size
    assert (bytes(passed), refused) == (data, [])
    # One unit is left, for the frame whose head comes in two parts.
    last = frame(b"", masked=False)
    gate.feed_data(frame(b"x"))
    gate.feed_data(last[:1])
    assert refused == []
    gate.feed_data(last[1:])
    assert refused == [UNMASKED]
    passed.clear()
    gate.feed_data(frame(b"later"))
    assert not passed


@asynchronous
async def test_refused_calls_and_closed_viewers_leave_a_line_each(
    viewer: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        daemon.refusal = "the scene is busy"
        async with browse(gateway, "liver") as operator:
            await operator.command("pause", "liver")
            await operator.send(type="nonsense")
            await operator.closed()
        lines = journal(caplog)
    refused, closed = lines
    assert refused["who"].startswith("operator 127.0.0.1:")
    del refused["time"], refused["who"]
    assert refused == {
        "level": "warning",
        "event": "refused",
        "what": "control pause",
        "scene": "liver",
        "reason": "the scene is busy",
    }
    assert (closed["event"], closed["scene"]) == ("closed", "liver")
    assert closed["reason"] == "a message's type or fields are unknown"
    assert json.dumps(lines).isascii()
