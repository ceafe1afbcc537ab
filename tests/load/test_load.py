"""A short load test with real processes on a real daemon: nothing is lost, nothing is left running."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import tensormass as tm
from tensormass._shared.errors import NotFoundError
from tensormass._shared.processes import ChildProcess, find_program
from tensormass_tools import load_arguments, load_test
from tensormass_tools.cli import main
from tensormass_tools.keys.folder import KeyFolder

# A small beam under a probe: the test is of the clients, not of the solver.
SCENE = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.004}
bodies:
  - name: block
    mesh: {grid: {origin_m: {}, size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 6, cells_y: 6, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 5000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 1.0
    rayleigh_stiffness_s: 0.01
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.01}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
"""


@pytest.fixture(scope="module")
def haptic_program() -> Path:
    try:
        find_program("tensormassd", "TENSORMASSD")
        return find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
    except NotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "block.yaml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def server(haptic_program: Path) -> Iterator[tm.Server]:
    with tm.launch(backend="cpu") as server:
        yield server


def arguments(*options: object) -> argparse.Namespace:
    parser = argparse.ArgumentParser(allow_abbrev=False)
    load_arguments.add_arguments(parser)
    return parser.parse_args([str(option) for option in options])


def children() -> set[int]:
    """Processes that this one started and that still are, zombies among them."""
    return {int(pid) for pid in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()}


def haptic(program: Path, server: tm.Server, *options: object) -> tuple[int, dict[str, Any], str]:
    """Runs a haptic client to its end: exit status, report and what it said."""
    command = [program, "--server", server.address, "--json", "-", *options]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=60, check=False)
    return done.returncode, json.loads(done.stdout) if done.stdout else {}, done.stderr


@pytest.mark.alone
def test_load_test_of_two_scenes(haptic_program: Path, scene_file: Path, tmp_path: Path) -> None:
    before = children()
    report_file = tmp_path / "report.json"
    options = ("--scenes", 2, "--haptic", 3, "--viewers", 2, "--seconds", 3, "--scene", scene_file, "--backend", "cpu")
    status = load_test.run(arguments(*options, "--json", report_file))
    report = json.loads(report_file.read_text())
    assert report["errors"] == []
    assert status == 0
    assert report["poses_lost_at_end"] == 0
    first, second = (scene["scene"] for scene in report["scenes"])
    assert first != second
    assert [client["scene"] for client in report["haptic"]] == [first, second, first]
    assert {client["transport"] for client in report["haptic"]} == {"zeromq", "zenoh"}
    for client in report["haptic"]:
        assert client["last_sequence_echoed"] == client["last_sequence_sent"] > 200
        assert client["max_force_n"] > 0.0, "the probe never felt the block"
        assert client["feedback_foreign"] < client["feedback_received"] / 5, "only those from before the first pose"
    assert report["pose_to_force"]["count"] == sum(client["pose_to_force"]["count"] for client in report["haptic"])
    assert (
        0.0 < report["pose_to_force"]["p50_s"] <= report["pose_to_force"]["p99_s"] <= report["pose_to_force"]["max_s"]
    )
    for viewer in report["viewers"]:
        assert viewer["frame_age"]["count"] > 0
        assert 0.0 < viewer["frame_age"]["p50_s"] < 1.0
    for scene in report["scenes"]:
        assert scene["steps"] > 100
        assert scene["poses_rejected"] == 0
        assert 0.0 < scene["step_time_p50_s"] <= scene["step_time_max_s"]
    assert children() == before


@pytest.mark.alone
def test_a_stopped_viewer_is_compared_with_before_and_after(
    server: tm.Server, scene_file: Path, tmp_path: Path
) -> None:
    # Neither another load test in the same daemon nor a scene that would step only when asked is in the way.
    others = server.load(str(scene_file), name="load-test-0")
    scene_file.write_text(SCENE.replace("dt_s: 0.004", "dt_s: 0.004, lockstep: true"))
    report_file = tmp_path / "report.json"
    options = ("--haptic", 0, "--viewers", 1, "--seconds", 1, "--scene", scene_file, "--stop-viewer", 3)
    assert load_test.run(arguments(*options, "--server", server.address, "--json", report_file)) == 0
    report = json.loads(report_file.read_text())
    stopped = report["stopped_viewer"]
    assert stopped["seconds"] == 3
    assert [phase["name"] for phase in stopped["phases"]] == ["before", "while stopped", "after"]
    assert all(phase["step_time_p99_s"] > 0.0 for phase in stopped["phases"])
    # The viewer's oldest frame, or the frames that it missed, prove that it was stopped.
    (viewer,) = report["viewers"]
    assert viewer["was_stopped"]
    assert viewer["frames_dropped"] > 20
    left = [status.scene for status in server.scenes()]
    assert left == [others.name], "the scenes of the test are unloaded from a daemon that goes on"


def test_a_failed_set_up_is_one_line(server: tm.Server, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["load-test", "--scene", "no-such-scene.yaml", "--server", server.address]
    assert main(command) == 1
    assert capsys.readouterr().err.startswith("tensormass: no-such-scene.yaml: no such file")
    assert main([*command, "--json", "-"]) == 1
    assert json.loads(capsys.readouterr().out)["kind"] == "NotFoundError"


def test_poses_and_forces_cross_zenoh_with_keys(haptic_program: Path, scene_file: Path, tmp_path: Path) -> None:
    """Four hands send while they receive. zenoh's published TLS link ended one of them, or the daemon, by SIGSEGV."""
    folder = KeyFolder(tmp_path / "keys")
    folder.init([], days=1)
    folder.add("operator", "operator")
    client = folder.client_file("operator")
    scene_file.write_text(SCENE.replace("dt_s: 0.004", "dt_s: 0.001"))
    with tm.launch(backend="cpu", options=["--keys", str(folder.path)], keys=client) as server:
        options = ("--server", server.address, "--keys", client, "--transport", "zenoh", "--haptic", 4, "--viewers", 0)
        report = load_test.load_test(arguments(*options, "--seconds", 4, "--scene", scene_file))
        assert not [error for error in report["errors"] if "status -" in error], report["errors"]
        assert all(client["feedback_received"] > 100 for client in report["haptic"])
        server.version()


@pytest.mark.parametrize(
    "options",
    [
        ("--max-force", "nan"),
        ("--max-slew", "nan"),
        ("--rate", "inf"),
        ("--depth", "-1"),
        ("--hand-stiffness", "0"),
        ("--press-at", "0,nan,0"),
        ("--rate", "10"),  # a watchdog of 50 ms would take the force off in every period
    ],
)
def test_a_haptic_client_refuses_wrong_options_before_it_connects(
    haptic_program: Path, options: tuple[str, str]
) -> None:
    done = subprocess.run([haptic_program, *options], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert options[0] in done.stderr


def test_a_haptic_client_that_is_terminated_drains_and_reports(
    server: tm.Server, haptic_program: Path, scene_file: Path, tmp_path: Path
) -> None:
    scene = server.load(str(scene_file))
    report_file = tmp_path / "haptic.json"
    with (tmp_path / "haptic.log").open("wb") as log, scene.feedbacks("probe") as feedbacks:
        client = ChildProcess(
            [haptic_program, "--server", server.address, "--scene", scene.name, "--json", report_file], output=log
        )
        try:
            while feedbacks.receive(timeout_s=20.0).pose_sequence < 100:
                assert client.running
        finally:
            assert client.stop(timeout_s=20.0) == 0
    report = json.loads(report_file.read_text())
    assert report["last_sequence_echoed"] == report["last_sequence_sent"] >= 100


def test_without_answers_the_force_is_zero_and_the_exit_status_is_3(
    server: tm.Server, haptic_program: Path, scene_file: Path
) -> None:
    scene = server.load(str(scene_file))
    scene.pause()
    status, report, words = haptic(haptic_program, server, "--scene", scene.name, "--seconds", 0.3)
    assert status == 3
    assert "no feedback answered any pose" in words
    assert report["feedback_received"] == 0
    assert report["max_force_n"] == 0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [(("--scene", "nowhere"), "nowhere"), (("--scene", "block", "--tool", "hammer"), "it has probe")],
)
def test_a_haptic_client_says_what_it_did_not_find(
    server: tm.Server, haptic_program: Path, scene_file: Path, options: tuple[str, ...], words: str
) -> None:
    server.load(str(scene_file))
    status, _, said = haptic(haptic_program, server, *options)
    assert status == 1
    assert words in said


def test_force_fades_when_the_daemon_goes(haptic_program: Path, scene_file: Path, tmp_path: Path) -> None:
    report_file = tmp_path / "haptic.json"
    with tm.launch(backend="cpu") as server, (tmp_path / "haptic.log").open("wb") as log:
        scene = server.load(str(scene_file))
        command = [str(haptic_program), "--server", server.address, "--scene", scene.name, "--json", str(report_file)]
        client = ChildProcess([*command, "--period", "1", "--seconds", "4"], output=log)
        try:
            with scene.feedbacks("probe") as feedbacks:
                pressed = 0
                while pressed < 5:  # the client has felt all of them but the last
                    pressed += feedbacks.receive(timeout_s=20.0).force_n.z > 0.05
                    assert client.running
            assert server.process is not None
            server.process.process.send_signal(signal.SIGKILL)
            assert client.process.wait(20.0) == 0, "it goes on without the daemon, and ends in its own time"
        finally:
            client.stop()
    report = json.loads(report_file.read_text())
    assert report["max_force_n"] > 0.0
    assert report["stale_episodes"] >= 1
    assert report["stale_ticks"] > 100, "from the kill in the first second or two to the end"
    assert report["last_sequence_echoed"] < report["last_sequence_sent"], "the loss must show"
