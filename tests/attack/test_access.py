"""Keys and roles: every role × call × key × transport, removed and expired clients, and downgrades to plain text.

The table is server/access/rules.h. It is read here as text, so that nothing of the daemon says what is expected.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import socket
import ssl
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path

import grpc
import pytest
import zenoh
import zmq

pytest.importorskip("cryptography", reason="needs the extra `keys`")

from attack_parts import DEADLINE_S, IN_AIR_M, wait_for
from keyed_parts import OWN, SCENES, Guarded, guarded

import tensormass as tm
from tensormass._shared.client_keys import ClientKeys, date_of, write_secret
from tensormass._src.poses import PoseSequence
from tensormass._src.streams import Transport
from tensormass.v1 import control_pb2
from tensormass_tools.keys.folder import ROLES, KeyFolder

RULES = (Path(__file__).parents[2] / "server/access/rules.h").read_text()
SERVICE = control_pb2.DESCRIPTOR.services_by_name["Control"]
#: docs/security.md promises so. A daemon looks twice a second.
NOTICED_WITHIN_S = 5.0


def rows(table: str) -> dict[str, dict[str, str]]:
    """Reads a table of rules.h: what -> role -> NO, TOOL, SCENE or ALL."""
    body = RULES.split(f"inline constexpr auto {table} =")[1].split("});")[0]
    lines = re.findall(r'\{"([^"]+)",\s*\{([A-Z, ]+)\}\}', body)
    return {what: dict(zip(ROLES, reach.replace(" ", "").split(","), strict=True)) for what, reach in lines}


CALLS, STREAMS, PUTS = rows("kCalls"), rows("kStreams"), rows("kPuts")


def allowed(reach: str, scene: str, tool: str) -> bool:
    own_scene, own_tool = OWN.split("/")
    return reach == "ALL" or (scene == own_scene and (reach == "SCENE" or (reach == "TOOL" and tool == own_tool)))


def test_the_table_has_every_call_and_key_and_no_other() -> None:
    assert set(CALLS) == {f"{SERVICE.full_name}/{method.name}" for method in SERVICE.methods}
    protocol = (Path(__file__).parents[2] / "docs/protocol.md").read_text()
    keys = dict(re.findall(r"tensormass/<server>/<scene>/(\S+) +\w+ +(server -> client|client -> server)", protocol))
    keys = {key.replace("<t>", "*"): way for key, way in keys.items()}
    assert set(STREAMS) == {key for key, way in keys.items() if way == "server -> client"}
    assert set(PUTS) == {key for key, way in keys.items() if way == "client -> server"}
    assert all(set(row.values()) <= {"NO", "TOOL", "SCENE", "ALL"} for row in (CALLS | STREAMS | PUTS).values())


def test_rights_that_no_role_but_the_operators_may_have() -> None:
    """A second look at the table: what changes a scene is the operators' alone, and a pose is a hand's, too."""
    reads = {"GetVersion", "ListScenes", "GetStatus", "GetTopology", "GetFrame", "GetFeedback", "GetPositions"}
    reads |= {"GetFields", "RecordScene", "SnapshotScene", "GetMetrics"}
    for call, row in CALLS.items():
        assert row["operator"] == "ALL"
        if call.split("/")[1] not in reads:
            assert {row[role] for role in ROLES if role != "operator"} == {"NO"}, call
    assert PUTS["tool/*/pose"] == dict(zip(ROLES, ("ALL", "TOOL", "NO", "NO", "NO"), strict=True))


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    with guarded(tmp_path_factory.mktemp("access")) as daemon:
        yield daemon


def request_of(method: str, scene: str, tool: str) -> object:
    """A request that its call refuses or answers without doing anything, once the role is let in."""
    kind = next(each for each in SERVICE.methods if each.name == method).input_type
    request = getattr(control_pb2, kind.name)()
    if "scene" in kind.fields_by_name and kind.fields_by_name["scene"].message_type is None:
        # Operators may make every call, and must not change the scenes here.
        changes = method not in {"GetStatus", "GetTopology", "GetFrame", "GetFeedback", "GetPositions", "GetFields"}
        request.scene = "none" if changes else scene
    if "tool" in kind.fields_by_name:
        request.tool = tool
    return request


@pytest.mark.parametrize("role", ROLES)
def test_every_call_is_let_in_or_refused_by_its_role(one: Guarded, role: str) -> None:
    with one.stub(one.keys[role]) as stub:
        for full, scene in itertools.product(CALLS, SCENES):
            method = full.split("/")[1]
            request = request_of(method, scene, "probe")
            named = getattr(request, "scene", "")
            let_in = allowed(CALLS[full][role], named if isinstance(named, str) else "", "probe")
            call = getattr(stub, method)
            try:
                answer = call(request, timeout=DEADLINE_S)
                if hasattr(answer, "__next__"):
                    list(answer)
                code, details = grpc.StatusCode.OK, ""
            except grpc.RpcError as error:
                code, details = error.code(), str(error.details())
            assert (code != grpc.StatusCode.PERMISSION_DENIED) == let_in, (role, method, scene, code, details)
            if not let_in:
                assert f"{method} is not for the role {role}" in details
                assert "docs/security.md" in details


def test_refusals_by_a_role_are_counted(one: Guarded) -> None:
    def refused() -> int:
        with one.stub(one.keys["metrics"]) as stub:
            text = stub.GetMetrics(control_pb2.GetMetricsRequest(), timeout=DEADLINE_S).text
        return int(re.findall(r'^tensormass_refusals_total{limit="role"} (\d+)$', text, re.MULTILINE)[0])

    before = refused()
    with one.stub(one.keys["viewer"]) as stub, pytest.raises(grpc.RpcError, match="not for the role viewer"):
        stub.GetMetrics(control_pb2.GetMetricsRequest(), timeout=DEADLINE_S)
    assert refused() == before + 1


def key_of(what: str, scene: str) -> str:
    return f"tensormass/local/{scene}/{what.replace('*', 'probe')}"


@pytest.mark.parametrize("role", ROLES)
def test_every_stream_over_zeromq(one: Guarded, role: str) -> None:
    for what, scene in itertools.product(STREAMS, SCENES):
        let_in = allowed(STREAMS[what][role], scene, "probe")
        key = key_of(what, scene).encode() + b"\0"
        before = one.malformed()
        with one.socket(zmq.SUB, one.keys[role]) as subscriber:
            subscriber.setsockopt(zmq.RECONNECT_IVL, -1)
            subscriber.subscribe(key)
            with subscriber.get_monitor_socket(zmq.EVENT_DISCONNECTED) as cut:
                subscriber.connect(one.version.zeromq_publish_endpoint)
                if let_in:
                    assert subscriber.recv().startswith(key)
                else:  # single messages may come before the cut (docs/security.md)
                    wait_for("the refusal", partial(one.refused_since, before))
                    assert cut.poll(int(1000 * DEADLINE_S)), (role, what, scene)


@pytest.mark.parametrize("role", ROLES)
def test_every_stream_over_zenoh(one: Guarded, role: str) -> None:
    heard: dict[str, set[str]] = {"role": set(), "operator": set()}

    def take(who: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: heard[who].add(str(sample.key_expr))

    wanted = {key_of(what, scene): allowed(STREAMS[what][role], scene, "probe") for what in STREAMS for scene in SCENES}
    with one.zenoh(one.keys[role]) as session, one.zenoh(one.keys["operator"]) as operator:
        subscribers = [
            each.declare_subscriber("tensormass/local/**", zenoh.handlers.Callback(take(who), indirect=False))
            for who, each in (("role", session), ("operator", operator))
        ]
        retained = ("topology", "changes", "events")
        moving = {key for key in wanted if not key.endswith(retained)}
        wait_for("the streams", lambda: heard["operator"] >= moving)
        wait_for("those of the role", lambda: heard["role"] >= {key for key in moving if wanted[key]})
        heard["operator"].clear()
        wait_for("the streams again", lambda: heard["operator"] >= moving)
        assert heard["role"] <= {key for key, let_in in wanted.items() if let_in}
        for key in (key_of(what, scene) for what in retained for scene in SCENES):
            replies = [reply for reply in session.get(key, timeout=2.0) if reply.ok is not None]
            assert bool(replies) == wanted[key], (role, key)
        del subscribers


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("transport", ["zeromq", "zenoh"])
@pytest.mark.parametrize("role", ROLES)
def test_every_pose(one: Guarded, role: str, transport: Transport, scene: str) -> None:
    handle, key = one.server.scene(scene), key_of("tool/*/pose", scene)
    sequence = PoseSequence()
    before = one.malformed()

    def answers(client_id: int) -> bool:
        return handle.feedback("probe").client_id == client_id

    with contextlib.ExitStack() as parts:
        if transport == "zeromq":
            pusher = parts.enter_context(one.socket(zmq.PUSH, one.keys[role]))
            pusher.connect(one.version.zeromq_pose_endpoint)
        else:
            session = parts.enter_context(one.zenoh(one.keys[role]))

        def send() -> None:
            payload = sequence.next(IN_AIR_M, None).SerializeToString()
            if transport == "zeromq":
                pusher.send(key.encode() + b"\0" + payload)
            else:
                session.put(key, payload)

        def moves() -> bool:
            send()
            return answers(sequence.client_id)

        if allowed(PUTS["tool/*/pose"][role], scene, "probe"):
            wait_for("the pose", moves)
            return
        stream = parts.enter_context(handle.tool_stream("probe", transport))
        for _ in range(20):
            send()
        if transport == "zeromq":
            wait_for("the refusal", lambda: one.malformed() >= before + 20)

        def operator_moves() -> bool:
            assert not moves(), (role, scene)
            stream.send(IN_AIR_M)
            return answers(stream.client_id)

        wait_for("the operator's pose", operator_moves)


def test_a_recorder_does_not_reset_the_scene(one: Guarded) -> None:
    with one.stub(one.keys["recorder"]) as stub:
        records = stub.RecordScene(control_pb2.RecordSceneRequest(scene="a", reset=True), timeout=DEADLINE_S)
        with pytest.raises(grpc.RpcError, match="ResetScene is not for the role recorder"):
            next(records)
        records = stub.RecordScene(control_pb2.RecordSceneRequest(scene="a"), timeout=DEADLINE_S)
        assert next(records).HasField("start")
        records.cancel()


def test_plain_text_is_refused_everywhere(one: Guarded) -> None:
    before = one.malformed()
    with pytest.raises(tm.UnavailableError, match="If it was started with --keys, give your file of keys"):
        tm.connect(one.server.address, timeout_s=1)
    wait_for("gRPC's refusal", lambda: one.malformed() > before)
    before = one.malformed()
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.setsockopt(zmq.LINGER, 0)
        subscriber.subscribe(key_of("frame", "a").encode() + b"\0")
        subscriber.connect(one.version.zeromq_publish_endpoint)
        wait_for("ZeroMQ's refusal", lambda: one.malformed() > before)
        assert subscriber.poll(0) == 0
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [one.version.zenoh_locator.replace("tls/", "tcp/")],
        "connect/timeout_ms": 1000,
        "scouting/multicast/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    with pytest.raises(zenoh.ZError):
        zenoh.open(config).close()


def test_a_daemon_without_keys_refuses_keys(one: Guarded) -> None:
    with (
        tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as plain,
        pytest.raises(tm.UnavailableError, match=r"takes the keys .*Is it started, with --keys"),
    ):
        tm.connect(plain.address, keys=one.keys["viewer"], timeout_s=1)


def test_keys_of_strangers_are_refused(one: Guarded, tmp_path: Path) -> None:
    other = KeyFolder(tmp_path / "other")
    other.init([], 30)
    stranger = other.add("a-operator", "operator")
    with pytest.raises(tm.UnavailableError, match=r"no daemon on .* takes the keys .*a-operator"):
        tm.connect(one.server.address, keys=stranger, timeout_s=1)
    before = one.malformed()
    with one.socket(zmq.SUB, stranger) as subscriber:
        subscriber.subscribe(key_of("frame", "a").encode() + b"\0")
        subscriber.connect(one.version.zeromq_publish_endpoint)
        wait_for("the refusal", lambda: one.malformed() > before)
        assert subscriber.poll(0) == 0
    try:
        with one.zenoh(stranger, connect_s=1.0) as session:
            assert not list(session.get(key_of("topology", "a"), timeout=1.0))
    except zenoh.ZError:
        pass  # no session at all


def follow(daemon: Guarded, keys: ClientKeys, parts: contextlib.ExitStack) -> Callable[[], list[str]]:
    """Uses all transports with a client's keys. Returns what says which of them still bring news."""
    stub = parts.enter_context(daemon.stub(keys))
    subscriber = parts.enter_context(daemon.socket(zmq.SUB, keys))
    subscriber.subscribe(key_of("frame", "a").encode() + b"\0")
    subscriber.connect(daemon.version.zeromq_publish_endpoint)
    session = parts.enter_context(daemon.zenoh(keys))
    over_zenoh: list[bool] = []

    def take(_sample: zenoh.Sample) -> None:
        over_zenoh.append(True)

    parts.callback(
        session.declare_subscriber(key_of("frame", "a"), zenoh.handlers.Callback(take, indirect=False)).undeclare
    )

    def alive() -> list[str]:
        found = []
        with contextlib.suppress(grpc.RpcError):
            stub.GetStatus(control_pb2.GetStatusRequest(scene="a"), timeout=1)
            found.append("gRPC")
        while subscriber.poll(0):
            subscriber.recv()
        over_zenoh.clear()
        deadline = time.monotonic() + 0.3
        while time.monotonic() < deadline and not (over_zenoh and subscriber.poll(0)):
            time.sleep(0.005)
        return found + (["ZeroMQ"] if subscriber.poll(0) else []) + (["zenoh"] if over_zenoh else [])

    wait_for("all transports", lambda: len(alive()) == 3)
    return alive


def noticed(daemon: Guarded) -> float:
    """Returns when the daemon last noticed that other keys count [s since 1970]."""
    lines = [json.loads(line) for line in daemon.log().splitlines() if '"other keys count"' in line]
    return datetime.fromisoformat(lines[-1]["time"]).timestamp()


@pytest.mark.attack("a client whose key was removed", "nobody had keys")
def test_a_removed_client_is_cut_and_the_others_go_on(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    with guarded(tmp_path) as daemon, contextlib.ExitStack() as parts:
        scene = daemon.server.scene("a")
        removed = follow(daemon, daemon.keys["viewer"], parts)
        stays = follow(daemon, daemon.keys["recorder"], parts)
        begin = time.time()
        daemon.folder.remove("a-viewer")
        step = scene.status().step
        wait_for("the cut", lambda: removed() == [])
        took = time.time() - begin
        assert noticed(daemon) - begin < NOTICED_WITHIN_S
        wait_for("the steps", lambda: scene.status().step > step)
        wait_for("the others", lambda: len(stays()) == 3)
        assert removed() == []
        record_property("now", f"cut on all transports after {took:.1f} s")
        with pytest.raises(tm.UnavailableError, match="may have been removed"):
            tm.connect(daemon.server.address, keys=daemon.keys["viewer"], timeout_s=1)
        # The same name again is another client.
        again = daemon.folder.add("a-viewer", "viewer")
        wait_for("the new keys", lambda: connects(daemon, again))
        assert not connects(daemon, daemon.keys["viewer"])


def connects(daemon: Guarded, keys: ClientKeys) -> bool:
    with contextlib.suppress(tm.TensormassError):
        tm.connect(daemon.server.address, keys=keys, timeout_s=1).close()
        return True
    return False


def test_another_role_reaches_open_subscriptions(tmp_path: Path) -> None:
    with guarded(tmp_path) as daemon, daemon.socket(zmq.SUB, daemon.keys["viewer"]) as subscriber:
        subscriber.subscribe(key_of("frame", "a").encode() + b"\0")
        with subscriber.get_monitor_socket(zmq.EVENT_DISCONNECTED) as cut:
            subscriber.connect(daemon.version.zeromq_publish_endpoint)
            subscriber.recv()
            content = daemon.entries()
            for client in content["clients"]:
                client["role"] = "metrics" if client["role"] == "viewer" else client["role"]
            write_secret(daemon.folder.path / "clients.json", content)
            assert cut.poll(int(1000 * DEADLINE_S))


def test_expired_keys_are_refused_also_without_the_list(tmp_path: Path) -> None:
    with guarded(tmp_path) as daemon, contextlib.ExitStack() as parts:
        short = daemon.folder.add("short", "viewer", days=60 / 86_400)
        wait_for("the new keys", lambda: connects(daemon, short))
        alive = follow(daemon, short, parts)
        (daemon.folder.path / "clients.json").unlink()
        time.sleep(max(0.0, short.expires_s - time.time()))
        wait_for("the cut", lambda: alive() == [])
        with daemon.stub(short) as stub, pytest.raises(grpc.RpcError):
            stub.GetVersion(control_pb2.GetVersionRequest(), timeout=1)
        with pytest.raises(tm.InvalidArgumentError, match=f"expired on {date_of(short.expires_s)}"):
            tm.connect(daemon.server.address, keys=short.path)
        daemon.server.version()  # the list before counts on


def test_an_unchanged_list_opens_nothing_again(tmp_path: Path) -> None:
    with guarded(tmp_path, "--log-level", "debug") as daemon:
        path, content = daemon.folder.path / "clients.json", daemon.entries()

        def reads() -> int:
            return daemon.log().count("the list of clients was read")

        with daemon.zenoh(daemon.keys["viewer"]) as session:
            (peer,) = session.info.routers_zid() + session.info.peers_zid()
            before = reads()
            write_secret(path, content)
            wait_for("the same list", lambda: reads() > before)
            path.write_text("{")  # broken: when the log tells, the same list was dealt with
            wait_for("the log", lambda: "the list of clients cannot be read" in daemon.log())
            assert session.info.routers_zid() + session.info.peers_zid() == [peer]
        assert "other keys count" not in daemon.log()
        content["clients"].pop()
        write_secret(path, content)
        wait_for("another list", lambda: "other keys count" in daemon.log())


def test_the_daemon_refuses_an_address_of_others_without_keys() -> None:
    for option, address in (("--control", "0.0.0.0:0"), ("--zeromq-publish", "tcp://0.0.0.0:*")):
        with pytest.raises(tm.UnavailableError) as refused:
            tm.launch(backend="cpu", options=(option, address))
        assert f"{option} {address}: other machines can reach this address" in str(refused.value)
        assert "tensormass keys init keys" in str(refused.value)


def test_half_a_handshake_holds_nothing(one: Guarded) -> None:
    host, port = one.server.address.rsplit(":", 1)
    before = one.malformed()
    with socket.create_connection((host, int(port))) as half:
        half.sendall(b"\x16\x03\x01\x02\x00" + b"\x01" * 64)
        wait_for("the end of its time", lambda: one.malformed() > before)
    one.server.version()


@contextlib.contextmanager
def connected(
    daemon: Guarded, keys: ClientKeys, newest: ssl.TLSVersion = ssl.TLSVersion.MAXIMUM_SUPPORTED
) -> Iterator[ssl.SSLSocket]:
    """A connection to the control plane with the keys of a client, without gRPC."""
    context = ssl.create_default_context(cadata=keys.authority)
    context.check_hostname = False
    context.set_alpn_protocols(["h2"])
    context.maximum_version = newest
    with tempfile.NamedTemporaryFile("w") as file:
        file.write(keys.certificate + keys.private_key)
        file.flush()
        context.load_cert_chain(file.name)
    host, port = daemon.server.address.rsplit(":", 1)
    with (
        socket.create_connection((host, int(port)), timeout=DEADLINE_S) as plain,
        context.wrap_socket(plain, server_hostname=host) as secure,
    ):
        yield secure


def test_older_tls_is_refused(one: Guarded) -> None:
    with connected(one, one.keys["viewer"]) as new:
        assert new.version() == "TLSv1.3"
    with (
        pytest.raises((ssl.SSLError, ConnectionError)),
        connected(one, one.keys["viewer"], newest=ssl.TLSVersion.TLSv1_2) as old,
    ):
        old.recv(1)


@pytest.mark.attack("one key opens connections without end", "512, which left none for other keys")
def test_connections_of_a_key_are_bounded(one: Guarded, record_property: Callable[[str, object], None]) -> None:
    limit = limit_of("server/core/http2_limits.h", "kMaxConnectionsPerKey")
    preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
    closed = 0
    with contextlib.ExitStack() as parts:
        for _ in range(limit + 8):
            attacker = parts.enter_context(connected(one, one.keys["viewer"]))
            try:
                attacker.sendall(preface)
                closed += attacker.recv(9) == b""
            except (ConnectionError, ssl.SSLError):
                closed += 1
        with one.stub(one.keys["operator"]) as stub:
            stub.GetVersion(control_pb2.GetVersionRequest(), timeout=DEADLINE_S)
    record_property("now", f"{limit}, other keys go on")
    assert closed == 8


@pytest.mark.attack("one key subscribes over many ZeroMQ connections", "64 subscriptions for each connection")
def test_subscriptions_of_a_key_are_bounded(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    limit, each = limit_of("server/core/bus_limits.h", "kMaxSubscriptionsPerKey"), 60
    with guarded(tmp_path) as one, contextlib.ExitStack() as parts:
        for first in range(0, limit + each, each):
            subscriber = parts.enter_context(one.socket(zmq.SUB, one.keys["viewer"]))
            subscriber.setsockopt(zmq.RECONNECT_IVL, -1)
            for number in range(first, first + each):
                subscriber.subscribe(f"tensormass/local/a/tool/{number}/feedback\0".encode())
            subscriber.connect(one.version.zeromq_publish_endpoint)
        wait_for("the refusal", lambda: "more than kMaxSubscriptionsPerKey subscriptions of its key" in one.log())
        with one.socket(zmq.SUB, one.keys["operator"]) as honest:
            honest.subscribe(key_of("frame", "a").encode() + b"\0")
            honest.connect(one.version.zeromq_publish_endpoint)
            honest.recv()
    record_property("now", f"{limit} for each key")


def limit_of(path: str, name: str) -> int:
    found = re.search(rf"{name} = (\d+);", (Path(__file__).parents[2] / path).read_text())
    assert found is not None
    return int(found[1])
