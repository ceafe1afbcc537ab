"""Strangers at ZeroMQ's publish endpoint: exact keys, a bounded number of them, and no flood for the others."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator

import pytest
import zmq
from attack_parts import DEADLINE_S, MIB, attacked, block, memory_of, restart_high_water_mark, wait_for

import tensormass as tm
from tensormass.v1 import stream_pb2

SCENE = b"tensormass/local/block"
FRAME, TOPOLOGY = SCENE + b"/frame\0", SCENE + b"/topology\0"


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with attacked() as server:
        server.load(block())
        yield server


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


class Stranger:
    """Sends requests as they are, and notices when the daemon ends the connection."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], server: tm.Server) -> None:
        self.socket = context.socket(zmq.XSUB)
        self.socket.setsockopt(zmq.RECONNECT_IVL, -1)
        self.socket.setsockopt(zmq.SNDHWM, 0)
        self.socket.setsockopt(zmq.RCVTIMEO, round(DEADLINE_S * 1000))
        self._events = self.socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self.socket.connect(server.version().zeromq_publish_endpoint)

    def subscribe(self, key: bytes) -> None:
        self.socket.send(b"\1" + key)

    def unsubscribe(self, key: bytes) -> None:
        self.socket.send(b"\0" + key)

    def was_disconnected(self, within_s: float) -> bool:
        return bool(self._events.poll(round(within_s * 1000)))


def reader(context: zmq.Context[zmq.Socket[bytes]], server: tm.Server, key: bytes) -> zmq.Socket[bytes]:
    """An honest client."""
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.RCVTIMEO, round(DEADLINE_S * 1000))
    socket.subscribe(key)
    socket.connect(server.version().zeromq_publish_endpoint)
    return socket


def topology_of(message: bytes) -> stream_pb2.Topology:
    return stream_pb2.Topology.FromString(message.removeprefix(TOPOLOGY))


@pytest.mark.attack("subscriptions at XPUB without bound", "+194 MiB for 5.7 MiB sent")
def test_the_subscriptions_of_a_peer_are_bounded(
    server: tm.Server, context: zmq.Context[zmq.Socket[bytes]], record_property: Callable[[str, object], None]
) -> None:
    honest = reader(context, server, FRAME)
    honest.recv()
    restart_high_water_mark(server)
    before, malformed = memory_of(server, "VmHWM"), server.version().malformed_messages
    attacker = Stranger(context, server)
    for number in range(30_000):
        attacker.subscribe(b"tensormass/local/%s/tool/%s/feedback\0" % (b"s" * 64, b"%064d" % number))
    assert attacker.was_disconnected(DEADLINE_S)
    wait_for("the count of the malformed", lambda: server.version().malformed_messages == malformed + 1)
    grown = memory_of(server, "VmHWM") - before
    record_property("now", f"disconnected, +{grown / MIB:.1f} MiB")
    assert grown < 16 * MIB
    honest.recv()


def test_a_peer_may_have_all_streams_of_a_scene(server: tm.Server, context: zmq.Context[zmq.Socket[bytes]]) -> None:
    client = Stranger(context, server)
    for number in range(61):
        client.subscribe(SCENE + b"/tool/%d/feedback\0" % number)
    for key in (SCENE + b"/status\0", TOPOLOGY, FRAME):
        client.subscribe(key)
    while not client.socket.recv().startswith(FRAME):
        pass
    # An ended subscription makes room for another.
    client.unsubscribe(FRAME)
    client.subscribe(SCENE + b"/tool/probe/feedback\0")
    while not client.socket.recv().startswith(SCENE + b"/tool/probe/feedback\0"):
        pass


@pytest.mark.attack("a subscription to everything, or to another server", "served; a peer got all streams for one byte")
@pytest.mark.parametrize(
    "prefix",
    [
        b"",
        b"tensormass/",
        SCENE + b"/frame",
        b"tensormass/other/block/frame\0",
        SCENE + b"/tool/probe/pose\0",
        SCENE + b"/frame\0\0",
        b"tensormass/local//frame\0",
        b"x" * 900,
        b"x" * 100_000,
    ],
)
def test_only_exact_keys_of_this_daemon_are_served(
    server: tm.Server, context: zmq.Context[zmq.Socket[bytes]], prefix: bytes
) -> None:
    attacker = Stranger(context, server)
    attacker.subscribe(prefix)
    assert attacker.was_disconnected(DEADLINE_S)
    assert topology_of(reader(context, server, TOPOLOGY).recv()).scene == "block"


@pytest.mark.attack("a peer of ZMTP 2, whose requests ZeroMQ does not tell from others'", "served")
def test_old_versions_of_the_protocol_are_refused(server: tm.Server) -> None:
    host, port = server.version().zeromq_publish_endpoint.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as peer:
        # Signature, revision 1 (ZMTP 2.0), socket type SUB, an empty identity; then a subscription to everything.
        peer.sendall(b"\xff" + bytes(8) + b"\x7f" + b"\x01" + b"\x02" + b"\0\0" + b"\0\1\1")
        received = b""
        with contextlib.suppress(ConnectionResetError):
            while chunk := peer.recv(4096):
                received += chunk
                assert len(received) < 4096, "the daemon sends its streams"


@pytest.mark.attack("subscribe and unsubscribe in a loop", "1.5 GB of topologies to an honest subscriber")
def test_a_loop_of_subscriptions_floods_nobody(
    server: tm.Server, context: zmq.Context[zmq.Socket[bytes]], record_property: Callable[[str, object], None]
) -> None:
    honest = reader(context, server, TOPOLOGY)
    honest.recv()
    begin = time.monotonic()
    attacker = Stranger(context, server)
    for _ in range(20_000):
        attacker.subscribe(TOPOLOGY)
        attacker.unsubscribe(TOPOLOGY)
    attacker.subscribe(FRAME)
    # A frame comes after the daemon has read all of that.
    while not attacker.socket.recv().startswith(FRAME):
        pass
    # A late joiner gets it all the same, and so does the honest subscriber once more.
    joiner = reader(context, server, TOPOLOGY)
    assert topology_of(joiner.recv()).scene == "block"
    count = 0
    while honest.poll(0):
        honest.recv()
        count += 1
    elapsed_s = time.monotonic() - begin
    record_property("now", f"{count} in {elapsed_s:.1f} s")
    assert count <= elapsed_s + 2
