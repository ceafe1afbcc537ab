"""Strangers that hold connections: they leave descriptors and places for others."""

from __future__ import annotations

import contextlib
import resource
import socket
from collections.abc import Iterator

import grpc
import pytest
import zmq
from attack_parts import DEADLINE_S, attacked, block, count_of, wait_for

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc

#: What a process may have unless somebody raises it, and what the daemon and this test need.
BY_DEFAULT, NEEDED = 1024, 8192
#: server/core/bus_limits.h and http2_limits.h.
ZEROMQ_CONNECTIONS, CONTROL_CONNECTIONS = 1024, 512
FRAME, TOPOLOGY = b"tensormass/local/block/frame\0", b"tensormass/local/block/topology\0"


@pytest.fixture
def server() -> Iterator[tm.Server]:
    """A daemon that starts with the descriptors that a process has by default."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] != resource.RLIM_INFINITY and before[1] < NEEDED:
        pytest.skip(f"a process may not have {NEEDED} descriptors here")
    resource.setrlimit(resource.RLIMIT_NOFILE, (BY_DEFAULT, before[1]))
    try:
        with attacked() as server:
            resource.setrlimit(resource.RLIMIT_NOFILE, (NEEDED, before[1]))
            server.load(block())
            yield server
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def call(server: tm.Server) -> None:
    """Calls over a connection of its own."""
    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = control_pb2_grpc.ControlStub(channel)
        stub.GetStatus(control_pb2.GetStatusRequest(scene="block"), timeout=DEADLINE_S, wait_for_ready=True)


def hello(kind: bytes) -> bytes:
    """The greeting of ZMTP 3.0 without a mechanism, and READY of a socket of this kind."""
    ready = b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind
    greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
    return greeting + b"\x04" + bytes([len(ready)]) + ready


@pytest.mark.attack(
    "1,500 connections held at a ZeroMQ endpoint", "no descriptor was left: nobody could connect, and a core spun"
)
@pytest.mark.parametrize(("endpoint", "kind"), [("zeromq_publish_endpoint", b"SUB"), ("zeromq_pose_endpoint", b"PUSH")])
def test_who_holds_zeromq_connections_keeps_nobody_out(server: tm.Server, endpoint: str, kind: bytes) -> None:
    def refused() -> float:
        return count_of(server, "tensormass_bus_refusals_total", transport="zeromq", reason="connections")

    host, port = getattr(server.version(), endpoint).removeprefix("tcp://").split(":")
    with contextlib.ExitStack() as parts, zmq.Context() as context:
        honest = parts.enter_context(context.socket(zmq.SUB))
        honest.setsockopt(zmq.LINGER, 0)
        honest.setsockopt(zmq.RCVTIMEO, round(1000 * DEADLINE_S))
        honest.setsockopt(zmq.CONFLATE, 1)
        honest.subscribe(FRAME)
        cut = honest.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        honest.connect(server.version().zeromq_publish_endpoint)
        honest.recv()
        for _ in range(1500):
            stranger = parts.enter_context(socket.create_connection((host, int(port)), timeout=DEADLINE_S))
            stranger.sendall(hello(kind))
        wait_for("the end of those too many", lambda: refused() >= 1500 - ZEROMQ_CONNECTIONS)
        call(server)
        honest.recv()
        assert not cut.poll(0), "who subscribed keeps its connection"
        joiner = parts.enter_context(context.socket(zmq.SUB))
        joiner.setsockopt(zmq.LINGER, 0)
        joiner.setsockopt(zmq.RCVTIMEO, round(1000 * DEADLINE_S))
        joiner.subscribe(TOPOLOGY)
        joiner.connect(server.version().zeromq_publish_endpoint)
        assert joiner.recv().startswith(TOPOLOGY)


@pytest.mark.attack("700 connections held at the control endpoint", "no descriptor was left: nobody could connect")
def test_who_holds_control_connections_keeps_nobody_out(server: tm.Server) -> None:
    host, port = server.address.split(":")
    preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
    with contextlib.ExitStack() as parts:
        channel = parts.enter_context(grpc.insecure_channel(server.address, [("grpc.use_local_subchannel_pool", 1)]))
        stub = control_pb2_grpc.ControlStub(channel)
        honest = stub.RecordScene(control_pb2.RecordSceneRequest(scene="block"))
        assert next(honest).HasField("start")
        held = []
        for _ in range(CONTROL_CONNECTIONS + 188):
            held.append(parts.enter_context(socket.create_connection((host, int(port)), timeout=DEADLINE_S)))
            held[-1].sendall(preface)
            assert held[-1].recv(9), "the daemon's settings"
        call(server)
        next(honest)  # who has a call keeps its connection
        honest.cancel()
