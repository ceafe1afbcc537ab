"""Strangers that misuse HTTP/2 under gRPC. Frames are written by hand, because no client library writes such ones."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Callable, Iterator

import grpc
import pytest
from attack_parts import DEADLINE_S, MIB, attacked, block, memory_of, restart_high_water_mark, wait_for

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc

DATA, HEADERS, RESET, SETTINGS, PING, WINDOW_UPDATE, CONTINUATION = 0, 1, 3, 4, 6, 8, 9
ACK, END_HEADERS = 0x1, 0x4
INITIAL_WINDOW_SIZE = 4


def frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    return struct.pack(">I", len(payload))[1:] + bytes([kind, flags]) + struct.pack(">I", stream) + payload


def text(value: str) -> bytes:
    return bytes([len(value)]) + value.encode()


def headers(method: str) -> bytes:
    """HPACK without its dynamic table: POST, http, path, authority, content type, trailers."""
    path = text(f"/tensormass.v1.Control/{method}")
    return (
        b"\x83\x86\x04"
        + path
        + b"\x01"
        + text("x")
        + b"\x0f\x10"
        + text("application/grpc")
        + b"\0"
        + text("te")
        + text("trailers")
    )


class Stranger:
    def __init__(self, server: tm.Server) -> None:
        host, port = server.address.split(":")
        self.socket = socket.create_connection((host, int(port)), timeout=DEADLINE_S)
        self.socket.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame(SETTINGS, 0, 0))

    def __enter__(self) -> Stranger:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, content: bytes) -> bool:
        """Returns whether the daemon still took it."""
        try:
            self.socket.sendall(content)
        except (BrokenPipeError, ConnectionResetError):
            return False
        return True

    def send_message(self, size: int, *, all_but: int) -> bool:
        """Sends a message on stream 1 but for its last bytes, no faster than the server allows. Returns whether it was
        taken."""
        left = size + 5 - all_but
        content = b"\0" + struct.pack(">I", size)
        windows = {0: 65_535, 1: 65_535}
        received = b""
        try:
            while left > 0:
                room = min(left, 16_384, *windows.values())
                if room <= 0:
                    received += (got := self.socket.recv(1 << 16))
                    if not got:
                        return False
                    while len(received) >= 9 and len(received) >= (end := 9 + int.from_bytes(received[:3], "big")):
                        kind, stream, payload = received[3], int.from_bytes(received[5:9], "big"), received[9:end]
                        if kind in (SETTINGS, PING) and not received[4] & ACK:
                            self.socket.sendall(frame(kind, ACK, 0, payload if kind == PING else b""))
                        received = received[end:]
                        if kind == WINDOW_UPDATE and stream in windows:
                            windows[stream] += int.from_bytes(payload, "big")
                        for i in range(0, len(payload) if kind == SETTINGS else 0, 6):
                            name, value = struct.unpack_from(">HI", payload, i)
                            windows[1] += value - 65_535 if name == INITIAL_WINDOW_SIZE else 0
                    continue
                self.socket.sendall(frame(DATA, 0, 1, content[:room].ljust(room, b"\0")))
                content = content[room:]
                left -= room
                windows = {stream: window - room for stream, window in windows.items()}
        except (BrokenPipeError, ConnectionResetError):
            return False
        return True

    def was_closed(self) -> bool:
        with contextlib.suppress(ConnectionResetError):
            while self.socket.recv(1 << 16):
                pass
        return True


@pytest.fixture
def server() -> Iterator[tm.Server]:
    with attacked() as server:
        server.load(block())
        yield server


@pytest.fixture
def unharmed(server: tm.Server, record_property: Callable[[str, object], None]) -> Iterator[Callable[[], None]]:
    """Asserts that the daemon has hardly grown, and that calls of others were answered within a second."""
    restart_high_water_mark(server)
    before = memory_of(server, "VmHWM")
    longest_s = 0.0
    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = control_pb2_grpc.ControlStub(channel)

        def ask() -> None:
            nonlocal longest_s
            begin = time.monotonic()
            stub.GetStatus(control_pb2.GetStatusRequest(scene="block"), timeout=DEADLINE_S)
            longest_s = max(longest_s, time.monotonic() - begin)

        ask()
        longest_s = 0.0
        yield ask
        ask()
    grown = memory_of(server, "VmHWM") - before
    record_property("now", f"+{grown / MIB:.0f} MiB, answers within {1000 * longest_s:.0f} ms")
    assert grown < 64 * MIB


@pytest.mark.attack("HTTP/2 streams opened and reset (as in CVE-2023-44487)", "46 to 2,468 MiB, no answer for 28 s")
def test_streams_that_are_reset_end_the_connection(server: tm.Server, unharmed: Callable[[], None]) -> None:
    refused = server.version().malformed_messages
    for _ in range(20):
        with Stranger(server) as attacker:
            for first in range(1, 16_000, 200):
                burst = b"".join(
                    frame(HEADERS, END_HEADERS, stream, headers("GetVersion")) + frame(RESET, 0, stream, bytes(4))
                    for stream in range(first, first + 200, 2)
                )
                if not attacker.send(burst):
                    break
            assert attacker.was_closed()
        unharmed()
    wait_for("the count", lambda: server.version().malformed_messages == refused + 20)


@pytest.mark.attack("20,000 streams opened and never ended", "278 MiB")
def test_streams_without_end_are_bounded(server: tm.Server, unharmed: Callable[[], None]) -> None:
    with Stranger(server) as attacker:
        for stream in range(1, 40_000, 2):
            if not attacker.send(frame(HEADERS, END_HEADERS, stream, headers("LoadScene"))):
                break
        assert attacker.was_closed()
    unharmed()


@pytest.mark.attack("a header block without end (as in CVE-2023-33953)", "quadratic time: 10 s for 11 MiB")
def test_headers_without_end_are_bounded(server: tm.Server, unharmed: Callable[[], None]) -> None:
    for piece in (b"\0" + text("x" * 100) + text("y" * 100), b"", b"\0"):
        with Stranger(server) as attacker:
            attacker.send(frame(HEADERS, 0, 1, headers("GetVersion")))
            for _ in range(2_000):
                if not attacker.send(frame(CONTINUATION, 0, 1, piece) * 32):
                    break
            assert attacker.was_closed()
        unharmed()


@pytest.mark.attack("six half-sent messages of 300 MiB, and of 190 MiB", "666 MiB; before that, 1.7 GiB")
@pytest.mark.parametrize(("size_mib", "most_mib"), [(300, 256), (190, 400)])
def test_half_sent_messages_are_bounded(
    server: tm.Server, size_mib: int, most_mib: int, record_property: Callable[[str, object], None]
) -> None:
    restart_high_water_mark(server)
    before = memory_of(server, "VmHWM")
    attackers = [Stranger(server) for _ in range(6)]
    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = control_pb2_grpc.ControlStub(channel)
        for attacker in attackers:
            attacker.send(frame(HEADERS, END_HEADERS, 1, headers("LoadScene")))
            attacker.send_message(size_mib * MIB, all_but=1)
            stub.GetStatus(control_pb2.GetStatusRequest(scene="block"), timeout=DEADLINE_S)
        grown = memory_of(server, "VmHWM") - before
        # A message that goes on gets the memory of one that waits.
        large = control_pb2.LoadSceneRequest(scene=block("large").message)
        large.scene.bodies[0].initial_displacement_m = bytes(100 * MIB)
        with pytest.raises(grpc.RpcError) as refused:
            stub.LoadScene(large, timeout=DEADLINE_S)
        assert refused.value.code() == grpc.StatusCode.INVALID_ARGUMENT, refused.value.details()
    record_property("now", f"+{grown / MIB:.0f} MiB")
    # The daemon's bound is 200 MiB. gRPC frees what a connection held a moment after its end.
    assert grown <= most_mib * MIB
    for attacker in attackers:
        attacker.socket.close()


def test_a_message_that_is_too_large_is_told_the_remedy() -> None:
    scene = block("large").message
    scene.bodies[0].initial_displacement_m = bytes(9 * MIB)
    with attacked("--max-message-mib", "8") as server:
        # Several times: a connection that is closed while the client sends takes the reason with it now and then.
        for _ in range(10):
            # Channels of one address would share a connection, and its wait before the next one.
            options = [("grpc.use_local_subchannel_pool", 1)]
            with grpc.insecure_channel(server.address, options) as channel:
                stub = control_pb2_grpc.ControlStub(channel)
                with pytest.raises(grpc.RpcError) as refused:
                    stub.LoadScene(control_pb2.LoadSceneRequest(scene=scene), timeout=DEADLINE_S)
            assert "larger than --max-message-mib; start the daemon with a larger one" in str(refused.value.details())


@pytest.mark.attack("frames of PING and SETTINGS without end", "answered one by one")
@pytest.mark.parametrize("flood", [frame(PING, 0, 0, bytes(8)), frame(SETTINGS, 0, 0)], ids=["ping", "settings"])
def test_control_frames_are_bounded(server: tm.Server, unharmed: Callable[[], None], flood: bytes) -> None:
    with Stranger(server) as attacker:
        for _ in range(1_000):
            if not attacker.send(flood * 100):
                break
        assert attacker.was_closed()
    unharmed()


def test_large_messages_and_many_calls_pass(server: tm.Server) -> None:
    scene = block("large").message
    scene.bodies[0].color_srgb.x = 0.5
    with grpc.insecure_channel(server.address) as channel:
        stub = control_pb2_grpc.ControlStub(channel)
        # 64 MiB that are refused for what they hold, after they have arrived as a whole.
        scene.bodies[0].initial_displacement_m = bytes(64 * MIB)
        with pytest.raises(grpc.RpcError) as refused:
            stub.LoadScene(control_pb2.LoadSceneRequest(scene=scene), timeout=DEADLINE_S)
        assert refused.value.code() == grpc.StatusCode.INVALID_ARGUMENT, refused.value.details()
        calls = [stub.GetTopology.future(control_pb2.GetTopologyRequest(scene="block")) for _ in range(60)]
        assert {call.result(timeout=DEADLINE_S).topology.scene for call in calls} == {"block"}
        # A client that gives calls up now and then is let in.
        for _ in range(40):
            stub.GetStatus.future(control_pb2.GetStatusRequest(scene="block")).cancel()
        stub.GetStatus(control_pb2.GetStatusRequest(scene="block"), timeout=DEADLINE_S)
