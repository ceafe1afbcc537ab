"""What operators do to scenes from a browser, and what the gateway refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import TOKEN, browse, load, options

from tensormass._src import demo
from tensormass.v1 import control_pb2
from tensormass_gateway.control import MAX_STEPS, MAX_WAITING
from tensormass_gateway.gateway import Gateway, serve


@pytest.mark.parametrize(
    ("action", "fields", "call"),
    [
        ("pause", {}, control_pb2.PauseSceneRequest(scene="liver")),
        ("resume", {}, control_pb2.ResumeSceneRequest(scene="liver")),
        ("step", {}, control_pb2.StepSceneRequest(scene="liver", count=1)),
        ("step", {"steps": 5}, control_pb2.StepSceneRequest(scene="liver", count=5)),
        ("reset", {}, control_pb2.ResetSceneRequest(scene="liver")),
        ("unload", {}, control_pb2.UnloadSceneRequest(scene="liver")),
    ],
)
@asynchronous
async def test_command_of_an_operator_reaches_the_daemon(
    viewer: Path, action: str, fields: dict[str, object], call: object
) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            assert page.daemon["operator"] is True
            result = await page.command(action, "liver", **fields)
            assert result == {"type": "result", "id": 7, "action": action, "scene": "liver", "error": ""}
            assert daemon.commands == [call]


@asynchronous
async def test_refusal_of_the_daemon_reaches_the_operator(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        daemon.refusal = "scene 'liver' runs by the clock"
        assert (await page.command("step", "liver"))["error"] == "scene 'liver' runs by the clock"


@asynchronous
async def test_values_after_an_adjustment_reach_the_operator(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            gravity = {"x": 0.0, "y": -1.5, "z": 0.0}
            changes = {"gravity_m_per_s2": gravity, "bodies": [{"body": "a", "stiffness_factor": 2.0}]}
            result = await page.command("adjust", "liver", changes=changes)
            assert result["error"] == ""
            assert result["adjustments"] == changes
            sent = control_pb2.SceneAdjustments(bodies=[{"body": "a", "stiffness_factor": 2}])
            sent.gravity_m_per_s2.y = -1.5
            assert daemon.commands == [control_pb2.AdjustSceneRequest(scene="liver", changes=sent)]


@asynchronous
async def test_tools_come_and_go_with_their_findings(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            hook = {"name": "hook", "capsule": {"radius_m": 0.01, "length_m": 0.5}, "position_m": {"z": 1.0}}
            result = await page.command("edit", "liver", edit={"add_tools": [hook]})
            assert (result["error"], result["findings"]) == ("", [{"tool": "hook", "message": "it is inside tissue"}])
            result = await page.command("edit", "liver", edit={"remove_tools": ["hook"]})
            assert (result["error"], result["findings"]) == ("", [])
            added, removed = daemon.commands
            assert isinstance(added, control_pb2.EditSceneRequest)
            assert added.edit.add_tools[0].capsule.length_m == 0.5
            assert removed == control_pb2.EditSceneRequest(scene="liver", edit={"remove_tools": ["hook"]})
            daemon.refusal = "edit.remove_tools[0]: scene 'liver' has no tool 'needle'"
            result = await page.command("edit", "liver", edit={"remove_tools": ["needle"]})
            assert result["error"] == daemon.refusal


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ([], "edit is not a JSON object"),
        ({"add_tools": [{"name": 3}]}, "edit is not a SceneEdit as JSON"),
        ({"add_tools": [{"nam": "hook"}]}, "edit is not a SceneEdit as JSON"),
        ({"remove_tool": ["hook"]}, "edit is not a SceneEdit as JSON"),
    ],
)
@asynchronous
async def test_refuses_edits_that_are_none(viewer: Path, edit: object, said: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            await page.send(type="control", id=7, action="edit", scene="liver", edit=edit)
            assert await page.closed() == (1008, said)
            assert daemon.commands == []


@pytest.mark.parametrize("action", ["pause", "resume", "step", "reset", "load", "unload", "adjust", "edit"])
@asynchronous
async def test_who_only_looks_controls_nothing(viewer: Path, action: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control, allow_poses=True)) as gateway:
        load(daemon)
        async with browse(gateway, "liver", token=TOKEN) as page:
            assert (page.daemon["operator"], page.daemon["poses_allowed"]) == (False, False)
            assert "only lets you look" in (await page.command(action, "beam"))["error"]
            assert daemon.commands == []
            await page.send(type="pose", tool="probe", position_m=[0, 0, 0])
            assert await page.closed() == (1008, "only an operator moves tools")


@asynchronous
async def test_builtin_scene_is_loaded_under_a_free_name_and_announced_at_once(viewer: Path) -> None:
    async with (
        fake_daemon() as daemon,
        serve(options(viewer, daemon.control, poll_interval_s=1000)) as gateway,
        browse(gateway) as page,
    ):
        assert page.daemon["builtin_scenes"] == demo.builtin_scenes()
        for name, lockstep in (("beam", False), ("beam-2", True)):
            result = await page.command("load", "beam", lockstep=lockstep)
            assert (result["scene"], result["error"]) == (name, "")
            found = {"code": "FINDING_CODE_LOCKING", "value": 0.495, "body": "beam", "message": "it locks"}
            assert result["findings"] == [found]
            command = daemon.commands[-1]
            assert isinstance(command, control_pb2.LoadSceneRequest)
            loaded = command.scene
            assert (loaded.name, loaded.stepping.lockstep) == (name, lockstep)
            assert len(loaded.bodies) == 1
        told = await page.text(lambda message: message["type"] == "daemon" and len(message["scenes"]) == 2)
        assert told["scenes"] == ["beam", "beam-2"]
        await page.command("unload", "beam")
        await page.text(lambda message: message["type"] == "daemon" and message["scenes"] == ["beam-2"])


@asynchronous
async def test_file_of_the_gateways_folder_is_not_a_builtin_scene(
    viewer: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("secret", "beam"):
        (tmp_path / name).write_text("name: stolen")
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        error = (await page.command("load", "secret"))["error"]
        assert error.startswith("there is no built-in scene 'secret', only beam, ")
        assert daemon.commands == []
        assert (await page.command("load", "beam"))["scene"] == "beam"
        (command,) = daemon.commands
        assert isinstance(command, control_pb2.LoadSceneRequest)
        assert command.scene.name == "beam"


@asynchronous
async def test_frames_flow_while_a_command_waits_and_further_commands_are_bounded(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        load(daemon)
        async with browse(gateway, "liver") as page:
            daemon.released.clear()
            for number in range(MAX_WAITING + 1):
                await page.send(type="control", id=number, action="pause", scene="liver")
            refused = await page.text(lambda message: message["type"] == "result")
            assert refused["id"] == MAX_WAITING
            assert f"{MAX_WAITING} commands wait" in refused["error"]
            await page.nothing_pending()
            daemon.released.set()
            for _ in range(MAX_WAITING):
                assert (await page.text(lambda message: message["type"] == "result"))["error"] == ""


@asynchronous
async def test_lost_daemon_is_named(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        await daemon.stop()
        assert (await page.command("pause", "liver"))["error"] != ""


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"action": "explode"}, "action is not one of pause, resume"),
        ({"action": ["pause"]}, "action is not one of"),
        ({"scene": "../x"}, "64 characters"),
        ({"scene": None}, "64 characters"),
        ({"id": -1}, "id is not"),
        ({"id": True}, "id is not"),
        ({"id": "1"}, "id is not"),
        ({"steps": 0}, "steps is not"),
        ({"steps": MAX_STEPS + 1}, "steps is not"),
        ({"steps": 1.5}, "steps is not"),
        ({"lockstep": "yes"}, "lockstep is not"),
        ({"sudo": 1}, "unknown fields"),
        ({"changes": []}, "changes is not a JSON object"),
        ({"changes": {"mass": 1}}, "changes is not a SceneAdjustments"),
        ({"changes": {"bodies": [{"stiffness_factor": "soft"}]}}, "changes is not a SceneAdjustments"),
    ],
)
@asynchronous
async def test_malformed_command_closes_the_connection(viewer: Path, fields: dict[str, object], reason: str) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway, browse(gateway) as page:
        await page.send(**{"type": "control", "id": 1, "action": "pause", "scene": "liver", **fields})
        code, why = await page.closed()
        assert code == 1008
        assert reason in why
        assert daemon.commands == []


@asynchronous
async def test_two_addresses_are_for_two_roles(viewer: Path) -> None:
    gateway = Gateway(options(viewer, port=8000))
    assert gateway.url == "http://127.0.0.1:8000/?token=an-operators-token"
    assert gateway.look_url == "http://127.0.0.1:8000/?token=a-token-of-a-test"
    await gateway.stop()


def test_empty_token_makes_nobody_an_operator(viewer: Path) -> None:
    with pytest.raises(ValueError, match=r"^--operator-token-file has 0 characters"):
        Gateway(options(viewer, operator_token=""))
