"""Newest-wins subscriptions and poses, on both transports, against a bus made here."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
import zmq

import tensormass as tm
from tensormass._shared.endpoints import reached_endpoint, reached_endpoints
from tensormass._src.data_plane import DataPlane
from tensormass._src.poses import PoseSequence
from tensormass._src.streams import Transport, stream_key
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")
DEADLINE_S = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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
        locator = f"tcp/127.0.0.1:{free_port()}"
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
        now: Any = publisher.matching_status  # the stub says bool
        if not now.matching:
            assert matched.wait(DEADLINE_S)
        listener.undeclare()
        publisher.undeclare()

    def publish(self, key: str, payload: bytes, transport: Transport) -> None:
        if transport == "zeromq":
            self.publisher.send(key.encode() + b"\0" + payload)
        else:
            self.zenoh.put(key, payload)

    def next_pose(self) -> tuple[str, stream_pb2.ToolPose]:
        """Over ZeroMQ."""
        key, payload = self.poses.recv().split(b"\0", 1)
        return key.decode(), stream_pb2.ToolPose.FromString(payload)

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
        assert len(steps) < 500, "some were replaced"
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


class Scripted:
    """A source that hands out what a test put into it, as long as there is time."""

    def __init__(self, payloads: list[bytes]) -> None:
        self.payloads = payloads

    def receive(self, timeout_s: float) -> bytes | None:
        return self.payloads.pop(0) if timeout_s > 0 and self.payloads else None

    def close(self) -> None:
        pass


def test_garbage_takes_none_of_the_time_that_is_left(plane: DataPlane) -> None:
    source = Scripted([b"\xff"] * 20 + [stream_pb2.Frame(step=7).SerializeToString()])
    frames = tm.Subscription(plane.check_open, source, "key", stream_pb2.Frame)  # type: ignore[arg-type]
    assert frames.receive(DEADLINE_S).step == 7
    assert frames.malformed_count == 20


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_silent_stream_times_out_after_the_given_time(plane: DataPlane, transport: Transport) -> None:
    with plane.subscribe("scene", "frame", stream_pb2.Frame, transport) as frames:
        begin = time.monotonic()
        with pytest.raises(tm.DeadlineExceededError, match=r"in 0\.1 s"):
            frames.receive(0.1)
        assert 0.09 < time.monotonic() - begin < DEADLINE_S / 2


def test_a_retained_message_does_not_replace_a_newer_one(bus: Bus, plane: DataPlane) -> None:
    key, other = stream_key("s", "scene", "status"), stream_key("s", "scene", "frame")
    asked = bus.zenoh.declare_queryable(key)
    with (
        plane.subscribe("scene", "status", stream_pb2.SceneStatus, "zenoh") as statuses,
        plane.subscribe("scene", "frame", stream_pb2.Frame, "zenoh") as frames,
    ):
        query = asked.recv()
        for each in (key, other):
            bus.wait_subscribed(each, "zenoh")
        bus.publish(key, stream_pb2.SceneStatus(step=2).SerializeToString(), "zenoh")
        query.reply(key, stream_pb2.SceneStatus(step=1).SerializeToString())
        query.drop()
        bus.publish(other, stream_pb2.Frame(step=3).SerializeToString(), "zenoh")
        assert frames.receive(DEADLINE_S).step == 3  # so the answer, which left before it, is here too
        assert statuses.receive(DEADLINE_S).step == 2
    asked.undeclare()


def test_a_closed_subscription_is_given_up_at_the_server(bus: Bus, plane: DataPlane) -> None:
    key = stream_key("s", "scene", "status")
    gone = threading.Event()
    publisher = bus.zenoh.declare_publisher(key)
    with plane.subscribe("scene", "status", stream_pb2.SceneStatus, "zenoh"):
        bus.wait_subscribed(key, "zenoh")
        listener = publisher.declare_matching_listener(lambda status: None if status.matching else gone.set())
    assert gone.wait(DEADLINE_S)
    listener.undeclare()
    publisher.undeclare()


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
            pose = stream_pb2.ToolPose.FromString(sample.payload.to_bytes())
        else:
            sender.send((1.0, 2.0, 3.0), (2.0, 0.0, 0.0, 0.0))
            where, pose = bus.next_pose()
            assert where == key
    assert pose.sequence >= 1
    assert pose.client_id == sender.client_id != 0
    assert pose.position_m == scene_pb2.Vector3(x=1, y=2, z=3)
    assert pose.orientation == scene_pb2.Quaternion(w=1)


def _send_and_poll(sender: tm.PoseSender, received: zenoh.Subscriber[Any]) -> object:
    sender.send((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    return received.try_recv()


@pytest.mark.parametrize("closed", ["sender", "plane"])
def test_the_newest_pose_leaves_before_its_sender_is_closed(bus: Bus, closed: str) -> None:
    for count in [1, 2, 50] * 20:
        with DataPlane(bus.version) as plane:
            sender = plane.pose_sender("scene", "probe", "zeromq")
            for _ in range(count):
                last = sender.send((0, 0, 0))
            {"sender": sender, "plane": plane}[closed].close()
            while bus.next_pose()[1].sequence != last:  # the fixture's time-out ends a test in which it was lost
                pass


def test_the_newest_pose_leaves_though_none_follows(bus: Bus, plane: DataPlane) -> None:
    sender = plane.pose_sender("scene", "probe", "zeromq")
    for _ in range(20):
        for _ in range(500):  # more than the bus takes at once
            last = sender.send((0, 0, 0))
        while bus.next_pose()[1].sequence != last:
            pass


def test_a_server_that_was_away_gets_the_newest_pose_alone(bus: Bus) -> None:
    bus.version.zeromq_pose_endpoint = f"tcp://127.0.0.1:{free_port()}"
    with DataPlane(bus.version) as plane:
        sender = plane.pose_sender("scene", "probe", "zeromq")
        for _ in range(50):
            sender.send((0, 0, 0))
        bus.poses.bind(bus.version.zeromq_pose_endpoint)
        assert bus.next_pose()[1].sequence == 50


def test_closing_does_not_wait_for_a_server_that_never_comes(bus: Bus) -> None:
    bus.version.zeromq_pose_endpoint = f"tcp://127.0.0.1:{free_port()}"
    with DataPlane(bus.version) as plane:
        sender = plane.pose_sender("scene", "probe", "zeromq")
        sender.send((0, 0, 0))
        begin = time.monotonic()
    assert time.monotonic() - begin < DEADLINE_S / 2


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_process_ends_that_closed_nothing(bus: Bus, transport: Transport) -> None:
    program = (
        "import sys\n"
        "from tensormass._src.data_plane import DataPlane\n"
        "from tensormass.v1 import control_pb2, stream_pb2\n"
        "version, transport = bytes.fromhex(sys.argv[1]), sys.argv[2]\n"
        "plane = DataPlane(control_pb2.GetVersionResponse.FromString(version))\n"
        "poses = plane.pose_sender('scene', 'probe', transport)\n"
        "poses.send((0, 0, 0))\n"
        "statuses = plane.subscribe('scene', 'status', stream_pb2.SceneStatus, transport)\n"
        "print(statuses.receive(60).step, flush=True)\n"
    )
    key, status = stream_key("s", "scene", "status"), stream_pb2.SceneStatus(step=7).SerializeToString()
    arguments = [sys.executable, "-c", program, bus.version.SerializeToString().hex(), transport]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            bus.wait_subscribed(key, transport)
            deadline = time.monotonic() + DEADLINE_S
            while process.poll() is None:  # messages come until the end
                assert time.monotonic() < deadline, "it does not end"
                bus.publish(key, status, transport)
        finally:
            process.kill()
        assert process.communicate() == ("7\n", "")
    assert process.returncode == 0


def test_poses_are_numbered_for_each_client() -> None:
    first, second = PoseSequence(), PoseSequence()
    assert [first.next((0, 0, 0), None).sequence for _ in range(3)] == [1, 2, 3]
    before_ns = time.monotonic_ns()
    assert before_ns <= PoseSequence().next((0, 0, 0), None).client_time_ns <= time.monotonic_ns()
    assert second.next((0, 0, 0), None).sequence == 1
    one, other = first.next((0, 0, 0), None), second.next((0, 0, 0), None)
    assert one.client_id != other.client_id
    assert len({one.session, other.session, one.client_id, other.client_id, 0}) == 5
    assert first.next((0, 0, 0), None).session == one.session


@pytest.mark.parametrize(
    ("position", "orientation", "message"),
    [
        ((0, 0, np.nan), None, "position: expected three finite numbers"),
        ((0, 0), None, "position"),
        ((0, 0, 0), (0, 0, 0, 0), "not all zero"),
        ((0, 0, 0), (1, 0, 0), "orientation"),
        ("abc", None, "position: expected three finite numbers, got 'abc'"),
        ((0, 0, 0), "up", "orientation: expected four finite numbers w, x, y, z, .* got 'up'"),
        ((0, 0, [1]), None, "position: expected three finite numbers"),
        ({}, None, "position: expected three finite numbers"),
    ],
)
def test_an_invalid_pose_is_not_sent(position: object, orientation: object, message: str) -> None:
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
        # An endpoint that names a host is not changed.
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


def test_a_transport_that_is_off_is_reported() -> None:
    with DataPlane(control_pb2.GetVersionResponse(server="s")) as plane:
        with pytest.raises(tm.UnavailableError, match="ZeroMQ is off"):
            plane.subscribe("scene", "frame", stream_pb2.Frame, "zeromq")
        with pytest.raises(tm.UnavailableError, match="zenoh is off"):
            plane.subscribe("scene", "frame", stream_pb2.Frame, "zenoh")


def test_an_unknown_transport_is_refused(plane: DataPlane) -> None:
    for transport in ("Zenoh", ""):
        words = f"unknown transport '{transport}'; known: zeromq, zenoh"
        with pytest.raises(tm.InvalidArgumentError, match=words):
            plane.subscribe("scene", "frame", stream_pb2.Frame, transport)  # type: ignore[arg-type]
        with pytest.raises(tm.InvalidArgumentError, match=words):
            plane.pose_sender("scene", "probe", transport)  # type: ignore[arg-type]


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_using_a_closed_stream_is_reported(plane: DataPlane, transport: Transport) -> None:
    def use(sender: tm.PoseSender, statuses: tm.Subscription[stream_pb2.SceneStatus]) -> Iterator[Callable[[], object]]:
        yield lambda: sender.send((0, 0, 0))
        yield lambda: statuses.receive(0)

    def open_both() -> tuple[tm.PoseSender, tm.Subscription[stream_pb2.SceneStatus]]:
        sender = plane.pose_sender("scene", "probe", transport)
        return sender, plane.subscribe("scene", "status", stream_pb2.SceneStatus, transport)

    closed, left_open = open_both(), open_both()
    for stream in closed:
        stream.close()
        stream.close()
    for call in use(*closed):
        with pytest.raises(
            tm.UnavailableError, match=r"tensormass/s/scene/.*: this stream is closed; open another one"
        ):
            call()
    plane.close()
    plane.close()
    for call in (*use(*left_open), *use(*closed), open_both, plane.zenoh):
        with pytest.raises(tm.UnavailableError, match="this connection to daemon 's' is closed; connect again"):
            call()
    for stream in left_open:
        stream.close()
