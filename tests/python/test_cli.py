"""The command: what it prints, in which form, and with which status it ends."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from conftest import Recorder

import tensormass as tm
from tensormass import mesh_files, meshes
from tensormass.cli import main, parse_length_m
from tensormass.output import status_line, to_plain
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

STATUS = stream_pb2.SceneStatus(
    scene="demo",
    state=stream_pb2.SceneStatus.STATE_RUNNING,
    step=1200,
    missed_deadlines=3,
    target_rate_hz=60,
    reached_rate_hz=59.97,
    cg_iterations=23,
    cg_relative_residual=8e-4,
    tools=[stream_pb2.ToolFeedback(tool="probe", force_n=scene_pb2.Vector3(x=3, z=4))],
)


@pytest.mark.parametrize(
    ("text", "length_m"),
    [("8mm", 0.008), ("0.8cm", 0.008), ("0.8 cm", 0.008), ("1dm", 0.1), ("250um", 2.5e-4), ("2", 2.0), ("1e-3m", 1e-3)],
)
def test_lengths_have_units(text: str, length_m: float) -> None:
    assert parse_length_m(text) == pytest.approx(length_m)


@pytest.mark.parametrize("text", ["", "mm", "0", "-8mm", "8x", "8mmm", "nan", "inf", "1e400", "1..2"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is not a positive length"):
        parse_length_m(text)


def test_messages_become_plain_values() -> None:
    plain = to_plain(STATUS)
    assert plain["state"] == "STATE_RUNNING"
    assert plain["step"] == 1200
    assert plain["fault"] == ""
    assert plain["tools"][0]["force_n"] == {"x": 3.0, "y": 0.0, "z": 4.0}
    assert "local_model" not in plain["tools"][0]
    json.dumps(plain)


def test_list_and_status(recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]) -> None:
    fake, server = recorder
    fake.replies["ListScenes"] = control_pb2.ListScenesResponse(scenes=[STATUS])
    assert main(["list", "--server", server.address]) == 0
    assert capsys.readouterr().out == "demo  running  step 1200\n"
    assert main(["list", "--server", server.address, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"scene": "demo", "state": "running", "step": 1200}]
    assert main(["status", "--server", server.address]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    for part in ("demo: 60.0/60 Hz", "missed 0.2 %", "CG 23 to 8e-04", "probe 5.00 N"):
        assert part in line
    assert main(["status", "--server", server.address, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["scenes"] == [to_plain(STATUS)]


def test_a_status_says_what_guards_and_budget_did() -> None:
    status = stream_pb2.SceneStatus(cg_iterations=40, guard_events=3, guard_recoveries=2)
    assert "guards 3, mended 2" in status_line(status)
    assert "floor" not in status_line(status)
    status = stream_pb2.SceneStatus(step_budget_s=0.008, cg_iteration_limit=40, floor_cg_iterations=20)
    assert "at most 40 (floor 20) in 8 ms" in status_line(status)
    assert "guards" not in status_line(status)


def test_load_prints_the_plan(recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]) -> None:
    fake, server = recorder
    report = control_pb2.SceneReport(
        scene="mine",
        bodies=[control_pb2.BodyReport(name="beam", node_count=123, volume_m3=6.4)],
        stages=[control_pb2.PlanStage(name="assemble", bytes=12_345_678, operations=9_000)],
        buffers=[control_pb2.PlanBuffer(name="tensors", bytes=777)],
        not_modelled=["contact: the scene has no tools"],
        warnings=["body 'beam' has 2 components"],
    )
    fake.replies["LoadScene"] = control_pb2.LoadSceneResponse(report=report)
    command = ["load", "beam", "--server", server.address, "--name", "mine", "--lockstep"]
    assert main(command) == 0
    sent = fake.asked[-1].scene
    assert (sent.name, sent.stepping.lockstep) == ("mine", True)
    text = capsys.readouterr().out
    for part in ("123", "assemble", "12.3 MB", "9,000", "777 B", "the scene has no tools", "2 components"):
        assert part in text
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == to_plain(report)


def test_errors_are_said_and_counted_in_the_status(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    missing = str(tmp_path / "none.vtu")
    assert main(["mesh", missing, "-o", str(tmp_path / "out.msh")]) == 1
    assert capsys.readouterr().err == f"tensormass: {missing}: no such file\n"
    assert main(["mesh", missing, "-o", str(tmp_path / "out.msh"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {"error": f"{missing}: no such file", "kind": "NotFoundError"}
    with pytest.raises(SystemExit) as usage:
        main(["mesh"])
    assert usage.value.code == 2


def test_run_refuses_a_wrong_scene_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    scene = tmp_path / "scene.yaml"
    scene.write_text("name: s\nbody: []\n")
    assert main(["run", str(scene)]) == 1
    assert "Scene has no field 'body'; did you mean 'bodies'?" in capsys.readouterr().err


def test_mesh_fills_a_surface_in_its_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) * 50.0  # mm
    surface = meshes.boundary(meshes.VolumeMesh.from_tetrahedra(corners, [[0, 1, 2, 3]]))
    source = tmp_path / "surface.ply"
    meshio.Mesh(surface.vertices, [("triangle", surface.triangles.astype(np.int32))]).write(source)
    output = tmp_path / "volume.msh"
    assert main(["mesh", str(source), "-o", str(output), "--edge", "4cm", "--unit", "1mm", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["volume"] == pytest.approx(8 / 3 * 0.05**3, rel=0.02)
    assert report["mean_edge_length"] == pytest.approx(0.04, rel=0.8)
    assert report["inverted_count"] == 0
    assert meshes.quality(mesh_files.read_mesh(output)).volume == pytest.approx(report["volume"])


def test_mesh_repairs_a_volume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inverted = meshes.VolumeMesh.from_tetrahedra([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1, 3]])
    source, output = tmp_path / "in.vtu", tmp_path / "out.vtk"
    mesh_files.write_mesh(source, inverted)
    assert main(["mesh", str(source), "-o", str(output)]) == 0
    assert "1 × tetrahedron" in capsys.readouterr().out
    np.testing.assert_allclose(meshes.signed_volumes(mesh_files.read_mesh(output)), [1 / 6])
