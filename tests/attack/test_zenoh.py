"""Strangers over zenoh: only the daemon speaks in its name, and what a stranger sends is bounded before it is held."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh
from attack_parts import (
    DEADLINE_S,
    IN_AIR_M,
    MIB,
    attacked,
    block,
    count_of,
    memory_of,
    restart_high_water_mark,
    wait_for,
)
from attack_parts import zenoh_session as stranger

import tensormass as tm
from tensormass._src.poses import PoseSequence
from tensormass.v1 import stream_pb2

SCENE = "tensormass/local/block"
REQUESTS_AT_ONCE, REQUESTS_PER_S = 4096, 256
"""kMaxZenohRequestsAtOnce and kMaxZenohRequestsPerS of server/core/bus_limits.h."""
FEEDBACK, POSE = f"{SCENE}/tool/probe/feedback", f"{SCENE}/tool/probe/pose"
IGNORE: zenoh.handlers.Callback[object] = zenoh.handlers.Callback(lambda _: None, indirect=False)
STREAMS = (f"{SCENE}/frame", f"{SCENE}/topology", f"{SCENE}/status", FEEDBACK)


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with attacked(zenoh=True) as server:
        server.load(block())
        yield server


def put(session: zenoh.Session, key: str, payload: bytes) -> None:
    """With the priority of feedback, so that nothing overtakes it on the way to a reader of feedback."""
    session.put(
        key, payload, priority=zenoh.Priority.REAL_TIME, congestion_control=zenoh.CongestionControl.BLOCK, express=True
    )


class Heard:
    """Messages of all streams that an honest client hears, and the last pose that a step answered."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self.keys: set[str] = set()
        self.forged: list[str] = []
        self.answered = 0
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.Callback(self._take, indirect=False))

    def _take(self, sample: zenoh.Sample) -> None:
        key, payload = str(sample.key_expr), sample.payload.to_bytes()
        self.keys.add(key)
        if payload == b"forged" or sample.kind == zenoh.SampleKind.DELETE:
            self.forged.append(key)
        elif key == FEEDBACK:
            self.answered = stream_pb2.ToolFeedback.FromString(payload).pose_sequence


@pytest.mark.attack(
    "a peer puts feedback, frame, topology, status over zenoh", "routed to other clients: 0 N became the largest force"
)
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_only_the_daemon_speaks_in_its_name(server: tm.Server, mode: str) -> None:
    with stranger(server) as honest, stranger(server, mode) as attacker:
        heard = Heard(honest, f"{SCENE}/**")
        wait_for("feedback", lambda: FEEDBACK in heard.keys)
        # The honest client is told of the attacker's pose after everything that the attacker sent before it.
        sequence = PoseSequence()
        sequence.last = first = 1_000_000 if mode == "client" else 2_000_000

        def forges() -> bool:
            for key in STREAMS:
                put(attacker, key, b"forged")
                attacker.delete(key)
            put(attacker, POSE, sequence.next(IN_AIR_M, None).SerializeToString())
            return heard.answered > first

        wait_for("the answer to the attacker's pose", forges)
        wait_for("the daemon's own streams", lambda: heard.keys >= {FEEDBACK, f"{SCENE}/frame", f"{SCENE}/status"})
        assert heard.forged == []


@pytest.mark.attack("a peer reads the poses of others over zenoh", "routed to it, so that no pose can hold a secret")
def test_poses_are_for_the_daemon_alone(server: tm.Server) -> None:
    with stranger(server) as hand, stranger(server) as attacker:
        heard = Heard(attacker, "**")
        wait_for("feedback", lambda: FEEDBACK in heard.keys)
        sequence = PoseSequence()
        sequence.last = 3_000_000

        def answered() -> bool:
            put(hand, POSE, sequence.next(IN_AIR_M, None).SerializeToString())
            return heard.answered > 3_000_000

        wait_for("the answer to the hand's pose", answered)
        assert POSE not in heard.keys


@pytest.mark.attack("a peer answers late joiners over zenoh", "the joiner got only the forged topology")
@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_late_joiner_gets_the_daemons_topology_alone(server: tm.Server, mode: str) -> None:
    with stranger(server, mode) as attacker, stranger(server) as joiner:

        def ask(session: zenoh.Session) -> list[bytes]:
            replies = session.get(f"{SCENE}/topology", target=zenoh.QueryTarget.ALL, timeout=DEADLINE_S)
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        def forge(query: zenoh.Query) -> None:
            query.reply(query.key_expr, b"forged")

        queryable = attacker.declare_queryable(
            f"{SCENE}/topology", zenoh.handlers.Callback(forge, indirect=False), complete=True
        )
        # The daemon has read the declaration when it answers what the attacker asked after it. A peer asks only itself
        # until the daemon's own declaration has come.
        wait_for("the daemon's answer", lambda: any(answer != b"forged" for answer in ask(attacker)))
        answers = ask(joiner)
        queryable.undeclare()
    assert [stream_pb2.Topology.FromString(answer).scene for answer in answers] == ["block"]


@pytest.mark.attack("a pose message of 128 MiB over zenoh", "held as a whole: +1,412 MiB for 800 MiB")
def test_a_large_pose_is_refused_before_it_is_held(
    server: tm.Server, record_property: Callable[[str, object], None]
) -> None:
    handle = server.scene("block")
    with stranger(server) as attacker:
        sequence = PoseSequence()
        put(attacker, POSE, sequence.next(IN_AIR_M, None).SerializeToString())
        wait_for("a first pose", lambda: handle.feedback("probe").client_id == sequence.client_id)
        restart_high_water_mark(server)
        before = memory_of(server, "VmHWM")
        put(attacker, POSE, bytes(128 * MIB))
        put(attacker, POSE, sequence.next(IN_AIR_M, None).SerializeToString())
        wait_for("the pose after it", lambda: handle.feedback("probe").pose_sequence == sequence.last)
        grown = memory_of(server, "VmHWM") - before
    record_property("now", f"+{grown / MIB:.1f} MiB")
    assert grown < 16 * MIB


@pytest.mark.attack("more zenoh sessions than --zenoh-sessions", "1000 whatever the machine")
def test_sessions_are_limited() -> None:
    with attacked("--zenoh-sessions", "3", zenoh=True) as server:
        held = [stranger(server) for _ in range(3)]
        with pytest.raises(zenoh.ZError):
            stranger(server)
        held.pop().close()

        def opens() -> bool:
            try:
                stranger(server).close()
            except zenoh.ZError:
                return False
            return True

        wait_for("a place of a session that left", opens)
        for session in held:
            session.close()


@pytest.mark.attack("5,000 subscriptions of one client over zenoh", "kept: +10 MiB, 5 s of CPU")
def test_subscriptions_are_bounded(server: tm.Server, record_property: Callable[[str, object], None]) -> None:
    def refused() -> float:
        return count_of(server, "tensormass_bus_refusals_total", transport="zenoh", reason="subscriptions")

    def take(_: zenoh.Sample) -> None:
        pass

    with stranger(server) as honest:
        heard = Heard(honest, f"{SCENE}/**")
        with stranger(server) as attacker:
            before, grown = refused(), memory_of(server)
            held = [
                attacker.declare_subscriber(
                    f"tensormass/local/s{i}/frame", zenoh.handlers.Callback(take, indirect=False)
                )
                for i in range(5000)
            ]
            wait_for("the end of the connection", lambda: refused() > before)
            record_property("now", f"disconnected, +{(memory_of(server) - grown) / MIB:.1f} MiB")
            del held
        heard.keys.clear()
        wait_for("frames of an honest client", lambda: f"{SCENE}/frame" in heard.keys)


def refused_peers(server: tm.Server) -> float:
    return count_of(server, "tensormass_bus_refusals_total", transport="zenoh", reason="subscriptions")


@pytest.mark.attack("subscriptions with keys of 60,000 bytes over zenoh", "kept: 15 MiB a connection")
def test_long_keys_are_refused(server: tm.Server) -> None:
    before = refused_peers(server)
    with stranger(server) as honest, stranger(server) as attacker:
        heard = Heard(honest, f"{SCENE}/**")
        held = attacker.declare_subscriber(f"tensormass/local/{'x' * 60_000}/frame", IGNORE)
        wait_for("the end of the connection", lambda: refused_peers(server) > before)
        heard.keys.clear()
        wait_for("frames of an honest client", lambda: f"{SCENE}/frame" in heard.keys)
        del held


class Meddler:
    """Between a client of zenoh and the daemon: passes on what they send, or stops to read, or sends more."""

    def __init__(self, server: tm.Server) -> None:
        host, port = server.version().zenoh_locator.removeprefix("tcp/").split(":")
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._daemon = socket.socket()
        self._daemon.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self._daemon.connect((host, int(port)))
        self._stop = threading.Event()
        self.last_frame = b""
        locator = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        up = threading.Thread(target=self._pass_up, daemon=True)
        up.start()
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [locator],
            "scouting/multicast/enabled": False,
            "transport/shared_memory/enabled": False,
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)

    def stop_reading(self) -> None:
        self._stop.set()

    def send(self, batch: bytes) -> None:
        self._daemon.sendall(len(batch).to_bytes(2, "little") + batch)

    def was_closed(self) -> bool:
        """Whether the daemon ends the connection."""
        with contextlib.suppress(ConnectionResetError):
            while self._daemon.recv(1 << 16):
                pass
        return True

    def close(self) -> None:
        self._daemon.close()
        self._client.close()
        self._listener.close()
        with contextlib.suppress(zenoh.ZError):  # its connection is gone
            self.session.close()

    def _pass_up(self) -> None:
        self._client, _ = self._listener.accept()
        threading.Thread(target=self._pass_down, daemon=True).start()
        file = self._client.makefile("rb")
        try:
            while len(size := file.read(2)) == 2:
                batch = file.read(int.from_bytes(size, "little"))
                self._daemon.sendall(size + batch)
                if batch[0] & 0x1F == FRAME_ID:
                    self.last_frame = batch
        except OSError:
            pass

    def _pass_down(self) -> None:
        try:
            while not self._stop.is_set() and (data := self._daemon.recv(4096)):
                self._client.sendall(data)
        except OSError:
            pass


#: Ids and flags of zenoh's messages (zenoh-protocol, network/mod.rs and transport/mod.rs).
FRAME_ID, DECLARE_ID, KEY_ID, HAS_SUFFIX, HAS_EXTENSION, HAS_VALUE = 0x05, 0x1E, 0x00, 0x20, 0x80, 0x20


def number(value: int) -> bytes:
    """An integer of variable length, as zenoh writes it."""
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def end_of_number(data: bytes, at: int) -> int:
    while data[at] & 0x80:
        at += 1
    return at + 1


def next_frame(before: bytes, messages: bytes) -> bytes:
    """A frame after `before`: its header, the next sequence number and its extensions."""
    end = end_of_number(before, 1)
    sequence = sum((byte & 0x7F) << 7 * i for i, byte in enumerate(before[1:end]))
    at = end
    more = bool(before[0] & HAS_EXTENSION)
    while more:
        more = bool(before[at] & HAS_EXTENSION)
        assert before[at] & 0x60 in (0, HAS_VALUE)
        at = end_of_number(before, at + 1) if before[at] & HAS_VALUE else at + 1
    return before[:1] + number(sequence + 1) + before[end:at] + messages


@pytest.mark.attack("a client of zenoh gives numbers to 600 keys", "kept: up to 65,535 of 64 KiB each a connection")
def test_declared_keys_are_bounded(server: tm.Server) -> None:
    before = refused_peers(server)
    meddler = Meddler(server)
    try:
        held = meddler.session.declare_subscriber(f"{SCENE}/frame", IGNORE)
        wait_for("the declaration", lambda: meddler.last_frame != b"")
        meddler.stop_reading()
        messages = b""
        for i in range(600):
            key = f"tensormass/local/k{i}/frame".encode()
            declaration = bytes([KEY_ID | HAS_SUFFIX]) + number(1000 + i) + number(0) + number(len(key)) + key
            messages += bytes([DECLARE_ID]) + declaration
        # A frame that the client sends in between has this one's number. The daemon then drops this one as repeated.
        for _ in range(10):
            with contextlib.suppress(OSError):
                meddler.send(next_frame(meddler.last_frame, messages))
            with contextlib.suppress(AssertionError):
                wait_for("the refusal", lambda: refused_peers(server) > before, DEADLINE_S / 10)
                break
        assert refused_peers(server) > before
        assert meddler.was_closed()
        del held
    finally:
        meddler.close()


@pytest.mark.attack("six clients of zenoh ask and do not read", "no pose reached a scene for 10 s, again and again")
def test_who_asks_and_does_not_read_delays_nobody(
    server: tm.Server, record_property: Callable[[str, object], None]
) -> None:
    before = refused_peers(server)
    meddlers = [Meddler(server) for _ in range(6)]
    ended = threading.Event()
    asked = dict.fromkeys(meddlers, 0)

    def ask(meddler: Meddler) -> None:
        with contextlib.suppress(zenoh.ZError):
            while not ended.is_set():
                asked[meddler] += 1
                meddler.session.get("tensormass/local/**", IGNORE, congestion_control=zenoh.CongestionControl.BLOCK)

    threads = [threading.Thread(target=ask, args=(meddler,), daemon=True) for meddler in meddlers]
    answers: list[float] = []  # when a new pose was answered
    counting_s = 0.0  # the longest that the daemon took to tell its counts: a machine that is busy delays both
    with stranger(server) as hand:
        heard = Heard(hand, FEEDBACK)
        sequence = PoseSequence()
        sequence.last = seen = 5_000_000

        def answered_more_than(count: int) -> bool:
            nonlocal seen
            put(hand, POSE, sequence.next(IN_AIR_M, None).SerializeToString())
            if heard.answered > seen:
                seen = heard.answered
                answers.append(time.monotonic())
            return len(answers) > count

        def is_cut() -> bool:
            nonlocal counting_s
            if not answered_more_than(0):
                return False
            begin = time.monotonic()
            refused = refused_peers(server)
            counting_s = max(counting_s, time.monotonic() - begin)
            return refused >= before + len(meddlers)

        try:
            wait_for("the hand", lambda: answered_more_than(0))
            for meddler, thread in zip(meddlers, threads, strict=True):
                meddler.stop_reading()
                thread.start()
            begin = time.monotonic()
            try:
                wait_for("the end of those who ask", is_cut)
            except AssertionError:
                allowed = REQUESTS_AT_ONCE + REQUESTS_PER_S * (time.monotonic() - begin)
                if min(asked.values()) < allowed and os.getloadavg()[0] > (os.cpu_count() or 1):
                    pytest.skip(f"this machine asks {min(asked.values())} times in the time for {allowed:.0f}")
                raise
            last = len(answers)
            wait_for("the hand's poses", lambda: answered_more_than(last))
        finally:
            ended.set()
            for meddler in meddlers:
                meddler.close()
    longest_s = max(after - one for one, after in itertools.pairwise(answers))
    record_property("now", f"disconnected; poses waited for {longest_s:.2f} s at most")
    for thread in threads:
        thread.join(DEADLINE_S)
    assert longest_s < 4 + counting_s


@pytest.mark.attack("forged streams and large messages over zenoh are dropped", "and nothing counted them")
@pytest.mark.parametrize(
    ("reason", "key", "payload"),
    [("access", FEEDBACK, b"forged"), ("message_size", POSE, bytes(MIB))],
    ids=["access", "message_size"],
)
def test_what_zenoh_drops_is_counted(server: tm.Server, reason: str, key: str, payload: bytes) -> None:
    def refused() -> float:
        return count_of(server, "tensormass_bus_refusals_total", transport="zenoh", reason=reason)

    with stranger(server) as attacker:
        before = refused()

        def is_counted() -> bool:
            put(attacker, key, payload)
            return refused() > before

        wait_for(f"a count of {reason}", is_counted)
