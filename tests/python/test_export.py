"""Scenes as messages, for clients without the SDK."""

from __future__ import annotations

import json
from pathlib import Path

import grpc
import pytest
from google.protobuf import json_format

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2
from tensormass_tools.cli import main


def has_daemon() -> bool:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError:
        return False
    return True


@pytest.mark.skipif(not has_daemon(), reason="tensormassd is not built")
def test_an_exported_scene_is_loaded_without_the_sdk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "demo.pb"
    assert main(["export", "demo", "--output", str(file)]) == 0
    assert capsys.readouterr().out == f"wrote {file}, {file.stat().st_size:,} bytes\n"
    with tm.launch(backend="cpu", zenoh=False) as server, grpc.insecure_channel(server.address) as channel:
        # The code of docs/protocol.md.
        control = control_pb2_grpc.ControlStub(channel)
        request = control_pb2.LoadSceneRequest(scene=scene_pb2.Scene.FromString(file.read_bytes()))
        report = control.LoadScene(request, timeout=300).report
        assert [body.name for body in report.bodies] == ["liver"]
        assert [status.scene for status in server.scenes()] == ["demo"]


@pytest.mark.parametrize("ending", ["pb", "json"])
def test_a_scene_is_exported_with_its_name(ending: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / f"beam.{ending}"
    assert main(["export", "beam", "--output", str(output), "--name", "mine", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"output": str(output), "bytes": output.stat().st_size}
    request = control_pb2.LoadSceneRequest()
    if ending == "pb":
        request.scene.ParseFromString(output.read_bytes())
    else:
        json_format.Parse(output.read_text(), request)
    wanted = tm.Scene.from_file("beam").message
    wanted.name = "mine"
    assert request.scene == wanted


def test_a_scene_is_exported_to_files_of_known_endings_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "beam", "--output", str(tmp_path / "beam.yaml")]) == 1
    assert "must end in .pb or .json" in capsys.readouterr().err
    assert main(["export", "beam", "--output", str(tmp_path / "none" / "beam.pb")]) == 1
    assert "no folder that can be written to" in capsys.readouterr().err
