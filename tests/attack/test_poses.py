"""Strangers that send poses: a hand keeps its sequences and its tool, and each is told whose the tool is."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import zmq
from attack_parts import IN_AIR_M, IN_TISSUE_M, attacked, block, count_of, wait_for

import tensormass as tm
from tensormass.v1 import scene_pb2, stream_pb2

POSE = b"tensormass/local/block/tool/probe/pose\0"
FOREVER_S = 3600.0


@pytest.fixture
def scene() -> Iterator[tm.SceneHandle]:
    with attacked() as server:
        yield server.load(block())


class Stranger:
    """Sends ToolPose as docs/protocol.md says, without the SDK."""

    def __init__(self, scene: tm.SceneHandle, context: zmq.Context[zmq.Socket[bytes]], **fields: int | float) -> None:
        self._socket = context.socket(zmq.PUSH)
        self._socket.connect(scene._connection.data_plane._version.zeromq_pose_endpoint)
        self._fields = fields

    def send(self, sequence: int, position_m: tuple[float, float, float] = IN_TISSUE_M) -> None:
        pose = stream_pb2.ToolPose(
            sequence=sequence, position_m=scene_pb2.Vector3(**dict(zip("xyz", position_m, strict=True)))
        )
        for name, value in self._fields.items():
            setattr(pose, name, value)
        self._socket.send(POSE + pose.SerializeToString())

    def flood(self, count: int) -> None:
        message = POSE + stream_pb2.ToolPose(position_m=scene_pb2.Vector3()).SerializeToString()
        for _ in range(count):
            self._socket.send(message)


@pytest.fixture
def stranger(scene: tm.SceneHandle) -> Iterator[Callable[..., Stranger]]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield lambda **fields: Stranger(scene, context, **fields)
    context.destroy(linger=0)


@pytest.mark.attack("one pose with sequence 2^64 - 1 under a hand's public client id", "the hand was locked out")
@pytest.mark.parametrize("valid_for_s", [None, FOREVER_S])
def test_nobody_uses_up_the_sequences_of_a_hand(
    scene: tm.SceneHandle, stranger: Callable[..., Stranger], valid_for_s: float | None
) -> None:
    with scene.tool_stream("probe", valid_for_s=valid_for_s) as hand:
        hand.send(IN_AIR_M)
        wait_for("the hand's pose", lambda: scene.feedback("probe").pose_sequence == 1)
        public = scene.feedback("probe").client_id
        assert public == hand.client_id
        before = scene.status()
        stranger(client_id=public).send(2**64 - 1)
        wait_for(
            "the stranger's pose",
            lambda: (
                scene.status().poses_received + scene.status().poses_rejected
                > before.poses_received + before.poses_rejected
            ),
        )
        received = scene.status().poses_received
        hand.send(IN_AIR_M)
        wait_for("the hand's next pose", lambda: scene.status().poses_received > received)
        wait_for("its answer", lambda: scene.feedback("probe").pose_sequence == hand.last_sequence)


@pytest.mark.attack("feedback is read for what only a hand should know", "there was no secret")
def test_no_message_to_clients_has_a_session() -> None:
    fields = {field.name for field in stream_pb2.ToolFeedback.DESCRIPTOR.fields}
    fields |= {field.name for field in stream_pb2.SceneStatus.DESCRIPTOR.fields}
    assert "client_id" in fields
    assert "session" not in fields


@pytest.mark.attack("two clients pose one tool", "both moved it, neither was told")
@pytest.mark.parametrize(
    "fields", [{}, {"client_id": 5}, {"client_id": 5, "session": 6}, {"session": 6, "valid_for_s": 5.0}], ids=str
)
def test_a_hand_keeps_the_tool_that_it_claims(
    scene: tm.SceneHandle, stranger: Callable[..., Stranger], fields: dict[str, int | float]
) -> None:
    with scene.tool_stream("probe", valid_for_s=FOREVER_S) as hand:
        hand.send(IN_AIR_M)
        wait_for("the hand's claim", lambda: scene.feedback("probe").claimed)
        other = stranger(**fields)
        other.send(2)
        wait_for("the stranger's pose", lambda: scene.status().poses_rejected == 1)
        felt = scene.feedback("probe")
        assert (felt.claimed, felt.client_id) == (True, hand.client_id), "the stranger is told whose the tool is"
        assert felt.position_m == pytest.approx(IN_AIR_M)


def test_clients_without_a_session_move_a_free_tool(scene: tm.SceneHandle, stranger: Callable[..., Stranger]) -> None:
    one, other = stranger(client_id=5), stranger(client_id=6, valid_for_s=FOREVER_S)
    for sequence in (1, 2, 3):
        one.send(sequence, IN_AIR_M)
        wait_for("the first client", lambda: scene.feedback("probe").client_id == 5)
        other.send(sequence, IN_AIR_M)
        wait_for("the other client", lambda: scene.feedback("probe").client_id == 6)
    assert not scene.feedback("probe").claimed
    assert scene.status().poses_rejected == 0


def test_a_hand_hands_over(scene: tm.SceneHandle, stranger: Callable[..., Stranger]) -> None:
    stranger(client_id=5, session=6, valid_for_s=FOREVER_S).send(1, IN_AIR_M)
    wait_for("the claim", lambda: scene.feedback("probe").claimed)
    stranger(client_id=5, session=6).send(2, IN_AIR_M)
    wait_for("its end", lambda: not scene.feedback("probe").claimed)
    with scene.tool_stream("probe", valid_for_s=FOREVER_S) as hand:
        hand.send(IN_AIR_M)
        wait_for("the other claim", lambda: scene.feedback("probe").claimed)
        assert scene.feedback("probe").client_id == hand.client_id


def test_move_tool_takes_a_claimed_tool_over(scene: tm.SceneHandle) -> None:
    with scene.tool_stream("probe", valid_for_s=FOREVER_S) as hand:
        hand.send(IN_AIR_M)
        wait_for("the hand's claim", lambda: scene.feedback("probe").claimed)
        scene.move_tool("probe", IN_TISSUE_M)
        wait_for("the operator's pose", lambda: scene.feedback("probe").client_id != hand.client_id)
        assert not scene.feedback("probe").claimed
        rejected = scene.status().poses_rejected
        hand.send(IN_AIR_M)
        wait_for("the refusal", lambda: scene.status().poses_rejected == rejected + 1)
        assert scene.feedback("probe").client_id != hand.client_id


@pytest.mark.attack("a hand dies in a scene slower than real time", "retired after 11 s for a pose valid for 0.5 s")
def test_a_dead_hand_is_retired_by_real_time(record_property: Callable[[str, object], None]) -> None:
    slow = block()
    # A tenth of real time, on any machine.
    slow.message.stepping.rate_hz, slow.message.stepping.dt_s = 200, 5e-4
    with attacked() as server:
        scene = server.load(slow)
        with scene.tool_stream("probe", valid_for_s=0.5) as hand:
            hand.send(IN_AIR_M)
        # A frame of each step: where the pose was taken, and where the tool was retired.
        taken = None
        for frame in scene.frames():
            tool = frame.tools["probe"]
            if taken is None and tool.pose_sequence == 1:
                taken = frame.step
            if tool.retired:
                break
        assert taken is not None
        simulated_s = (frame.step - taken) * 5e-4
        record_property("now", f"after {10 * simulated_s:.1f} s, with 1 s for the force to fade")
        assert simulated_s < 0.5


@pytest.mark.attack("one client sends poses as fast as it can", "all were parsed, on one thread for all clients")
def test_a_flood_of_poses_is_cut_to_a_rate(scene: tm.SceneHandle, stranger: Callable[..., Stranger]) -> None:
    server = tm.connect(scene._connection.address)
    flooder = stranger(client_id=5)

    def is_cut() -> bool:
        flooder.flood(20_000)
        return count_of(server, "tensormass_bus_refusals_total", transport="zeromq", reason="pose_rate") > 0

    wait_for("poses beyond the rate", is_cut)
    with scene.tool_stream("probe", valid_for_s=FOREVER_S) as hand:
        hand.send(IN_AIR_M)
        wait_for("an honest hand", lambda: scene.feedback("probe").client_id == hand.client_id)
    server.close()
