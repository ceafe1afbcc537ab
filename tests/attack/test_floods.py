"""Clients that send on and on: each is disconnected, with a key too, and others do not feel it."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest
import zenoh
import zmq
from attack_parts import DEADLINE_S, IN_AIR_M, MIB, attacked, block, cpu_time_of, memory_of, wait_for, zenoh_session

import tensormass as tm
from tensormass._src.streams import Transport
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

ALL = os.environ.get("TENSORMASS_ATTACK") == "all"
"""`make attack` sets it."""
POSE = stream_pb2.ToolPose(client_id=5, position_m=scene_pb2.Vector3(x=0.05, y=0.05, z=0.09)).SerializeToString()
#: The same with a field that the daemon does not know, of 3,900 bytes.
LONG_POSE = POSE + b"\x7a\xbc\x1e" + bytes(3900)
FLOOD = "a flood of poses"
#: limits::kMaxRelayCpuAtOnceS and kMaxRelayCpuShare.
RELAY_CPU_AT_ONCE_S, RELAY_CPU_SHARE = 10.0, 0.5
Send = Callable[[bytes, int], None]


def log_of(server: tm.Server) -> str:
    assert server.log_file is not None
    return server.log_file.read_text()


@contextlib.contextmanager
def zeromq_flooder(socket: zmq.Socket[bytes], endpoint: str, key: str) -> Iterator[Send]:
    """Sends, and connects again whenever it is disconnected, as ZeroMQ does."""
    socket.setsockopt(zmq.SNDTIMEO, 100)
    socket.connect(endpoint)

    def send(message: bytes, count: int) -> None:
        for _ in range(count):
            with contextlib.suppress(zmq.Again):
                socket.send(key.encode() + b"\0" + message)

    yield send


def sends(session: zenoh.Session, key: str) -> Send:
    def send(message: bytes, count: int) -> None:
        for _ in range(count):
            with contextlib.suppress(zenoh.ZError):
                session.put(key, message)

    return send


@pytest.mark.attack("a client floods poses, small ones or of 4 kB", "all were read, for as long as it sent them")
@pytest.mark.parametrize("pose", [POSE, LONG_POSE], ids=["short", "long"])
@pytest.mark.parametrize("transport", ["zeromq", "zenoh"])
def test_who_floods_poses_is_disconnected(
    transport: Transport, pose: bytes, record_property: Callable[[str, object], None]
) -> None:
    key = "tensormass/local/block/tool/probe/pose"
    with attacked("--log-format", "json", zenoh=True) as server, contextlib.ExitStack() as parts:
        scene = server.load(block())
        before = memory_of(server)
        if transport == "zeromq":
            context = parts.enter_context(zmq.Context())
            socket = parts.enter_context(context.socket(zmq.PUSH))
            socket.setsockopt(zmq.LINGER, 0)
            send = parts.enter_context(zeromq_flooder(socket, server.version().zeromq_pose_endpoint, key))
        else:
            send = sends(parts.enter_context(zenoh_session(server)), key)

        def is_cut() -> bool:
            send(pose, 1000)
            return FLOOD in log_of(server)

        wait_for("the end of its connection", is_cut)
        with scene.tool_stream("probe", transport, valid_for_s=3600.0) as hand:

            def answers() -> bool:
                hand.send(IN_AIR_M)
                return scene.feedback("probe").client_id == hand.client_id

            wait_for("an honest hand", answers)
        grown = memory_of(server) - before
        record_property("now", f"disconnected, +{grown / MIB:.0f} MiB")
        assert grown < 64 * MIB


class TestWithKeys:
    pytest.importorskip("cryptography", reason="needs the extra `keys`")

    @pytest.mark.attack("a hand with a key floods poses", "all were read, for as long as it sent them")
    @pytest.mark.parametrize("transport", ["zeromq", "zenoh"])
    def test_a_hand_that_floods_is_disconnected(self, transport: Transport, tmp_path: Path) -> None:
        from keyed_parts import guarded

        key = "tensormass/local/a/tool/probe/pose"
        with guarded(tmp_path) as daemon, contextlib.ExitStack() as parts:
            if transport == "zeromq":
                socket = parts.enter_context(daemon.socket(zmq.PUSH, daemon.keys["hand"]))
                send = parts.enter_context(zeromq_flooder(socket, daemon.version.zeromq_pose_endpoint, key))
            else:
                send = sends(parts.enter_context(daemon.zenoh(daemon.keys["hand"])), key)

            def is_cut() -> bool:
                send(POSE, 1000)
                return FLOOD in daemon.log()

            wait_for("the end of its connection", is_cut)
            lines = [json.loads(line) for line in daemon.log().splitlines() if FLOOD in line]
            assert {line["who"].split(".")[0] for line in lines} == {"a-hand"}
            scene = daemon.server.scene("b")
            with scene.tool_stream("probe", transport) as operator:

                def answers() -> bool:
                    operator.send(IN_AIR_M)
                    return scene.feedback("probe").client_id == operator.client_id

                wait_for("the operator, in another scene", answers)

    @pytest.mark.attack("a client with a key floods calls", "the relay served nobody else")
    @pytest.mark.skipif(not ALL, reason="takes half a minute of CPU time; `make attack` runs it")
    def test_a_key_that_floods_calls_is_cut(
        self, tmp_path: Path, record_property: Callable[[str, object], None]
    ) -> None:
        from keyed_parts import guarded

        with guarded(tmp_path) as daemon, contextlib.ExitStack() as parts:
            stop = threading.Event()
            request = control_pb2.GetTopologyRequest(scene="a")

            def flood() -> None:
                while not stop.is_set():
                    with daemon.stub(daemon.keys["viewer"]) as stub, contextlib.suppress(grpc.RpcError):
                        while not stop.is_set():
                            stub.GetTopology(request, timeout=DEADLINE_S)

            threads = [threading.Thread(target=flood) for _ in range(8)]
            for thread in threads:
                thread.start()
                parts.callback(thread.join)
            parts.callback(stop.set)
            operator = parts.enter_context(daemon.stub(daemon.keys["operator"]))
            slowest = 0.0
            start, used_before_s = time.monotonic(), cpu_time_of(daemon.server, "relay")
            while "kMaxRelayCpuShare" not in daemon.log():
                if (lasted_s := time.monotonic() - start) > 6 * DEADLINE_S:
                    used_s = cpu_time_of(daemon.server, "relay") - used_before_s
                    if used_s < RELAY_CPU_AT_ONCE_S + RELAY_CPU_SHARE * lasted_s:
                        pytest.skip(f"the relay got {used_s:.0f} s of CPU in {lasted_s:.0f} s, which a key may take")
                    pytest.fail("the key was not cut")
                begin = time.monotonic()
                operator.GetStatus(control_pb2.GetStatusRequest(scene="a"), timeout=DEADLINE_S)
                slowest = max(slowest, time.monotonic() - begin)
                time.sleep(0.05)
            record_property("now", f"cut; others answered within {slowest:.2f} s")
            assert slowest < 1.0
