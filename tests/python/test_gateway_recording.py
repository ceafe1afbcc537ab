"""A recording that the gateway serves in place of a daemon."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import TOKEN, Page, browse, load, options
from recorded_parts import STEPS, TOPOLOGY, recorded_frame, write_recording

from tensormass.v1 import changes_pb2, event_pb2, stream_pb2
from tensormass_gateway.control import MAX_SPEED, MIN_SPEED
from tensormass_gateway.decoding import FrameDecoder
from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.outbox import Stream
from tensormass_tools.recording.index import RecordingIndex

LAST_S = 0.7


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "liver.mcap", touching=[7])


@contextlib.asynccontextmanager
async def playing(viewer: Path, path: Path, **change: object) -> AsyncIterator[Gateway]:
    async with serve(options(viewer, "127.0.0.1:1", **change), recording=RecordingIndex(path)) as gateway:
        yield gateway


async def frame_of_step(page: Page, step: int) -> stream_pb2.Frame:
    """Takes messages until a frame of `step` comes."""
    while True:
        name, payload = await page.binary()
        await page.send(type="ack", stream=name)
        if name == Stream.FRAME:
            frame = stream_pb2.Frame.FromString(payload)
            if frame.step == step:
                return frame


async def status_of_state(page: Page, state: int) -> stream_pb2.SceneStatus:
    while True:
        name, payload = await page.binary()
        await page.send(type="ack", stream=name)
        if name == Stream.STATUS:
            status = stream_pb2.SceneStatus.FromString(payload)
            if status.state == state:
                return status


def is_head(**wanted: Any) -> Any:  # noqa: ANN401
    return lambda message: message["type"] == "head" and wanted.items() <= message.items()


@asynchronous
async def test_a_file_whose_name_is_not_utf8_is_shown(viewer: Path, path: Path) -> None:
    path = path.rename(path.with_name(os.fsdecode(b"liver\xff.mcap")))
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        assert page.daemon["recording"]["file"] == r"liver\udcff.mcap"


@asynchronous
async def test_a_page_gets_the_scene_and_its_first_frame(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        assert page.daemon["scenes"] == ["liver"]
        assert (page.daemon["server"], page.daemon["backend"], page.daemon["device"]) == ("recording", "cpu", "test")
        recording = page.daemon["recording"]
        assert recording["duration_s"] == pytest.approx(LAST_S)
        assert (recording["file"], recording["frames"], recording["note"]) == ("liver.mcap", len(STEPS), "")
        assert [mark["kind"] for mark in recording["marks"]] == ["reset", "contact"]
        assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == TOPOLOGY
        status = stream_pb2.SceneStatus.FromString(await page.take(Stream.STATUS))
        assert (status.state, status.cg_iterations) == (stream_pb2.SceneStatus.STATE_PAUSED, 10)
        assert await page.take(Stream.FRAME) == recorded_frame(STEPS[0], 1).SerializeToString()


async def next_of(page: Page, *streams: str) -> list[str]:
    """Takes messages until each of `streams` has come. Returns the names of all."""
    names: list[str] = []
    while not set(streams) <= set(names):
        name, _ = await page.binary()
        names.append(name)
        slot = {"simplified_topology": "topology", "encoded_frame": "frame"}.get(name, name)
        await page.send(type="ack", stream=slot)
    return names


@asynchronous
async def test_a_page_gets_a_recording_in_less_detail_and_changes_it(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver", choice="detail=0.5") as page:
        assert "topology" not in await next_of(page, "simplified_topology", "encoded_frame")
        await page.send(type="frames", detail=1)
        assert "simplified_topology" not in await next_of(page, "topology", "frame")


@asynchronous
async def test_a_seek_shows_the_frame_before_the_time_with_its_tools(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        await frame_of_step(page, STEPS[0])
        assert (await page.command("seek", "liver", time_s=0.45))["error"] == ""
        shown = await frame_of_step(page, 20)
        recorded = recorded_frame(20, 7, force_n=0.5)
        assert (shown.tools, shown.positions) == (recorded.tools, recorded.positions)
        assert shown.sequence == 2, "counts what was sent: the frames between were not lost"
        await page.command("seek", "liver", time_s=0.0)
        assert (await frame_of_step(page, 10)).sequence == 3
        await page.command("seek", "liver", time_s=1e9)
        await page.text(is_head(time_s=pytest.approx(LAST_S), frame=len(STEPS) - 1))


@asynchronous
async def test_it_plays_to_its_end_and_tells_where_it_is(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        assert (await page.command("speed", "liver", speed=MAX_SPEED))["error"] == ""
        await page.command("resume", "liver")
        await status_of_state(page, stream_pb2.SceneStatus.STATE_RUNNING)
        await status_of_state(page, stream_pb2.SceneStatus.STATE_PAUSED)
        await frame_of_step(page, STEPS[-1])
        await page.text(is_head(time_s=pytest.approx(LAST_S), playing=False, speed=MAX_SPEED))


@asynchronous
async def test_a_pause_is_told_before_the_next_frame(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        await page.command("speed", "liver", speed=MIN_SPEED)
        await page.command("resume", "liver")
        await status_of_state(page, stream_pb2.SceneStatus.STATE_RUNNING)
        await page.command("pause", "liver")
        await status_of_state(page, stream_pb2.SceneStatus.STATE_PAUSED)


@asynchronous
async def test_steps_and_pauses_stand_still(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        await page.command("step", "liver", steps=2)
        await page.text(is_head(frame=2, playing=False))
        await page.command("step_back", "liver")
        await page.text(is_head(frame=1, time_s=pytest.approx(0.1)))
        await page.command("speed", "liver", speed=0.05)
        await page.command("resume", "liver")
        await page.text(is_head(playing=True))
        await page.command("pause", "liver")
        await page.text(is_head(playing=False))
        await page.command("reset", "liver")
        await page.text(is_head(frame=0, time_s=0.0))


@pytest.mark.parametrize("choice", ["codec=q16", "codec=delta&normals=true", "codec=float32&normals=true"])
@asynchronous
async def test_a_viewer_chooses_its_codec(viewer: Path, path: Path, choice: str) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver", choice=choice) as page:
        await page.take(Stream.TOPOLOGY)
        await page.take(Stream.STATUS)
        decoder = FrameDecoder()
        for at in (0, 1, 2):
            name, payload = await page.binary()
            while name == Stream.STATUS:
                await page.send(type="ack", stream="status")
                name, payload = await page.binary()
            decoded = decoder.decode(name, payload)
            exact = np.frombuffer(recorded_frame(STEPS[at], at + 1).positions, "<f4").reshape(-1, 3)
            assert (np.abs(decoded.positions - exact) <= decoded.error_m).all()
            await page.send(type="ack", stream="frame", keyframe=decoder.keyframe)
            await page.send(type="control", id=at, action="step", scene="liver")


@asynchronous
async def test_all_pages_share_the_head_and_the_last_one_pauses_it(viewer: Path, path: Path) -> None:
    async with playing(viewer, path) as gateway:
        async with browse(gateway, "liver") as first:
            await first.command("seek", "liver", time_s=0.3)
            # The answer comes before the frame is read. The first frame of the recording has step 10, too.
            while (await frame_of_step(first, 10)).sequence < 2:
                pass
            async with browse(gateway, "liver", token=TOKEN) as second:
                assert (await frame_of_step(second, 10)).positions == recorded_frame(10, 6).positions
                refusal = await second.command("seek", "liver", time_s=0.0)
                assert "only lets you look" in refusal["error"]
                await first.command("speed", "liver", speed=0.05)
                await first.command("resume", "liver")
                await second.text(is_head(playing=True))
            # One page is left, so it plays on.
            assert (await first.command("seek", "liver", time_s=0.1))["error"] == ""
            await first.text(is_head(playing=True, frame=1))
        while gateway.browser_count > 0:
            await asyncio.sleep(0)
        async with browse(gateway, "liver") as third:
            head = await third.text(lambda message: message["type"] == "head")
            assert head["playing"] is False


@pytest.mark.parametrize(
    ("action", "scene", "says"),
    [
        ("load", "demo", "a recording of 'liver' only"),
        ("unload", "liver", "neither loads nor adjusts"),
        ("adjust", "liver", "neither loads nor adjusts"),
        ("pause", "x", "'liver' only"),
    ],
)
@asynchronous
async def test_what_a_recording_cannot_do_is_refused(
    viewer: Path, path: Path, action: str, scene: str, says: str
) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        assert says in (await page.command(action, scene))["error"]


@asynchronous
async def test_a_recording_takes_no_poses_and_has_no_fields(viewer: Path, path: Path) -> None:
    async with playing(viewer, path, allow_poses=True) as gateway, browse(gateway, "liver") as page:
        await page.send(type="field", name="von_mises")
        await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
        assert await page.closed() == (1008, "a recording takes no poses")


@pytest.mark.parametrize(
    "fields",
    [{"time_s": -1}, {"time_s": "1"}, {"time_s": None}, {"speed": 0}, {"speed": 21}, {"speed": True}, {"place": 1}],
)
@asynchronous
async def test_malformed_commands_close_the_connection(viewer: Path, path: Path, fields: dict[str, object]) -> None:
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        await page.send(type="control", id=1, action="seek", scene="liver", **fields)
        code, _ = await page.closed()
        assert code == 1008


@asynchronous
async def test_a_running_scene_has_no_time_line(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            assert "recording" not in page.daemon
            for action in ("seek", "speed", "step_back"):
                assert "a running scene has no time line" in (await page.command(action, "liver"))["error"]
            assert daemon.commands == []


@asynchronous
async def test_the_page_hears_of_a_file_that_is_lost(viewer: Path, path: Path) -> None:
    def note(text: str) -> Any:  # noqa: ANN401
        return lambda message: message["type"] == "daemon" and text in message["recording"]["note"]

    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        await frame_of_step(page, STEPS[0])
        moved = path.rename(path.with_name("moved.mcap"))
        await page.command("seek", "liver", time_s=0.6)
        await page.text(note("liver.mcap: No such file"))
        moved.rename(path)
        await page.command("seek", "liver", time_s=1.0)
        assert (await page.text(lambda message: message["type"] == "daemon"))["recording"]["note"] == ""
        await frame_of_step(page, 50)


def test_the_command_serves_a_recording_without_a_daemon(viewer: Path, path: Path) -> None:
    command = [sys.executable, "-m", "tensormass", "view", str(path), "--viewer", str(viewer), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            said = json.loads(process.stdout.readline())
            assert said["recording"] == "liver.mcap"
            assert said["url"].startswith("http://127.0.0.1:")
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait() == 0


def burnt(revision: int) -> changes_pb2.SurfaceChanges:
    """The one triangle of the recording dies, and comes back burnt."""
    changes = changes_pb2.SurfaceChanges(topology_version=TOPOLOGY.version, revision=revision)
    changes.bodies.add(
        dead_triangles=np.array([0], "<u4").tobytes(),
        appended_triangles=np.array([2, 1, 0], "<u4").tobytes(),
        appended_kinds=b"\2",
    )
    return changes


def happened(*kinds: int) -> event_pb2.SceneEvents:
    message = event_pb2.SceneEvents(topology_version=TOPOLOGY.version)
    for sequence, kind in enumerate(kinds, start=1):
        # As the frame of the same number.
        message.events.add(sequence=sequence, kind=kind, server_time_ns=2000 + 3 * sequence, text="2 mm³ burnt")
    return message


Kind = event_pb2.SceneEvent


@asynchronous
async def test_the_surface_of_a_recording_goes_forth_and_back(viewer: Path, tmp_path: Path) -> None:
    reset = changes_pb2.SurfaceChanges(topology_version=TOPOLOGY.version, revision=5)
    path = write_recording(
        tmp_path / "burnt.mcap",
        [10, 20, 30, 40, 50, 60, 70],
        changing={
            3: [burnt(2), happened(Kind.KIND_ABLATED)],
            6: [reset, happened(Kind.KIND_ABLATED, Kind.KIND_RESET)],
        },
    )
    index = RecordingIndex(path)
    assert [index.changes(index.frame(at)) for at in (1, 2, 4, 5)] == [None, burnt(2), burnt(2), reset]
    assert [len((index.events(index.frame(at)) or happened()).events) for at in (1, 2, 4, 5)] == [0, 1, 1, 2]
    assert [(mark.kind, mark.text) for mark in index.marks] == [("ablated", "2 mm³ burnt.")]
    async with playing(viewer, path) as gateway, browse(gateway, "liver") as page:
        shown: dict[str, bytes] = {}

        async def step_to(step: int) -> None:
            while True:
                name, payload = await page.binary()
                await page.send(type="ack", stream=name)
                shown[name] = payload
                if name == Stream.FRAME and stream_pb2.Frame.FromString(payload).step == step:
                    return

        def revision() -> int:
            return changes_pb2.SurfaceChanges.FromString(shown[Stream.CHANGES]).revision

        await step_to(10)
        assert Stream.CHANGES not in shown
        assert Stream.EVENTS not in shown
        await page.command("seek", "liver", time_s=0.21)
        await step_to(30)
        assert changes_pb2.SurfaceChanges.FromString(shown[Stream.CHANGES]) == burnt(2)
        await page.command("seek", "liver", time_s=9.0)
        await step_to(70)
        assert revision() == 5
        assert len(event_pb2.SceneEvents.FromString(shown[Stream.EVENTS]).events) == 2
        await page.command("seek", "liver", time_s=0.31)
        await step_to(40)
        assert revision() == 2
        await page.command("seek", "liver", time_s=0.0)
        await step_to(10)
        assert revision() == 0
        assert not event_pb2.SceneEvents.FromString(shown[Stream.EVENTS]).events
