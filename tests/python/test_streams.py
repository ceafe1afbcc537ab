"""Newest-wins subscriptions and poses, on both transports, against a bus made here."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
import zmq

import tensormass as tm
from tensormass.streams import (
    DataPlane,
    PoseSequence,
    Transport,
    reached_endpoint,
    reached_endpoints,
    stream_key,
)
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")
DEADLINE_S = 10.0


class Bus:
    """The server's side of both transports. `publish` waits until the stream has a subscriber."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self.publisher = self.context.socket(zmq.XPUB)
        self.poses = self.context.socket(zmq.PULL)
        for each in (self.publisher, self.poses):
            each.setsockopt(zmq.RCVTIMEO, int(1000 * DEADLINE_S))
            each.setsockopt(zmq.LINGER, 0)
            each.bind("tcp://127.0.0.1:*")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            locator = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        config = zenoh.Config()
        config.insert_json5("listen/endpoints", f'["{locator}"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        self.zenoh = zenoh.open(config)
        self.version = control_pb2.GetVersionResponse(
            server="s",
            zeromq_publish_endpoint=self.publisher.getsockopt_string(zmq.LAST_ENDPOINT),
            zeromq_pose_endpoint=self.poses.getsockopt_string(zmq.LAST_ENDPOINT),
            zenoh_locator=locator,
        )

    def wait_subscribed(self, key: str, transport: Transport) -> None:
        if transport == "zeromq":
            assert self.publisher.recv() == b"\x01" + key.encode() + b"\0"
            return
        matched = threading.Event()
        publisher = self.zenoh.declare_publisher(key)
        listener = publisher.declare_matching_listener(lambda status: matched.set() if status.matching else None)
        if not publisher.matching_status.matching:
            assert matched.wait(DEADLINE_S)
        listener.undeclare()
        publisher.undeclare()

    def publish(self, key: str, payload: bytes, transport: Transport) -> None:
        if transport == "zeromq":
            self.publisher.send(key.encode() + b"\0" + payload)
        else:
            self.zenoh.put(key, payload)

    def close(self) -> None:
        self.context.destroy(linger=0)
        self.zenoh.close()


@pytest.fixture
def bus() -> Iterator[Bus]:
    bus = Bus()
    yield bus
    bus.close()


@pytest.fixture
def plane(bus: Bus) -> Iterator[DataPlane]:
    with DataPlane(bus.version) as plane:
        yield plane


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_slow_reader_gets_the_newest(bus: Bus, plane: DataPlane, transport: Transport) -> None:
    key = stream_key("s", "scene", "status")
    with plane.subscribe("scene", "status", stream_pb2.SceneStatus, transport) as statuses:
        bus.wait_subscribed(key, transport)
        for step in range(1, 501):
            bus.publish(key, stream_pb2.SceneStatus(step=step).SerializeToString(), transport)
        # A few are read while others are still on their way; the last one always comes, and none twice.
        steps = [statuses.receive(DEADLINE_S).step]
        while steps[-1] != 500:
            steps.append(statuses.receive(DEADLINE_S).step)
        assert steps == sorted(set(steps))
        assert len(steps) < 250
        with pytest.raises(tm.DeadlineExceededError, match="tensormass/s/scene/status"):
            statuses.receive(timeout_s=0)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_garbage_is_counted_and_passed_over(bus: Bus, plane: DataPlane, transport: Transport) -> None:
    key = stream_key("s", "scene", "frame")
    with plane.subscribe("scene", "frame", stream_pb2.Frame, transport) as frames:
        bus.wait_subscribed(key, transport)
        bus.publish(key, b"\xff\xff\xff", transport)
        deadline = time.monotonic() + DEADLINE_S
        while frames.malformed_count == 0 and time.monotonic() < deadline:
            with pytest.raises(tm.DeadlineExceededError):
                frames.receive(0.05)
        bus.publish(key, stream_pb2.Frame(step=7).SerializeToString(), transport)
        assert frames.receive(DEADLINE_S).step == 7
        assert frames.malformed_count == 1


def test_other_keys_do_not_come(bus: Bus, plane: DataPlane) -> None:
    key = stream_key("s", "scene", "frame")
    with plane.subscribe("scene", "frame", stream_pb2.Frame, "zeromq") as frames:
        bus.wait_subscribed(key, "zeromq")
        for other in (key + "x", stream_key("s", "scene2", "frame")):
            bus.publish(other, stream_pb2.Frame(step=1).SerializeToString(), "zeromq")
        bus.publish(key, stream_pb2.Frame(step=2).SerializeToString(), "zeromq")
        assert frames.receive(DEADLINE_S).step == 2


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_poses_arrive_in_order_with_their_key(bus: Bus, plane: DataPlane, transport: Transport) -> None:
    key = stream_key("s", "scene", "tool/probe/pose")
    received = bus.zenoh.declare_subscriber(key) if transport == "zenoh" else None
    with plane.pose_sender("scene", "probe", transport) as sender:
        if transport == "zenoh":
            assert received is not None
            while not isinstance(sample := _send_and_poll(sender, received), zenoh.Sample):
                pass
            payload = sample.payload.to_bytes()
        else:
            sender.send((1.0, 2.0, 3.0), (2.0, 0.0, 0.0, 0.0))
            where, payload = bus.poses.recv().split(b"\0", 1)
            assert where.decode() == key
    pose = stream_pb2.ToolPose.FromString(payload)
    assert pose.sequence >= 1
    assert pose.client_id != 0
    assert pose.position_m == scene_pb2.Vector3(x=1, y=2, z=3)
    assert pose.orientation == scene_pb2.Quaternion(w=1)


def _send_and_poll(sender: tm.PoseSender, received: zenoh.Subscriber) -> object:
    sender.send((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    return received.try_recv()


def test_poses_are_numbered_for_each_client() -> None:
    first, second = PoseSequence(), PoseSequence()
    assert [first.next((0, 0, 0), None).sequence for _ in range(3)] == [1, 2, 3]
    assert second.next((0, 0, 0), None).sequence == 1
    assert first.next((0, 0, 0), None).client_id != second.next((0, 0, 0), None).client_id


@pytest.mark.parametrize(
    ("position", "orientation", "message"),
    [
        ((0, 0, np.nan), None, "position: expected three finite numbers"),
        ((0, 0), None, "position"),
        ((0, 0, 0), (0, 0, 0, 0), "not all zero"),
        ((0, 0, 0), (1, 0, 0), "orientation"),
    ],
)
def test_a_pose_that_is_none_is_not_sent(position: tuple[float, ...], orientation: object, message: str) -> None:
    sequence = PoseSequence()
    with pytest.raises(tm.InvalidArgumentError, match=message):
        sequence.next(position, orientation)  # type: ignore[arg-type]
    assert sequence.last == 0


@pytest.mark.parametrize(
    ("endpoint", "reached"),
    [
        ("tcp://0.0.0.0:1", "tcp://trainer:1"),
        ("tcp://*:1", "tcp://trainer:1"),
        ("tcp://[::]:1", "tcp://trainer:1"),
        ("tcp/0.0.0.0:1", "tcp/trainer:1"),
        ("tcp/[::]:1", "tcp/trainer:1"),
        ("udp/0.0.0.0:1", "udp/trainer:1"),
        # What names a host is meant.
        ("tcp://127.0.0.1:1", "tcp://127.0.0.1:1"),
        ("tcp://10.0.0.0:1", "tcp://10.0.0.0:1"),
        ("tcp://[::1]:1", "tcp://[::1]:1"),
        ("tcp/192.0.2.7:1", "tcp/192.0.2.7:1"),
        ("ipc:///run/0.0.0.0:1", "ipc:///run/0.0.0.0:1"),
        ("", ""),
    ],
)
def test_a_wildcard_is_reached_where_control_is(endpoint: str, reached: str) -> None:
    assert reached_endpoint(endpoint, "trainer:50051") == reached


@pytest.mark.parametrize(
    ("control", "host"),
    [
        ("192.0.2.7:50051", "192.0.2.7"),
        ("[2001:db8::7]:50051", "[2001:db8::7]"),
        ("dns:///trainer.example:50051", "trainer.example"),
        ("ipv6:[::1]:50051", "[::1]"),
        ("trainer", "trainer"),
    ],
)
def test_the_host_of_control_is_found(control: str, host: str) -> None:
    assert reached_endpoint("tcp/[::]:7447", control) == f"tcp/{host}:7447"


def test_all_endpoints_of_an_answer_are_reached() -> None:
    version = control_pb2.GetVersionResponse(
        server="s",
        malformed_messages=3,
        zeromq_publish_endpoint="tcp://0.0.0.0:1",
        zeromq_pose_endpoint="tcp://192.0.2.9:2",
        zenoh_locator="tcp/[::]:3",
    )
    reached = reached_endpoints(version, "trainer:50051")
    assert reached == control_pb2.GetVersionResponse(
        server="s",
        malformed_messages=3,
        zeromq_publish_endpoint="tcp://trainer:1",
        zeromq_pose_endpoint="tcp://192.0.2.9:2",
        zenoh_locator="tcp/trainer:3",
    )
    off = control_pb2.GetVersionResponse(server="s")
    assert reached_endpoints(off, "trainer:50051") == off


def test_a_transport_that_is_off_is_said() -> None:
    with DataPlane(control_pb2.GetVersionResponse(server="s")) as plane:
        with pytest.raises(tm.UnavailableError, match="ZeroMQ is off"):
            plane.subscribe("scene", "frame", stream_pb2.Frame, "zeromq")
        with pytest.raises(tm.UnavailableError, match="zenoh is off"):
            plane.subscribe("scene", "frame", stream_pb2.Frame, "zenoh")
