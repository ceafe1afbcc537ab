"""The command: what it prints, in which form, and with which status it ends."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import meshio
import numpy as np
import pytest
from conftest import Recorder

import tensormass as tm
from tensormass._shared.plain import to_plain
from tensormass._shared.processes import ChildProcess, end_explained
from tensormass._src import mesh_files, mesh_geometry, meshes
from tensormass.v1 import control_pb2, finding_pb2, guard_pb2, scene_pb2, stream_pb2
from tensormass_tools import run
from tensormass_tools.cli import main, parse_length_m
from tensormass_tools.output import load_line, report_text, status_line

STATUS = stream_pb2.SceneStatus(
    scene="demo",
    state=stream_pb2.SceneStatus.STATE_RUNNING,
    step=1200,
    missed_deadlines=3,
    target_rate_hz=60,
    reached_rate_hz=59.97,
    step_time_p50_s=0.0042,
    step_time_p99_s=0.0095,
    cg_iterations=23,
    cg_relative_residual=8e-4,
    tools=[stream_pb2.ToolFeedback(tool="probe", force_n=scene_pb2.Vector3(x=3, z=4))],
)


def test_the_plan_names_what_follows_a_schedule() -> None:
    schedule = scene_pb2.Schedule(time_s=[0, 2], factor=[0, 1])
    scene = scene_pb2.Scene(
        bodies=[scene_pb2.Body(name="bar", loads=[scene_pb2.Load(), scene_pb2.Load(schedule=schedule)])],
        gravity_schedule=schedule,
    )
    text = report_text(control_pb2.SceneReport(), scene)
    assert "factors by schedule:\n  gravity: 0 at 0 s, 1 at 2 s\n  'bar', loads[1]: 0 at 0 s, 1 at 2 s" in text
    assert "schedule" not in report_text(control_pb2.SceneReport(), scene_pb2.Scene())


def test_the_plan_names_the_largest_loads_and_what_follows_a_fault() -> None:
    probe, wall = scene_pb2.Tool(name="probe", max_force_n=5), scene_pb2.Tool(name="wall", fixed=True)
    scene = scene_pb2.Scene(tools=[probe, wall])
    lines = [line.split() for line in report_text(control_pb2.SceneReport(), scene).splitlines()]
    assert ["probe", "5", "N", "1", "N", "m", "1"] in lines
    assert "wall   fixed: bears any load" in report_text(control_pb2.SceneReport(), scene)
    assert "(guard.on_fault): go_on: tools back off" in report_text(control_pb2.SceneReport(), scene)
    scene.guard.on_fault = guard_pb2.Guard.ON_FAULT_STOP
    assert "(guard.on_fault): stop: the scene stops" in report_text(control_pb2.SceneReport(), scene)
    text = report_text(control_pb2.SceneReport(), scene_pb2.Scene())
    assert "(guard.on_fault): stop: " in text
    assert "largest force" not in text


@pytest.mark.parametrize(
    ("text", "length_m"),
    [("8mm", 0.008), ("0.8cm", 0.008), ("0.8 cm", 0.008), ("1dm", 0.1), ("250um", 2.5e-4), ("2", 2.0), ("1e-3m", 1e-3)],
)
def test_lengths_have_units(text: str, length_m: float) -> None:
    assert parse_length_m(text) == pytest.approx(length_m)


@pytest.mark.parametrize("text", ["", "mm", "0", "-8mm", "8x", "8mmm", "nan", "inf", "1e400", "1..2"])
def test_invalid_lengths_are_refused(text: str) -> None:
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
    assert capsys.readouterr().out == f"server {server.address}\ndemo  running  step 1200\n"
    assert main(["list", "--server", server.address, "--json"]) == 0
    listed = {"server": server.address, "scene": "demo", "state": "running", "step": 1200}
    assert json.loads(capsys.readouterr().out) == [listed]
    assert main(["status", "--server", server.address]) == 0
    first, *_, line = capsys.readouterr().out.splitlines()
    assert first.endswith(f", control {server.address}")
    for part in ("demo: 60.0/60 Hz", "missed 0.2 %", "4.2 ms (p99 9.5)", "CG 23 to 8e-04", "probe 5.00 N"):
        assert part in line
    assert main(["status", "--server", server.address, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["address"], said["scenes"]) == (server.address, [to_plain(STATUS)])


def test_status_prints_guards_and_warnings_in_full(
    recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]
) -> None:
    fake, server = recorder
    slow = finding_pb2.Finding(code="FINDING_CODE_BUDGET_EXCEEDED", message="steps take 2 s", remedy="be patient")
    mended = stream_pb2.SceneStatus(scene="a", guard_events=1, guard_text="step 7 left its bounds", findings=[slow])
    mended.findings.add(code="FINDING_CODE_LAW_RANGE", body="b", message="hooke is left", remedy="come back")
    mended.findings.add(code="FINDING_CODE_LAW_RANGE", body="c", message="hooke too", remedy="no", accepted="a test")
    mended.findings.add(code="FINDING_CODE_LOCKING", message="said at load", remedy="no")
    stopped = stream_pb2.SceneStatus(scene="b", guard_events=1, guard_text="step 9 did", fault="step 9 did")
    fake.replies["ListScenes"] = control_pb2.ListScenesResponse(scenes=[mended, stopped])
    assert main(["status", "--server", server.address]) == 0
    a, *notes, b = capsys.readouterr().out.splitlines()[3:]
    assert a.startswith("a: ")
    slow_line, left_line = "warning: steps take 2 s; be patient", "warning: hooke is left; come back"
    assert notes == ["guard: step 7 left its bounds", slow_line, left_line]
    assert b.count("step 9 did") == 1


def test_a_load_is_shown_on_one_line_of_a_terminal_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_line() is None
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    assert load_line(quiet=True) is None
    write = load_line()
    assert write is not None
    write("cutting the grid", 0.25)
    assert capsys.readouterr().out.rstrip(" ") == "\rloading  25 %  cutting the grid"
    write("", 1.0)
    assert capsys.readouterr().out.strip() == ""


def test_a_status_shows_guards_and_budget() -> None:
    status = stream_pb2.SceneStatus(cg_iterations=40, guard_events=3, guard_recoveries=2)
    assert "guards 3, mended 2" in status_line(status)
    assert "floor" not in status_line(status)
    status = stream_pb2.SceneStatus(step_budget_s=0.008, cg_iteration_limit=40, floor_cg_iterations=20)
    assert "at most 40 (floor 20) in 8 ms" in status_line(status)
    assert "guards" not in status_line(status)


def test_a_status_counts_recoveries_and_says_that_one_goes_on() -> None:
    status = stream_pb2.SceneStatus(guard_events=3, guard_recoveries=3, recoveries=2, recovering_steps=3)
    assert status_line(status).endswith("recoveries 2, 3 steps")
    status.held_steps, status.recovering = 1, True
    assert status_line(status).endswith("recoveries 2, 3 steps, tissue held in 1, recovering now")
    assert "recover" not in status_line(stream_pb2.SceneStatus(guard_events=3, guard_recoveries=2))


def test_a_status_names_the_state_unless_the_scene_runs() -> None:
    assert "running" not in status_line(STATUS)
    for name in ("paused", "lockstep", "faulted"):
        status = stream_pb2.SceneStatus(state=f"STATE_{name.upper()}")
        assert status_line(status).startswith(f"{name}  ")


def test_load_prints_the_plan(recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]) -> None:
    fake, server = recorder
    report = control_pb2.SceneReport(
        scene="mine",
        bodies=[control_pb2.BodyReport(name="beam", node_count=123, volume_m3=6.4)],
        stages=[control_pb2.PlanStage(name="assemble", bytes=12_345_678, operations=9_000)],
        buffers=[control_pb2.PlanBuffer(name=name, bytes=size) for name, size in (("tensors", 777), ("rows", 123_456))],
        not_modelled=["contact: the scene has no tools"],
    )
    report.findings.add(code="FINDING_CODE_SEPARATE_PARTS", message="body 'beam' has 2 components", remedy="fix both")
    report.findings.add(code="FINDING_CODE_LOCKING", message="it locks", remedy="no", accepted="a test")
    fake.replies["LoadScene"] = control_pb2.LoadSceneResponse(report=report)
    command = ["load", "beam", "--server", server.address, "--name", "mine", "--lockstep"]
    assert main(command) == 0
    sent = fake.asked[-1].scene
    assert (sent.name, sent.stepping.lockstep) == ("mine", True)
    text = capsys.readouterr().out
    parts = ["123", "6.4e+06 cm³", "assemble", "12.3 MB", "9,000", "777 B", "123 kB", "the scene has no tools"]
    found = ("  separate_parts: body 'beam' has 2 components; fix both\n", "  locking: it locks (a test)\n")
    for part in (*parts, *found):
        assert part in text
    assert text.startswith(f"server {server.address}\n")
    # Users ask first what is simulated, and last how the memory is divided.
    order = [
        "6.4e+06 cm³",
        "the scene has no tools",
        "2 components",
        "assemble",
        "for the solve, per iteration",
        "777 B",
    ]
    assert sorted(order, key=text.index) == order
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"server": server.address, **to_plain(report)}
    assert main(["load", "beam", "--server", server.address]) == 0
    assert (fake.asked[-1].scene.name, fake.asked[-1].scene.stepping.lockstep) == ("beam", False)


def test_a_scene_is_unloaded_and_reported_by_its_name(
    recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    fake, server = recorder
    fake.replies |= {
        "GetStatus": control_pb2.GetStatusResponse(status=STATUS),
        "GetTopology": control_pb2.GetTopologyResponse(),
        "UnloadScene": control_pb2.UnloadSceneResponse(),
    }
    output = tmp_path / "demo.npz"
    plain = {"server": server.address, "output": str(output)}
    for option, said in (
        ([], f"wrote {output} from {server.address}\n"),
        (["--json"], json.dumps(plain) + "\n"),
    ):
        assert main(["report", "demo", "--server", server.address, "-o", str(output), *option]) == 0
        assert capsys.readouterr().out == said
    with np.load(output) as written:
        assert json.loads(str(written["status"])) == to_plain(STATUS)
    for option, said in (
        ([], f"unloaded demo from {server.address}\n"),
        (["--json"], json.dumps({"server": server.address, "unloaded": "demo"}) + "\n"),
    ):
        assert main(["unload", "demo", "--server", server.address, *option]) == 0
        assert capsys.readouterr().out == said
        assert fake.asked[-1] == control_pb2.UnloadSceneRequest(scene="demo")


def test_errors_are_printed_and_set_the_exit_status(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    missing = str(tmp_path / "none.vtu")
    assert main(["mesh", missing, "-o", str(tmp_path / "out.msh")]) == 1
    assert capsys.readouterr().err == f"tensormass: {missing}: no such file\n"
    assert main(["mesh", missing, "-o", str(tmp_path / "out.msh"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == {"error": f"{missing}: no such file", "kind": "NotFoundError"}
    assert main(["load-test", "--stop-viewer", "1", "--viewers", "0", "--json", "-"]) == 1
    assert json.loads(capsys.readouterr().out)["kind"] == "InvalidArgumentError"
    with pytest.raises(SystemExit) as usage:
        main(["mesh"])
    assert usage.value.code == 2


def test_run_refuses_a_wrong_scene_before_anything_starts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    scene = tmp_path / "scene.yaml"
    scene.write_text("name: s\nbodys: []\n")
    assert main(["run", str(scene)]) == 1
    assert "Scene has no field 'bodys'; did you mean 'bodies'?" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["run", "view"])
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--port", "99999"], "--port 99999: must be 0 (a free one) to 65535"),
        (["--port", "-1"], "--port -1: must be 0 (a free one) to 65535"),
        (["--max-browsers", "0"], "--max-browsers 0: at least one browser must be let in"),
        (["--gateway-ready-file", "/nonexistent/x"], "--gateway-ready-file /nonexistent/x: no folder that can be "),
    ],
)
def test_a_gateway_that_cannot_start_is_refused_before_anything_starts(
    command: str,
    options: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    assert main([command, *options]) == 1
    assert capsys.readouterr().err.startswith(f"tensormass: {message}")


@pytest.mark.parametrize("seconds", ["nan", "inf", "0", "-5"])
def test_run_refuses_seconds_that_are_not_positive_and_finite(
    seconds: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    assert main(["run", "--seconds", seconds]) == 1
    assert capsys.readouterr().err == f"tensormass: --seconds {seconds}: must be positive and finite\n"


@pytest.mark.parametrize("rate", ["nan", "0", "-5"])
def test_run_refuses_impossible_rates(
    rate: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    assert main(["run", "beam", "--rate", rate]) == 1
    assert capsys.readouterr().err == f"tensormass: --rate {rate}: must be positive\n"


def let_run(recorder: tuple[Recorder, tm.Server], monkeypatch: pytest.MonkeyPatch, *tools: str) -> None:
    """Replaces the daemon of `run` by the recorder, whose scene has these tools and never ends."""
    fake, server = recorder
    topology = stream_pb2.Topology(tools=[stream_pb2.ToolShape(name=name) for name in tools])
    fake.replies |= {
        "LoadScene": control_pb2.LoadSceneResponse(),
        "GetTopology": control_pb2.GetTopologyResponse(topology=topology),
        "GetStatus": control_pb2.GetStatusResponse(status=STATUS),
    }
    monkeypatch.setattr(run, "launch", lambda **_: server)


def test_run_steps_at_the_rate_that_is_asked_for(
    recorder: tuple[Recorder, tm.Server], monkeypatch: pytest.MonkeyPatch
) -> None:
    fake, _ = recorder
    let_run(recorder, monkeypatch)
    assert main(["run", "beam", "--rate", "50", "--no-viewer", "--no-haptic", "--seconds", "0.001"]) == 0
    (stepping,) = [of.scene.stepping for of in fake.asked if isinstance(of, control_pb2.LoadSceneRequest)]
    assert (stepping.rate_hz, stepping.dt_s) == (50, 0.02)


def device_that_ends(folder: Path) -> Path:
    program = folder / "haptic"
    program.write_text('#!/bin/sh\necho "it broke: $*"\nexit 3\n')
    program.chmod(0o755)
    return program


def test_run_ends_with_a_haptic_device(
    recorder: tuple[Recorder, tm.Server],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, server = recorder
    let_run(recorder, monkeypatch, "probe")
    monkeypatch.setattr(run, "_LOG_PERIOD_S", 0.01)
    monkeypatch.setenv("TENSORMASS_HAPTIC", str(device_that_ends(tmp_path)))
    assert main(["run", "beam", "--no-viewer", "--seconds", "20", "--haptic-transport", "zenoh"]) == 1
    told = f"--server {server.address} --scene beam --tool probe --transport zenoh"
    assert capsys.readouterr().err == f"tensormass: a haptic device ended by itself:\nit broke: {told}\n"


def test_run_reports_a_stopped_scene_once(
    recorder: tuple[Recorder, tm.Server],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fake, server = recorder
    fake.replies |= {"LoadScene": control_pb2.LoadSceneResponse(), "GetTopology": control_pb2.GetTopologyResponse()}
    faults = iter(["left", "left", "left", "", "left", "left"])  # it was reset in between

    def answer(method: str, request: object, context: object) -> object:
        if method != "GetStatus":
            return fake.replies[method]
        fault = next(faults, None)
        if fault is None:
            os.kill(os.getpid(), signal.SIGTERM)
        return control_pb2.GetStatusResponse(status=stream_pb2.SceneStatus(fault="left" if fault is None else fault))

    fake.answer = answer  # type: ignore[method-assign]
    monkeypatch.setattr(run, "launch", lambda **_: server)
    monkeypatch.setattr(run, "_LOG_PERIOD_S", 0.01)
    monkeypatch.chdir(tmp_path)
    assert main(["run", "beam", "--no-viewer", "--no-haptic"]) == 1
    said = capsys.readouterr()
    assert said.out.count(f"scene 'beam' stands still until it is reset (control {server.address})\n") == 2
    assert said.err.startswith("tensormass: scene 'beam' is stopped: left\nits status and state: ")
    assert (tmp_path / "beam-fault.npz").is_file()


def test_run_starts_no_viewer_and_no_hand_for_a_scene_without_frames(
    recorder: tuple[Recorder, tm.Server],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    let_run(recorder, monkeypatch, "probe")
    monkeypatch.setenv("TENSORMASS_HAPTIC", "/nonexistent")
    scene = tmp_path / "scene.yaml"
    scene.write_text("name: quiet\nstreams: {frame_rate_hz: 0}\ntools: [{name: probe}]\n")
    # No viewer either: this one could not start.
    assert main(["run", str(scene), "--seconds", "0.001", "--viewer", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("scene 'quiet' has no frames (streams.frame_rate_hz is 0): it runs without viewer and ")
    assert "viewer: " not in out


@pytest.mark.parametrize(
    ("where", "message"),
    [
        (["--host", "127.0.0.1", "--port", "{taken}"], "already in use"),
        (["--host", "256.0.0.1"], "--host 256.0.0.1 --port 0: no viewer can be served: "),
    ],
)
def test_run_says_where_no_viewer_can_be_served(
    recorder: tuple[Recorder, tm.Server], where: list[str], message: str, tmp_path: Path
) -> None:
    (tmp_path / "index.html").touch()
    (tmp_path / "assets").mkdir()
    parser = argparse.ArgumentParser(allow_abbrev=False)
    run.add_arguments(parser)

    async def serve(options: list[str]) -> None:
        async with run._viewer(parser.parse_args(["--viewer", str(tmp_path), *options]), recorder[1], {}):
            pytest.fail("it listens")

    with socket.create_server(("127.0.0.1", 0)) as taken:
        options = [option.format(taken=taken.getsockname()[1]) for option in where]
        with pytest.raises(tm.UnavailableError, match=message):
            asyncio.run(serve(options))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["solve", "beam", "--out", "x.vtu", "--cpu-threads", "-7"], "argument --cpu-threads: -7 is not in 1 to 256"),
        (["solve", "beam", "--out", "x.vtu", "--cpu-threads", "257"], "argument --cpu-threads: 257 is not in 1 to 256"),
        (["solve", "beam", "--out", "x.vtu", "--server", "a:1", "--cpu-threads", "2"], "are for a daemon to start"),
        (["inspect", "beam", "--server", "a:1", "--backend", "cpu"], "are for a daemon to start"),
        (["load-test", "--server", "a:1", "--backend", "cpu"], "are for a daemon to start"),
    ],
)
def test_options_that_a_running_daemon_cannot_take_are_wrong_usage(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as usage:
        main(options)
    assert usage.value.code == 2
    assert message in capsys.readouterr().err


def test_the_largest_number_of_threads_is_accepted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TENSORMASSD", "/nonexistent")
    for threads in ("1", "256"):
        assert main(["run", "beam", "--no-viewer", "--cpu-threads", threads]) == 1
        assert capsys.readouterr().err.startswith("tensormass: $TENSORMASSD names /nonexistent")


def test_sigterm_cleans_up_like_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    tidied = []

    @contextlib.contextmanager
    def connect(address: str, keys: object = None) -> Iterator[None]:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
            yield
        finally:
            os.kill(os.getpid(), signal.SIGTERM)  # a second one
            tidied.append(address)

    monkeypatch.setattr("tensormass_tools.cli.connect", connect)
    before = signal.getsignal(signal.SIGTERM)
    assert main(["list", "--server", "a:1"]) == 143
    assert tidied == ["a:1"]
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.parametrize(
    ("redirection", "words"),
    [
        (">/dev/full", "tensormass: standard output: No space left on device\n"),
        (">&-", "tensormass: standard output is closed\n"),
    ],
)
def test_output_that_is_lost_is_one_line(redirection: str, words: str) -> None:
    script = f'exec "{sys.executable}" -m tensormass --help {redirection}'
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(["/bin/sh", "-c", script], env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (1, words)


def test_the_end_of_the_commands_own_daemon_is_reported_with_its_log(tmp_path: Path) -> None:
    log = tmp_path / "daemon.log"
    log.write_text("last words\n")
    daemon = ChildProcess(["sleep", "60"], output=subprocess.DEVNULL)
    try:
        with (
            pytest.raises(tm.UnavailableError, match=r"^Connection refused$"),
            end_explained(daemon, log),
        ):
            raise tm.UnavailableError("Connection refused")  # by another one: this daemon runs
        daemon.process.kill()
        with (
            pytest.raises(tm.UnavailableError, match=r"^the daemon ended, by SIGKILL; its log ends:\nlast words$"),
            end_explained(daemon, log),
        ):
            raise tm.InternalError("Stream removed")
    finally:
        daemon.stop()


def test_mesh_fills_a_surface_in_its_unit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) * 50.0  # mm
    surface = mesh_geometry.boundary_surface(meshes.VolumeMesh.from_tetrahedra(corners, [[0, 1, 2, 3]]))
    source = tmp_path / "surface.ply"
    meshio.Mesh(surface.vertices, [("triangle", surface.triangles.astype(np.int32))]).write(source)
    output = tmp_path / "volume.msh"
    assert main(["mesh", str(source), "-o", str(output), "--edge", "4cm", "--unit", "1mm", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["volume"] == pytest.approx(8 / 3 * 0.05**3, rel=0.02)
    assert report["mean_edge_length"] == pytest.approx(0.04, rel=0.8)
    assert report["inverted_count"] == 0
    assert mesh_geometry.mesh_quality(mesh_files.read_mesh(output)).volume == pytest.approx(report["volume"])


def test_mesh_repairs_a_volume(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inverted = meshes.VolumeMesh.from_tetrahedra([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1, 3]])
    source, output = tmp_path / "in.vtu", tmp_path / "out.vtk"
    mesh_files.write_mesh(source, inverted)
    assert main(["mesh", str(source), "-o", str(output)]) == 0
    printed = capsys.readouterr()
    assert "1 × tetrahedron, 1.667e+05 cm³\nmean edge 1.21e+03 mm, " in printed.out
    assert printed.err == f"tensormass: {source}: 1 element is inverted and rewound\n"
    np.testing.assert_allclose(mesh_geometry.signed_volumes(mesh_files.read_mesh(output)), [1 / 6])


def test_mesh_refuses_what_it_could_not_do_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    corners = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) * 50.0  # mm
    surface = mesh_geometry.boundary_surface(meshes.VolumeMesh.from_tetrahedra(corners, [[0, 1, 2, 3]]))
    source, volume = tmp_path / "surface.obj", tmp_path / "volume.msh"
    mesh_files.write_surface(source, surface)
    # An edge of 8 mm for a surface of 100 m, which would keep the mesher busy for hours.
    assert main(["mesh", str(source), "-o", str(volume), "--edge", "8mm"]) == 1
    assert "would get about 6e+12 tetrahedra; take a longer edge, or give both in the same" in capsys.readouterr().err
    source.write_text(source.read_text("utf-8") + "vt 0 0\n", "utf-8")
    assert main(["mesh", str(source), "-o", str(volume)]) == 1
    assert "surface.obj: .obj holds a surface, without volume elements; if it is closed" in capsys.readouterr().err
    assert main(["mesh", str(source), "-o", str(tmp_path / "volume.stl"), "--edge", "4cm", "--unit", "1mm"]) == 1
    assert "volume.stl: .stl holds surfaces only; use .msh, .vtk or .vtu" in capsys.readouterr().err
    assert not list(tmp_path.glob("volume.*"))


def test_a_size_that_is_probably_in_millimetres_is_pointed_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, output = tmp_path / "in.vtu", tmp_path / "out.vtk"
    mesh_files.write_mesh(source, meshes.VolumeMesh.from_tetrahedra(100 * np.eye(4, 3), [[0, 1, 3, 2]]))
    assert main(["mesh", str(source), "-o", str(output)]) == 0
    assert f"is 100 × 100 × 100 m large; if {source} has millimetres, give --unit 1mm" in capsys.readouterr().err
    for unit in ("1mm", "mm"):
        assert main(["mesh", str(source), "-o", str(output), "--unit", unit]) == 0
        assert capsys.readouterr().err == ""
    with pytest.warns(
        tm.MeshFileWarning, match=r"is 100 × 100 × 100 in a unit .* taken as millimetres \(mesh.scale: 0"
    ):
        assert tm.Scene.from_file(source).message.bodies[0].mesh.scale == 0.001
    assert not tm.Scene.from_file(output).message.bodies[0].mesh.HasField("scale")


def test_mesh_names_what_it_drops_and_keeps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    box = tm.grid([1, 1, 1], [0.1, 0.1, 0.1])
    source, output = tmp_path / "in.vtu", tmp_path / "out.vtu"
    nodes = np.concatenate([box.nodes, box.nodes * 0.9 + 1, box.nodes * 0.1 + 2, [[3.0, 3, 3]]])
    elements = box.elements("tetrahedron")
    tetrahedra = [elements, elements[:1], elements + 8, elements + 16, np.array([[0, 1, 2, 2]], np.uint32)]
    sets = {"crumb": [17, 18], "both": [0, 17]}
    mesh = meshes.VolumeMesh.from_arrays(nodes, [("tetrahedron", np.concatenate(tetrahedra))], sets=sets)
    mesh_files.write_mesh(source, mesh)
    command = ["mesh", str(source), "-o", str(output)]
    assert main([*command, "--json"]) == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert report["element_counts"] == {"tetrahedron": 12}
    said = [note.removeprefix(f"{source}: ") for note in report["notes"]]
    assert said[:4] == [
        "1 node belongs to no element and is left out",
        "1 element is flat and dropped",
        "1 element repeats the nodes of another one, and only that is kept",
        "1 separate part of 6 elements and 0.058 % of the volume is dropped",
    ]
    assert said[4].startswith("2 separate parts are kept (58 %, 42 % of the volume): they share no node")
    assert said[5:] == ["the set 'crumb' has no node of what is kept and is dropped"]
    assert [line.removeprefix("tensormass: ") for line in printed.err.splitlines()] == report["notes"]
    assert main([*command, "--largest"]) == 0
    assert "2 separate parts of 12 elements and 42 % of the volume are dropped" in capsys.readouterr().err
    assert mesh_files.read_mesh(output).element_count == 6


def test_the_version_and_a_close_name_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert re.fullmatch(r"tensormass \d+\.\d+\.\d+\S*\n", capsys.readouterr().out)
    assert main(["modes", "demoo"]) == 1
    assert capsys.readouterr().err.endswith("; did you mean 'demo'?\n")
