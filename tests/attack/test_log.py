"""Each refusal has a line of JSON in the daemon's log: who, what, scene, reason."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest
import zmq
from attack_parts import DEADLINE_S, block, wait_for, zenoh_session

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

ADDRESS = r"127\.0\.0\.1:\d+"
POSE = b"tensormass/local/block/tool/probe/pose"
A_POSE = stream_pb2.ToolPose(position_m=scene_pb2.Vector3(x=0.05, y=0.05, z=0.09))


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    options = ("--log-format", "json", "--max-scene-mib", "64")
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=True, options=options) as server:
        server.load(block())
        yield server


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


def lines(server: tm.Server) -> list[dict[str, object]]:
    assert server.log_file is not None
    return [json.loads(line) for line in server.log_file.read_text().splitlines()]


def expect(server: tm.Server, act: Callable[[], object], event: str, **fields: str) -> None:
    """Acts until the log has a line of the event whose fields match. A kind of refusal has one line a second."""
    begin = len(lines(server))
    next_act = 0.0

    def is_there() -> bool:
        nonlocal next_act
        if time.monotonic() >= next_act:
            act()
            next_act = time.monotonic() + 0.3
        for line in lines(server)[begin:]:
            if line["event"] == event and all(
                re.fullmatch(pattern, str(line[name]), re.DOTALL) for name, pattern in fields.items()
            ):
                assert {"time", "level", "who", "what", "scene", "reason", "suppressed"} <= set(line)
                assert line["level"] == "warning"
                return True
        return False

    wait_for(f"a line '{event}' with {fields}", is_there)


def test_calls_that_are_refused(server: tm.Server) -> None:
    def load() -> None:
        scene = block("large")
        grid = scene.body("tissue").mesh.grid
        grid.cells_x = grid.cells_y = grid.cells_z = 60
        with pytest.raises(tm.ResourceExhaustedError):
            server.load(scene)

    call = "tensormass.v1.Control/"
    expect(
        server,
        load,
        "refused",
        who=ADDRESS,
        what=call + "LoadScene(WithProgress)?",
        scene="large",
        reason=".*more than --max-scene-mib 64.*",
    )
    with grpc.insecure_channel(server.address) as channel:
        stub = control_pb2_grpc.ControlStub(channel)

        def step() -> None:
            with pytest.raises(grpc.RpcError):
                stub.StepScene(control_pb2.StepSceneRequest(scene="block", count=0), timeout=DEADLINE_S)

        expect(server, step, "refused", who=ADDRESS, what=call + "StepScene", scene="block", reason="count: 0 is not.*")
        before = len(lines(server))
        with pytest.raises(grpc.RpcError):  # a client that waits for its scene asks so all the time
            stub.GetStatus(control_pb2.GetStatusRequest(scene="absent"), timeout=DEADLINE_S)
        step()
        assert "absent" not in str(lines(server)[before:])


def test_poses_that_are_refused(server: tm.Server, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    with context.socket(zmq.PUSH) as hand:
        hand.connect(server.version().zeromq_pose_endpoint)
        what = "a pose over ZeroMQ"
        expect(
            server,
            lambda: hand.send(POSE + b"\0\xff\xff"),
            "refused",
            who=ADDRESS,
            what=what,
            scene="block",
            reason="not a ToolPose.*",
        )
        expect(
            server,
            lambda: hand.send_multipart([POSE, b"x"]),
            "refused",
            who=ADDRESS,
            what=what,
            scene="",
            reason="more than one frame",
        )
        unknown = POSE.replace(b"probe", b"unknown")
        expect(
            server,
            lambda: hand.send(unknown + b"\0" + A_POSE.SerializeToString()),
            "refused",
            who=ADDRESS,
            what="a pose",
            scene="block",
            reason=".*unknown.*",
        )
    with zenoh_session(server) as hand:
        expect(
            server,
            lambda: hand.put(POSE.decode(), b"\xff\xff"),
            "refused",
            who=ADDRESS,
            what="a pose over zenoh",
            scene="block",
            reason="not a ToolPose.*",
        )


def test_clients_that_are_disconnected(server: tm.Server, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    version = server.version()

    def subscribe_to_all() -> None:
        with context.socket(zmq.XSUB) as one:
            one.connect(version.zeromq_publish_endpoint)
            one.send(b"\1")
            one.get_monitor_socket(zmq.EVENT_DISCONNECTED).poll(round(1000 * DEADLINE_S))

    expect(
        server,
        subscribe_to_all,
        "refused",
        who=ADDRESS,
        what="a subscription over ZeroMQ",
        reason="not a key.*its client was disconnected",
    )

    def speak_http() -> None:
        host, port = server.address.split(":")
        with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as one:
            one.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with contextlib.suppress(ConnectionResetError):
                assert one.recv(1) == b""

    expect(
        server,
        speak_http,
        "closed",
        who=ADDRESS,
        what="a connection to the control endpoint",
        reason="a peer that does not speak HTTP/2",
    )

    def subscribe_to_a_long_key() -> None:
        with zenoh_session(server) as one:
            one.declare_subscriber(f"tensormass/local/{'x' * 1000}/frame", lambda _: None)

    expect(
        server,
        subscribe_to_a_long_key,
        "closed",
        who=ADDRESS,
        what="a connection over zenoh",
        reason="a key longer than kMaxZenohKeyBytes",
    )


def test_keys_without_a_right(tmp_path: Path, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    pytest.importorskip("cryptography", reason="needs the extra `keys`")
    from tensormass_tools.keys.folder import KeyFolder

    folder = KeyFolder(tmp_path / "keys")
    folder.init([], 30)
    viewer, operator = folder.add("alice", "viewer"), folder.add("bob", "operator")
    who = re.escape(viewer.id)
    options = ("--keys", str(folder.path), "--log-format", "json")
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=True, options=options, keys=operator) as server:
        server.load(block())
        with tm.connect(server.address, keys=viewer) as connection:

            def unload() -> None:
                with pytest.raises(tm.TensormassError, match="not for the role viewer"):
                    connection.scene("block").unload()

            expect(
                server,
                unload,
                "refused",
                who=who,
                what="tensormass.v1.Control/UnloadScene",
                scene="block",
                reason="UnloadScene is not for the role viewer.*",
            )
        with context.socket(zmq.PUSH) as hand:
            viewer.guard_socket(hand)
            hand.connect(server.version().zeromq_pose_endpoint)
            expect(
                server,
                lambda: hand.send(POSE + b"\0" + A_POSE.SerializeToString()),
                "refused",
                who=who,
                what="a pose over ZeroMQ",
                scene="block",
                reason="a pose for a tool that its client's key does not move",
            )


def test_a_scene_that_stops(server: tm.Server) -> None:
    scene = block("stops")
    scene.message.gravity_m_per_s2.z = -9.81
    del scene.message.tools[:]  # a hand stops no scene: its tool would give way
    solver = scene.message.solver
    solver.cg_max_iterations, solver.cg_tolerance, solver.floor_tolerance = (
        1,
        1e-9,
        1e-9,
    )  # single precision is not so good
    handle = server.load(scene, lockstep=True)
    with pytest.raises(tm.FailedPreconditionError, match="left its bounds"):
        handle.step()
    wait_for(
        "the line",
        lambda: any(
            line["event"] == "scene stopped" and line["scene"] == "stops" and line["reason"] for line in lines(server)
        ),
    )
