"""The JSON of the WebSocket is what gateway.proto says: each message, each field, and what the gateway refuses.

gateway_parts.py checks every text message that the gateway sends in any test.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import as_described, browse, load, options, publish
from google.protobuf import json_format
from google.protobuf.message import Message

from tensormass.v1 import finding_pb2, gateway_pb2
from tensormass_gateway.choice import Choice, Codec
from tensormass_gateway.control import Action
from tensormass_gateway.gateway import serve
from tensormass_gateway.messages import read, result_to_json, to_json
from tensormass_gateway.outbox import Stream
from tensormass_gateway.requests import ProtocolError

# A valid message of a viewer for each type, with all fields. One with a frame on the way may send them in this order.
VALID: dict[str, dict[str, Any]] = {
    "watch": {"scene": "liver"},
    "clock": {"client_time_ms": 12.5},
    "frames": {"codec": "delta", "rate_hz": 30.0, "normals": True, "detail": 0.5},
    "field": {"name": "von_mises"},
    "pose": {"tool": "probe", "position_m": [0.0, 1.0, -2.5], "orientation": [1.0, 0.0, 0.0, 0.0], "level": 0.5},
    "control": {
        "id": 7,
        "action": "adjust",
        "scene": "liver",
        "steps": 3,
        "lockstep": True,
        "time_s": 1.5,
        "speed": 2.0,
        "changes": {
            "gravity_m_per_s2": {"x": 0.5, "y": 1.0, "z": -9.81},
            "bodies": [{"body": "a", "stiffness_factor": 2.0}],
        },
        "edit": {
            "add_tools": [{"name": "hook", "capsule": {"radius_m": 0.01, "length_m": 0.5}, "position_m": {"z": 1.0}}],
            "remove_tools": ["probe"],
            "add_attachments": [{"name": "clip", "body": "a", "other": "a", "rest_lengths_m": [0.5, 1.0]}],
            "remove_attachments": ["ligament"],
        },
    },
    "ack": {"stream": "frame", "keyframe": 1},
}
ALL = gateway_pb2.ViewerMessage()
FIELDS = [(kind, field) for kind, fields in VALID.items() for field in fields]


def test_the_valid_messages_are_all_messages_with_all_fields() -> None:
    assert VALID.keys() == set(ALL.DESCRIPTOR.fields_by_name)
    for kind, fields in VALID.items():
        assert list(fields) == [field.name for field in getattr(ALL, kind).DESCRIPTOR.fields], kind


@pytest.mark.parametrize("kind", VALID)
def test_the_mapping_reads_a_message_as_the_gateway_does(kind: str) -> None:
    message = json_format.ParseDict({kind: VALID[kind]}, gateway_pb2.ViewerMessage())
    assert read({"type": kind, **VALID[kind]}) == message
    assert json_format.MessageToDict(message, preserving_proto_field_name=True)[kind] == VALID[kind]


@asynchronous
async def test_each_valid_message_is_taken(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver", choice="codec=delta") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, topology, 1)
            await page.binary()
            await page.send(type="ack", **VALID["ack"])
            for kind in sorted(VALID.keys() - {"ack", "watch"}):
                await page.send(type=kind, **VALID[kind])
            assert (await page.text(lambda message: message["type"] == "result"))["error"] == ""
            await page.send(type="watch", **VALID["watch"])
            await page.send(type="clock", client_time_ms=1)
            await page.text(lambda message: message["type"] == "clock" and message["client_time_ms"] == 1)
            (changed,) = [sent for sent in daemon.commands if sent.DESCRIPTOR.name == "AdjustSceneRequest"]
            assert json_format.MessageToDict(changed, preserving_proto_field_name=True) == {
                "scene": "liver",
                "changes": VALID["control"]["changes"],
            }


@pytest.mark.parametrize(("kind", "field"), FIELDS)
@asynchronous
async def test_a_field_of_another_kind_is_refused(viewer: Path, kind: str, field: str) -> None:
    wrong = {"type": kind, **VALID[kind], field: [{"wrong": 1}]}
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, topology, 1)
            await page.binary()
            await page.send(**wrong)
            if kind == "frames" or field == "keyframe":  # says why, and goes on
                answer = await page.text(lambda message: message["type"] == "frames")
                assert field in answer["error"]
            else:
                code, reason = await page.closed()
                assert code == 1008
                named = {"stream": "unknown", "tool": "unknown", "name": "unknown", "scene": "unknown"}
                expected = "a scene's name" if (kind, field) == ("control", "scene") else named.get(field, field)
                assert expected in reason


@pytest.mark.parametrize("kind", sorted(VALID.keys() - {"frames", "control"}))
@asynchronous
async def test_fields_of_tomorrow_are_passed_over(viewer: Path, kind: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver", choice="codec=delta") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, topology, 1)
            await page.binary()
            await page.send(**{"type": kind, **VALID[kind], "mood": {"good": [1]}})
            await page.send(type="clock", client_time_ms=1)
            await page.text(lambda message: message["type"] == "clock" and message["client_time_ms"] == 1)


@asynchronous
async def test_half_a_character_is_answered_like_any_other_mistake(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        topology = load(daemon)
        async with browse(gateway, "liver") as page:
            await page.take(Stream.TOPOLOGY)
            await daemon.wait_subscribed("liver", "frame")
            await publish(daemon, topology, 1)
            await page.binary()
            await page.send(type="ack", stream="frame", keyframe="\ud800")
            answer = await page.text(lambda message: message["type"] == "frames")
            assert answer["error"].startswith(r"acknowledged keyframe \ud800, but no keyframes were sent")
            await page.send(type="frames", codec="\ud800")
            answer = await page.text(lambda message: message["type"] == "frames")
            assert answer["error"].startswith(r"codec '\ud800' is unknown")


@asynchronous
async def test_a_choice_of_tomorrow_is_answered_and_a_command_of_tomorrow_refused(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        await page.send(type="frames", mood="good")
        answer = await page.text(lambda message: message["type"] == "frames")
        assert answer["error"].startswith("'mood' is unknown")
        await page.send(**{"type": "control", **VALID["control"], "timeS": 1})
        assert await page.closed() == (1008, "a command has unknown fields")


@pytest.mark.parametrize(
    "fields",
    [
        {"type": "sudo"},
        {"type": "watch", "scene": 1},
        {"type": "watch", "scene": "\ud800"},
        {"type": "pose", "tool": []},
    ],
)
def test_what_the_mapping_does_not_take_is_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(ProtocolError, match="type or fields are unknown"):
        read(fields)


# --- what the gateway sends ------------------------------------------------------------------------------------------


SENT: list[Message] = [
    gateway_pb2.DaemonState(
        problem="gone",
        scenes=["liver"],
        operator=True,
        recording=gateway_pb2.ShownRecording(file="a.mcap", marks=[gateway_pb2.RecordingMark(kind="reset")]),
    ),
    gateway_pb2.DaemonState(),
    gateway_pb2.PlayHead(time_s=1.25, frame=75, playing=True, speed=2),
    gateway_pb2.PlayHead(),
    gateway_pb2.ClockReply(client_time_ms=1, gateway_time_ms=2.5, replaced=3),
    Choice().message("no such codec"),
    Choice(Codec.Q16, rate_hz=30, normals=True, detail=0.5).message(),
    gateway_pb2.CommandResult(id=7, action="pause", scene="liver"),
]


@pytest.mark.parametrize("message", SENT, ids=lambda message: message.DESCRIPTOR.name)
def test_the_mapping_reads_what_the_gateway_writes(message: Message) -> None:
    text = as_described(json.loads(json.dumps(to_json(message))))
    kind = text.pop("type")
    assert getattr(json_format.ParseDict({kind: text}, gateway_pb2.GatewayMessage()), kind) == message


def test_the_examples_are_of_all_messages() -> None:
    types = {to_json(message)["type"] for message in SENT}
    assert types == set(gateway_pb2.GatewayMessage.DESCRIPTOR.fields_by_name)


def test_json_has_what_it_had_before_there_was_a_schema() -> None:
    assert json.dumps(to_json(gateway_pb2.PlayHead(time_s=0.5, speed=1))) == (
        '{"type": "head", "time_s": 0.5, "speed": 1, "frame": 0, "playing": false}'
    )
    assert to_json(Choice().message()) == {
        "type": "frames",
        "codec": "float32",
        "rate_hz": None,
        "normals": False,
        "detail": 1,
        "error": "",
    }
    state = to_json(gateway_pb2.DaemonState(server="s"))
    assert "recording" not in state
    assert (state["scenes"], state["operator"]) == ([], False)


def test_findings_are_short_and_of_a_load_only() -> None:
    result = gateway_pb2.CommandResult(id=2**53, action=Action.LOAD, scene="beam")
    without = {"type": "result", "id": 2**53, "action": "load", "scene": "beam", "error": ""}
    assert result_to_json(result, loaded=False) == without
    assert result_to_json(result, loaded=True) == {**without, "findings": []}
    result.findings.append(finding_pb2.Finding(code=finding_pb2.FINDING_CODE_LOCKING, value=0.495))
    found = {"code": "FINDING_CODE_LOCKING", "value": 0.495}
    assert result_to_json(result, loaded=True) == {**without, "findings": [found]}
