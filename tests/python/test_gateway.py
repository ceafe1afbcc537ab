"""The gateway between a daemon that says what it is told to and browsers that are sockets of the test."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web
from asynchronous import DEADLINE_S, asynchronous
from fake_daemon import Endpoints, fake_daemon, frame_of, triangle_topology
from gateway_parts import browse, load, options, origin, publish

from tensormass.v1 import control_pb2, stream_pb2
from tensormass_gateway.feed import BUS_STREAMS
from tensormass_gateway.gateway import Gateway, serve
from tensormass_gateway.options import GatewayOptions, add_arguments, options_from
from tensormass_gateway.outbox import Stream

# --- what is forwarded -----------------------------------------------------------------------------------------------


@asynchronous
async def test_bytes_of_the_bus_reach_the_browser_unchanged(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == topology
            await daemon.wait_subscribed("liver", "frame")
            await daemon.wait_subscribed("liver", "status")
            sent = await publish(daemon, topology, 1)
            assert await page.take(Stream.FRAME) == sent
            status = stream_pb2.SceneStatus(scene="liver", step=5).SerializeToString()
            await daemon.publish("liver", "status", status)
            assert await page.take(Stream.STATUS) == status


@asynchronous
async def test_next_frame_leaves_only_after_the_acknowledgement_and_is_the_newest(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as slow, browse(gateway, "liver") as quick:
            for page in (slow, quick):
                await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            first = await publish(daemon, topology, 1)
            assert await slow.binary() == ("frame", first)
            assert await quick.take(Stream.FRAME) == first
            for sequence in range(2, 11):
                newest = await publish(daemon, topology, sequence)
                # The slow browser does not delay the quick one.
                assert await quick.take(Stream.FRAME) == newest
            assert await slow.nothing_pending()
            await slow.send(type="ack", stream="frame")
            assert await slow.binary() == ("frame", newest)
            await slow.replaced(8)


@asynchronous
async def test_late_browser_gets_the_newest_messages_at_once(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as first:
            await first.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            sent = await publish(daemon, topology, 1)
            await first.take(Stream.FRAME)
            async with browse(gateway, "liver") as second:
                await second.take(Stream.TOPOLOGY)
                assert await second.take(Stream.FRAME) == sent


@asynchronous
async def test_paused_scene_is_shown(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        daemon.frames["liver"] = frame_of(load(daemon), 3)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            assert stream_pb2.Frame.FromString(await page.take(Stream.FRAME)) == daemon.frames["liver"]


@asynchronous
async def test_frame_that_overtakes_its_topology_waits_for_it(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            cut = load(daemon, version=2, vertex_count=5)
            sent = await publish(daemon, cut, 1)  # and nothing on the topology stream
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == cut
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_sequence_that_falls_back_makes_the_topology_asked_for_anew(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        before = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, before, 100)
            await page.take(Stream.FRAME)
            after = load(daemon, vertex_count=6)
            sent = await publish(daemon, after, 1)
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == after
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_name_of_a_scene_may_have_64_characters(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon, 64 * "a")
        async with browse(gateway, topology.scene) as page:
            assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == topology


@asynchronous
async def test_clock_is_answered_in_milliseconds_of_the_epoch(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        before = time.time_ns() / 1e6
        await page.send(type="clock", client_time_ms=1.5)
        reply = await page.text(lambda message: message["type"] == "clock")
        assert before <= reply["gateway_time_ms"] <= time.time_ns() / 1e6
        assert (reply["client_time_ms"], reply["replaced"]) == (1.5, 0)


@asynchronous
async def test_browsers_are_told_when_scenes_are_loaded_and_unloaded(viewer: Path) -> None:
    async with (
        fake_daemon() as daemon,
        serve(options(viewer, daemon.control)) as gateway,
        browse(gateway) as first,
        browse(gateway) as second,
    ):
        load(daemon)
        for page in (first, second):
            told = await page.text(lambda message: message["type"] == "daemon" and bool(message["scenes"]))
            assert told["scenes"] == ["liver"]
        del daemon.topologies["liver"]
        for page in (first, second):
            await page.text(lambda message: message["type"] == "daemon" and not message["scenes"])


@asynchronous
async def test_late_browser_is_not_shown_an_unloaded_scene(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as first:
            await first.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            del daemon.topologies["liver"]
            await first.text(lambda message: message["type"] == "daemon" and not message["scenes"])
            await daemon.wait_subscribed("liver", "frame", count=0)
            async with browse(gateway, "liver") as second:
                assert await second.nothing_pending()
                again = load(daemon, vertex_count=4)
                for page in (first, second):
                    assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == again


@asynchronous
async def test_streams_that_nobody_watches_are_not_received(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        load(daemon, "kidney")
        async with browse(gateway, "liver") as page:
            await daemon.wait_subscribed("liver", "frame")
            await page.send(type="watch", scene="kidney")
            await daemon.wait_subscribed("kidney", "frame")
            await daemon.wait_subscribed("liver", "frame", count=0)
        await daemon.wait_subscribed("kidney", "frame", count=0)


# --- faults ----------------------------------------------------------------------------------------------------------


@asynchronous
async def test_daemon_without_zeromq_is_reported(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        daemon.publishes = False
        told = await page.text(lambda message: message["type"] == "daemon" and bool(message["problem"]))
        assert "--zeromq-publish" in told["problem"]


@pytest.mark.parametrize("same_ports", [True, False])
@asynchronous
async def test_daemon_that_comes_back_is_found(viewer: Path, same_ports: bool) -> None:
    async with contextlib.AsyncExitStack() as stack:
        async with fake_daemon() as first:
            endpoints = first.endpoints
            gateway = await stack.enter_async_context(serve(options(viewer, first.control, allow_poses=True)))
            topology = load(first)
            page = await stack.enter_async_context(browse(gateway, "liver"))
            await page.take(Stream.TOPOLOGY)
            await first.wait_subscribed("liver", "frame")
            await publish(first, topology, 50)
            await page.take(Stream.FRAME)
            await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
            await first.next_pose()
        lost = await page.text(lambda message: message["type"] == "daemon" and bool(message["problem"]))
        assert f"no daemon answers on 127.0.0.1:{endpoints.control}" in lost["problem"]
        assert lost["scenes"] == []

        again = endpoints if same_ports else Endpoints(control=endpoints.control)
        second = await stack.enter_async_context(fake_daemon(again))
        topology = load(second, vertex_count=9)
        told = await page.text(lambda message: message["type"] == "daemon" and bool(message["scenes"]))
        assert told["problem"] == ""
        assert stream_pb2.Topology.FromString(await page.take(Stream.TOPOLOGY)) == topology
        await second.wait_subscribed("liver", "frame")
        sent = await publish(second, topology, 1)
        assert await page.take(Stream.FRAME) == sent
        await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
        await second.next_pose()


@asynchronous
async def test_daemon_that_takes_poses_elsewhere_is_another(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            daemon.endpoints.pose = 1
            await page.take(Stream.TOPOLOGY)


@asynchronous
async def test_daemon_that_was_replaced_between_two_polls_is_noticed(viewer: Path) -> None:
    async with fake_daemon(server="before") as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            daemon.server = "after"
            await daemon.wait_subscribed("liver", "frame")
            sent = await publish(daemon, topology, 1)
            await page.take(Stream.TOPOLOGY)
            assert await page.take(Stream.FRAME) == sent


@asynchronous
async def test_garbage_on_the_bus_is_counted_and_survived(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            for count, stream in enumerate(BUS_STREAMS, start=1):
                await daemon.wait_subscribed("liver", stream)
                await daemon.publish("liver", stream, b"\xff\xff\xff")
                while gateway.stats()["malformed_messages"] < count:
                    await asyncio.sleep(0)
            sent = await publish(daemon, topology, 1)
            assert await page.take(Stream.FRAME) == sent


@pytest.mark.parametrize(
    ("message", "code", "reason"),
    [
        ("no JSON", 1008, "not JSON"),
        (f'{{"type":{2000 * "["}{2000 * "]"}}}', 1008, "nested too deep"),
        ("[1]", 1008, "not a JSON object"),
        ('{"type":"clock","client_time_ms":NaN}', 1008, "client_time_ms is not a finite number"),
        ('{"type":"clock","client_time_ms":-Infinity}', 1008, "client_time_ms is not a finite number"),
        ('{"type":"clock","client_time_ms":true}', 1008, "client_time_ms is not a finite number"),
        (f'{{"type":"clock","client_time_ms":1{400 * "0"}}}', 1008, "client_time_ms is not a finite number"),
        ('{"type":"ack","stream":"frame"}', 1008, "none is on its way"),
        ('{"type":"ack","stream":"pose"}', 1008, "not a stream"),
        ('{"type":"ack","stream":["frame"]}', 1008, "unknown"),
        ('{"type":"watch","scene":"../x"}', 1008, "64 characters"),
        ('{"type":"watch","scene":""}', 1008, "64 characters"),
        (f'{{"type":"watch","scene":"{65 * "a"}"}}', 1008, "64 characters"),
        ('{"type":"watch","scene":"a/b#"}', 1008, "64 characters"),
        ('{"type":"pose","tool":"probe","position_m":[0,0,0]}', 1008, "takes no poses"),
        ('{"type":"sudo"}', 1008, "unknown"),
        (" " * 5000, 1009, ""),
        (b"binary", 1008, "text messages only"),
    ],
)
@asynchronous
async def test_browser_that_breaks_the_protocol_is_closed(
    viewer: Path, message: str | bytes, code: int, reason: str
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        async with browse(gateway) as page:
            if isinstance(message, bytes):
                await page.socket.send_bytes(message)
            else:
                await page.socket.send_str(message)
            closed, why = await page.closed()
            assert closed == code
            assert reason in why
        while gateway.browser_count:
            await asyncio.sleep(0)
        assert gateway.stats()["closed_for_errors"] == 1


@asynchronous
async def test_browser_that_answers_no_ping_is_let_go(viewer: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tensormass_gateway.gateway.HEARTBEAT_S", 1.0)
    async with (
        fake_daemon() as daemon,
        serve(options(viewer, daemon.control)) as gateway,
        browse(gateway) as page,
        aiohttp.ClientSession() as session,
        session.ws_connect(gateway.url.replace("/?", "/stream?"), origin=origin(gateway), autoping=False) as silent,
    ):
        answering = asyncio.ensure_future(page.socket.receive())
        types = [aiohttp.WSMsgType.TEXT]
        while types[-1] in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.PING):
            types.append((await silent.receive()).type)
        assert aiohttp.WSMsgType.PING in types
        while gateway.browser_count == 2:
            await asyncio.sleep(0)
        assert not answering.done()
        await page.send(type="clock", client_time_ms=1)
        assert json.loads((await answering).data)["type"] == "clock"
        assert gateway.stats()["closed_for_errors"] == 1  # the silent one


@asynchronous
async def test_browser_that_disconnects_during_an_answer_is_not_a_failure(
    viewer: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def send_json(socket: web.WebSocketResponse, message: dict[str, object]) -> None:
        if message["type"] == "clock":
            raise aiohttp.ClientConnectionResetError("Cannot write to closing transport")
        await socket.send_str(json.dumps(message))

    monkeypatch.setattr(web.WebSocketResponse, "send_json", send_json)
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        await page.send(type="clock", client_time_ms=1)
        while gateway.browser_count:
            await asyncio.sleep(0)
        await page.closed()
        assert gateway.stats()["closed_for_errors"] == 0
    assert [record.message for record in caplog.records if record.name == "aiohttp.server"] == []


@asynchronous
async def test_browser_is_told_that_the_gateway_stops(viewer: Path) -> None:
    async with fake_daemon() as daemon, contextlib.AsyncExitStack() as stack:
        gateway = await stack.enter_async_context(serve(options(viewer, daemon.control)))
        async with browse(gateway) as page:
            stopping = asyncio.ensure_future(stack.aclose())
            assert await page.closed() == (1001, "the gateway stops")
            await stopping


# --- poses -----------------------------------------------------------------------------------------------------------


@asynchronous
async def test_allowed_poses_reach_the_daemon(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            before_ns = time.time_ns()
            for x in (0.5, 0.25):
                await page.send(type="pose", tool="probe", position_m=[x, 0, -1])
            poses = [await daemon.next_pose(), await daemon.next_pose()]
            assert [key for key, _ in poses] == ["tensormass/fake/liver/tool/probe/pose"] * 2
            assert [pose.sequence for _, pose in poses] == [1, 2]
            assert [pose.position_m.x for _, pose in poses] == [0.5, 0.25]
            assert before_ns <= poses[0][1].client_time_ns <= poses[1][1].client_time_ns <= time.time_ns()
            assert poses[0][1].client_id == poses[1][1].client_id != 0
            assert not any(pose.HasField("orientation") for _, pose in poses)


@asynchronous
async def test_a_tool_that_a_client_claims_is_taken_over(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            frame = frame_of(topology, 7)
            frame.tools[0].claimed = True
            await daemon.publish("liver", "frame", frame.SerializeToString())
            await page.take(Stream.FRAME)
            await page.send(type="pose", tool="probe", position_m=[0.5, 0, -1])
            while not daemon.commands:
                await asyncio.sleep(0)
            taken = daemon.commands[0]
            assert isinstance(taken, control_pb2.MoveToolRequest)
            assert (taken.scene, taken.tool, taken.pose.position_m.x) == ("liver", "probe", 0.5)
            assert taken.pose.session != 0
            # Nobody claims it any more: the data plane is enough.
            await daemon.publish("liver", "frame", frame_of(topology, 8).SerializeToString())
            await page.take(Stream.FRAME)
            await page.send(type="pose", tool="probe", position_m=[0.25, 0, -1])
            _, pose = await daemon.next_pose()
            assert (pose.sequence, pose.session) == (2, taken.pose.session)


@pytest.mark.parametrize(
    ("orientation", "unit"),
    [
        ("[0.5, -0.5, 0.5, -0.5]", (0.5, -0.5, 0.5, -0.5)),
        ("[3, 0, 4, 0]", (0.6, 0.0, 0.8, 0.0)),
        ("[1e308, 0, 0, -1e308]", (0.5**0.5, 0.0, 0.0, -(0.5**0.5))),
        ("[0, 5e-324, 5e-324, 0]", (0.0, 0.5**0.5, 0.5**0.5, 0.0)),
    ],
)
@asynchronous
async def test_orientation_of_a_pose_reaches_the_daemon_at_unit_length(
    viewer: Path, orientation: str, unit: tuple[float, ...]
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await page.socket.send_str(
                f'{{"type":"pose","tool":"probe","position_m":[0,0,0],"orientation":{orientation}}}'
            )
            _, pose = await daemon.next_pose()
            sent = pose.orientation
            assert (sent.w, sent.x, sent.y, sent.z) == pytest.approx(unit)


@asynchronous
async def test_pose_that_crosses_a_new_topology_costs_nothing(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "topology")
            other = triangle_topology("liver", version=2)
            other.tools[0].name = "saw"
            await daemon.publish("liver", "topology", other.SerializeToString())
            assert await page.binary() == ("topology", other.SerializeToString())
            await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
            await page.send(type="ack", stream="topology")
            await page.send(type="pose", tool="saw", position_m=[0, 0, 0])
            key, _ = await daemon.next_pose()
            assert key == "tensormass/fake/liver/tool/saw/pose"


@pytest.mark.parametrize(
    ("tool", "position", "reason"),
    [
        ("saw", "[0,0,0]", "no tool 'saw'"),
        ("probe", "[NaN,0,0]", "position_m is not three finite numbers"),
        ("probe", "[1e9,0,0]", "position_m is not three finite numbers"),
        ("probe", "[0,-1e9,0]", "position_m is not three finite numbers"),
        ("probe", "[0,0,true]", "position_m is not three finite numbers"),
        ("probe", "[0,0]", "position_m is not three finite numbers"),
        ("probe", f"[1{400 * '0'},0,0]", "position_m is not three finite numbers"),
        ("probe", '[0,0,0],"orientation":[0,0,0,0]', "orientation is not four finite numbers"),
        ("probe", '[0,0,0],"orientation":[NaN,0,0,1]', "orientation is not four finite numbers"),
        ("probe", '[0,0,0],"orientation":[1,0,0]', "orientation is not four finite numbers"),
        ("probe", '[0,0,0],"orientation":["1",0,0,0]', "orientation is not four finite numbers"),
        ("probe", '[0,0,0],"orientation":1', "orientation is not four finite numbers"),
    ],
)
@asynchronous
async def test_wrong_pose_is_refused(viewer: Path, tool: str, position: str, reason: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await page.socket.send_str(f'{{"type":"pose","tool":"{tool}","position_m":{position}}}')
            code, why = await page.closed()
            assert code == 1008
            assert reason in why


# --- as a program ----------------------------------------------------------------------------------------------------


def test_viewer_that_is_not_built_is_reported(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="npm run build"):
        Gateway(options(tmp_path))


def test_arguments_stay_on_loopback_unless_told_otherwise() -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    args = parser.parse_args([])
    assert (args.host, args.port, args.allow_poses) == ("127.0.0.1", 0, False)


def test_arguments_reach_the_gateway(viewer: Path, tmp_path: Path) -> None:
    token, operator_token, metrics_token = (tmp_path / name for name in ("token", "operator-token", "metrics-token"))
    for file, content in ((token, "t"), (operator_token, "o\n"), (metrics_token, "m\n")):
        file.touch(mode=0o600)
        file.write_text(content)
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    given = [
        "--host",
        "::1",
        "--port",
        "8000",
        "--token-file",
        str(token),
        "--operator-token-file",
        str(operator_token),
        "--metrics-token-file",
        str(metrics_token),
        "--max-browsers",
        "3",
        "--allow-poses",
    ]
    given += ["--viewer", str(viewer), "--origin", "http://a:1", "--origin", "http://b"]
    wanted = GatewayOptions(
        control="c:1",
        host="::1",
        port=8000,
        token="t",
        operator_token="o",
        metrics_token="m",
        max_browsers=3,
        origins=("http://a:1", "http://b"),
        allow_poses=True,
        viewer=viewer,
    )
    assert options_from(parser.parse_args(given), "c:1") == wanted


def test_token_files_that_others_read_or_that_are_missing_are_refused(
    viewer: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    add_arguments(parser)
    open_file = tmp_path / "open"
    open_file.write_text("a-secret-of-everybody")
    open_file.chmod(0o644)
    binary = tmp_path / "binary"
    binary.touch(mode=0o600)
    binary.write_bytes(b"\xff\xfe")
    for file, said in (
        (open_file, f"{open_file}: every user of this machine can use it; chmod o-rwx {open_file}"),
        (Path("a-secret-in-place-of-its-file"), "the file: cannot be read: No such file or directory"),
        (binary, f"{binary}: cannot be read: not text"),
    ):
        with pytest.raises(SystemExit):
            parser.parse_args(["--operator-token-file", str(file)])
        told = capsys.readouterr().err
        assert f"--operator-token-file: {said}" in told
        assert "a-secret" not in told


@asynchronous
async def test_address_of_ipv6_has_brackets(viewer: Path) -> None:
    gateway = Gateway(options(viewer, host="::1", port=8000))
    assert gateway.look_url == "http://[::1]:8000/?token=a-token-of-a-test"
    await gateway.stop()


def test_program_prints_its_address_writes_the_ready_file_and_ends_on_sigterm(viewer: Path, tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    program = (
        "import argparse, sys; from tensormass_gateway import command, options; parser = argparse.ArgumentParser();"
        "parser.add_argument('--server'); options.add_arguments(parser); sys.exit(command.run(parser.parse_args()))"
    )
    arguments = ["--server", "127.0.0.1:1", "--viewer", str(viewer), "--gateway-ready-file", str(ready)]
    with subprocess.Popen([sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            said = json.loads(ready.read_text())
            address = f"http://127.0.0.1:{said['port']}/?"
            assert said["url"] == f"{address}token={said['operator_token']}"
            # Printed addresses may end in a log, so each is good for one browser.
            assert re.fullmatch(re.escape(f"viewer: {address}code=") + r"[\w-]{32}\n", line)
            assert process.stdout.readline().startswith(f"to look only: {address}code=")
            assert said["operator_token"] not in line
            assert len(said["token"]) >= 32
            assert len(said["operator_token"]) >= 32
            assert stat.S_IMODE(ready.stat().st_mode) == 0o600
            assert said["pid"] == process.pid
            os.kill(process.pid, signal.SIGTERM)
            assert process.wait(DEADLINE_S) == 0
        finally:
            process.kill()
