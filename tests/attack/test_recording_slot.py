"""Clients that record and then fall silent: the scene is somebody else's after a while.

raw socket, window 0     answers pings, takes no byte     its lease ends after 10 s
stopped process          answers nothing                  its keepalive ends after 15 s
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
from daemon_parts import small_daemon
from service_parts import block

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2

DEADLINE_S = 40.0
"""More than lease and keepalive together, on a machine that is busy."""

SETTINGS, HEADERS, DATA, PING, INITIAL_WINDOW_SIZE = 4, 1, 0, 6, 4
ACK, END_HEADERS, END_STREAM = 1, 4, 1

STOPPED = """
import os, signal, sys
import tensormass as tm
from tensormass.v1 import control_pb2
with tm.connect(sys.argv[1]) as server:
    stream = server.call("RecordScene", control_pb2.RecordSceneRequest(scene=sys.argv[2], reset=True), timeout_s=None)
    next(stream)
    print("records", flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
"""


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with small_daemon() as server:
        yield server


def frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    return struct.pack(">I", len(payload))[1:] + struct.pack(">BBI", kind, flags, stream) + payload


def literal(name: bytes, value: bytes) -> bytes:
    """A header that needs no table and no code (RFC 7541, section 6.2.2)."""
    return b"\0" + bytes([len(name)]) + name + bytes([len(value)]) + value


class SilentClient:
    """Calls RecordScene over HTTP/2 with a window of zero bytes, and answers pings and settings."""

    def __init__(self, address: str, scene: str) -> None:
        host, port = address.rsplit(":", 1)
        self._socket = socket.create_connection((host, int(port)))
        request = control_pb2.RecordSceneRequest(scene=scene, reset=True).SerializeToString()
        headers = {
            b":method": b"POST",
            b":scheme": b"http",
            b":path": b"/tensormass.v1.Control/RecordScene",
            b":authority": b"daemon",
            b"te": b"trailers",
            b"content-type": b"application/grpc",
        }
        self._socket.sendall(
            b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
            + frame(SETTINGS, 0, 0, struct.pack(">HI", INITIAL_WINDOW_SIZE, 0))
            + frame(HEADERS, END_HEADERS, 1, b"".join(literal(*pair) for pair in headers.items()))
            + frame(DATA, END_STREAM, 1, b"\0" + struct.pack(">I", len(request)) + request)
        )
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _answer(self) -> None:
        with contextlib.suppress(OSError), self._socket.makefile("rb") as file:
            while len(head := file.read(9)) == 9:
                payload = file.read(int.from_bytes(head[:3], "big"))
                if head[3] in (SETTINGS, PING) and not head[4] & ACK:
                    self._socket.sendall(frame(head[3], ACK, 0, payload if head[3] == PING else b""))


def is_recorded(stub: control_pb2_grpc.ControlStub, scene: str) -> bool:
    """Whether a recording of the scene is refused because somebody else records it. One that begins ends at once."""
    stream = stub.RecordScene(control_pb2.RecordSceneRequest(scene=scene), timeout=DEADLINE_S)
    try:
        next(stream)
    except grpc.RpcError as error:
        if "is being recorded" not in (error.details() or ""):
            raise
        return True
    finally:
        stream.cancel()
    return False


def wait_until(recorded: bool, stub: control_pb2_grpc.ControlStub, scene: str) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while is_recorded(stub, scene) != recorded:
        assert time.monotonic() < deadline_s, f"scene {scene!r} still belongs to a client that fell silent"
        time.sleep(0.2)  # asks again; each answer is quick


def test_scene_of_a_client_that_fell_silent_is_free_again(server: tm.Server) -> None:
    for name in ("windowless", "stopped", "honest"):
        server.load(block(), name=name, lockstep=True)
    silent = SilentClient(server.address, "windowless")
    channel = grpc.insecure_channel(server.address)
    stub = control_pb2_grpc.ControlStub(channel)
    wait_until(True, stub, "windowless")  # at once, because its lease runs
    stopped = subprocess.Popen(
        [sys.executable, "-c", STOPPED, server.address, "stopped"], stdout=subprocess.PIPE, text=True
    )
    honest = stub.RecordScene(control_pb2.RecordSceneRequest(scene="honest", reset=True))
    try:
        assert stopped.stdout is not None
        assert stopped.stdout.readline() == "records\n"
        assert next(honest).HasField("start")
        # An edit waits for no recorder.
        changes = control_pb2.SceneAdjustments(gravity_m_per_s2=scene_pb2.Vector3(z=-1))
        stub.AdjustScene(control_pb2.AdjustSceneRequest(scene="stopped", changes=changes), timeout=DEADLINE_S)
        wait_until(False, stub, "windowless")
        metrics = stub.GetMetrics(control_pb2.GetMetricsRequest()).text
        assert '\ntensormass_recording_losses_total{scene="windowless",what="recordings"} 1\n' in metrics
        assert server.log_file is not None
        told = r"closed who=127\.0\.0\.1:\d+ what=tensormass\.v1\.Control/RecordScene scene=windowless reason="
        assert re.search(told, server.log_file.read_text())
        wait_until(False, stub, "stopped")
        # Nothing came for as long, because the scene stands still; yet this client reads, so the scene stays its own.
        assert is_recorded(stub, "honest")
        stub.StepScene(control_pb2.StepSceneRequest(scene="honest", count=1))
        assert next(honest).steps[0].step == 1
    finally:
        silent.close()
        os.kill(stopped.pid, signal.SIGKILL)
        stopped.communicate()
        channel.close()
