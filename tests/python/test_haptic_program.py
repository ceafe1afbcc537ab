"""`tensormass-haptic` as its users run it. Without build/bin/tensormass-haptic these are skipped."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
import zmq

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2

try:
    PROGRAM = processes.find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

BLOCK = """
name: block
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 3, cells_y: 3, cells_z: 2}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.01}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
"""
PRESS = ("--press-at", "0.05,0.05,0.06", "--direction", "0,0,-1")

# Takes connections by its backlog alone and answers none; and an address where nobody is.
SILENT, NOBODY = "silent", "nobody"


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as error:
        pytest.skip(str(error))
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server


@pytest.fixture
def load(server: tm.Server) -> Iterator[Callable[[str], tm.SceneHandle]]:
    """Loads under a name of its own and unloads afterwards."""
    handles: list[tm.SceneHandle] = []

    def load(yaml: str) -> tm.SceneHandle:
        handles.append(server.load(tm.Scene.from_yaml(yaml), name=f"hand-{next(_NUMBER)}"))
        return handles[-1]

    yield load
    for handle in handles:
        handle.unload()


_NUMBER = itertools.count()


def haptic(*options: object, environment: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Runs the program to its end."""
    return subprocess.run(
        [str(word) for word in (PROGRAM, *options)],
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def at(server: tm.Server, scene: tm.SceneHandle) -> tuple[str, ...]:
    return ("--server", server.address, "--scene", scene.name)


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_scene_without_frames_is_joined_if_the_place_to_press_is_given(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    scene = load(BLOCK + "streams: {frame_rate_hz: 0}\n")
    done = haptic(*at(server, scene), *PRESS, "--seconds", 1.2, "--period", 2, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["max_force_n"] > 0.0, "as deep as the tool's radius"
    done = haptic(*at(server, scene), "--seconds", 0.1)
    assert done.returncode == 1
    assert "no surface to press" in done.stderr
    assert "frame_rate_hz is 0" in done.stderr
    assert "give --press-at and --direction" in done.stderr


# The tip is 4 cm beside the tool's origin, so that a press turns the hand.
LEVER = BLOCK.replace("radius_m: 0.01", "radius_m: 0.01, tip_offset_m: {x: 0.04}")
GRASPER = BLOCK.replace("spherical_probe: {radius_m: 0.01}", "grasper: {radius_m: 0.006, jaw_length_m: 0.03}")


def test_a_lever_turns_the_hand_within_the_largest_torque(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    press = ("--press-at", "0.02,0.05,0.06", "--direction", "0,0,-1", "--depth", 0.008, "--seconds", 2, "--period", 2)
    scene = load(LEVER)

    def largest(*options: object) -> float:
        done = haptic(*at(server, scene), *press, *options, "--json", "-")
        assert done.returncode == 0, done.stderr
        assert "torque    at most" in done.stderr
        report = json.loads(done.stdout)
        assert report["max_force_n"] > 0.05
        assert "max_jaw_torque_n_m" not in report, "the hand holds no jaws"
        return float(report["max_torque_n_m"])

    assert 0.002 < largest() <= 0.1
    assert 0.0 < largest("--max-torque", 0.001) <= 0.001 * (1 + 1e-9)
    assert largest("--max-torque", 0) == 0.0


def test_fingers_feel_the_load_of_jaws_that_press_tissue(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    scene = load(GRASPER)
    press = ("--press-at", "0.05,0.05,0.056", "--direction", "0,0,-1", "--depth", 0.008, "--period", 2)
    done = haptic(*at(server, scene), *press, "--jaw-angle", 0.6, "--seconds", 2, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert scene.status().poses_rejected == 0
    assert 0.0 < json.loads(done.stdout)["max_jaw_torque_n_m"] <= 0.1
    assert "jaws at most" in done.stderr


def test_a_tool_without_jaws_is_not_held_by_them(server: tm.Server, load: Callable[[str], tm.SceneHandle]) -> None:
    done = haptic(*at(server, load(BLOCK)), "--jaw-angle", 0.6, "--seconds", 0.1)
    assert done.returncode == 2
    assert "--jaw-angle: the tool has no jaws" in done.stderr


def test_a_hand_at_the_ends_of_its_options_sends_poses_that_are_some(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    scene = load(BLOCK)
    done = haptic(*at(server, scene), "--mass", 0.01, "--hand-damping", 1e6, "--seconds", 0.3, "--json", "-")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["poses_invalid"] == 0
    assert scene.status().poses_rejected == 0


BURNING = BLOCK.replace("position_m: {x: 0.05", "cautery: {power_w: 50}\n    position_m: {x: 0.05") + "editing: {}\n"
# A part of what tissue takes, so that one press is enough.
BURNING = BURNING.replace("    density_kg", "    ablation_j_per_m3: 1.0e+6\n    density_kg")


def test_a_hand_burns_while_it_holds_the_button(server: tm.Server, load: Callable[[str], tm.SceneHandle]) -> None:
    scene = load(BURNING)
    press = (*PRESS, "--depth", 0.006, "--seconds", 2, "--period", 2, "--json", "-")

    def burn(*options: object) -> int:
        done = haptic(*at(server, scene), *press, *options)
        assert done.returncode == 0, done.stderr
        with scene.feedbacks("probe") as feedbacks:
            assert next(iter(feedbacks)).level == 0, "the last pose has no power"
        return int(json.loads(done.stdout)["poses_with_power"])

    assert burn() == burn("--cautery-button", 0) == burn("--cautery-button", 1, "--cautery-level", 0) == 0
    assert scene.status().removed_volume_m3 == 0
    # The hand circles for two fifths of two seconds, at 1 kHz.
    assert 300 < burn("--cautery-button", 1) < 810
    assert scene.status().removed_volume_m3 > 1e-7


def test_a_hand_that_is_killed_while_it_burns_burns_no_longer(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    scene = load(BURNING)
    with scene.feedbacks("probe") as feedbacks:
        press = [*at(server, scene), *PRESS, "--seconds", "60", "--period", "2", "--cautery-button", "1"]
        with subprocess.Popen([PROGRAM, *press], stderr=subprocess.DEVNULL) as hand:
            last = next(feedback for feedback in feedbacks if feedback.level > 0)
            hand.kill()
        # 0.5 s in steps of 5 ms until the pose expires; some were on their way.
        off = next(feedback for feedback in feedbacks if feedback.level == 0)
        assert off.step - last.step < 200


def test_a_tool_without_power_has_no_button(server: tm.Server, load: Callable[[str], tm.SceneHandle]) -> None:
    done = haptic(*at(server, load(BLOCK)), "--cautery-button", 1, "--seconds", 0.1)
    assert done.returncode == 2
    assert "--cautery-button: tool probe has no power; give it Tool.cautery, or leave this out" in done.stderr
    for option, value in (("--cautery-level", "nan"), ("--cautery-level", 1.5), ("--cautery-button", -1)):
        assert haptic(option, value).returncode == 2


def test_a_web_proxy_is_not_used_for_the_server(server: tm.Server, load: Callable[[str], tm.SceneHandle]) -> None:
    proxy = {
        "http_proxy": "http://127.0.0.1:1",
        "grpc_proxy": "http://127.0.0.1:1",
        "no_proxy": "",
        "no_grpc_proxy": "",
    }
    options = ("--seconds", 0.1, "--connect-timeout", 10)
    done = haptic(*at(server, load(BLOCK)), *options, environment=proxy)
    assert done.returncode == 0, done.stderr


def test_a_hand_that_is_killed_in_contact_lets_go(server: tm.Server, load: Callable[[str], tm.SceneHandle]) -> None:
    scene = load(BLOCK)
    with scene.feedbacks("probe") as feedbacks:

        def wait(until: Callable[[stream_pb2.ToolFeedback], bool], steps: int) -> stream_pb2.ToolFeedback:
            first = None
            for feedback in feedbacks:
                first = first or feedback.step
                if until(feedback):
                    return feedback
                assert feedback.step - first < steps, feedback
            raise AssertionError

        command: list[str | Path] = [PROGRAM, *at(server, scene), *PRESS, "--seconds", "60", "--period", "2"]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as hand:
            wait(lambda feedback: feedback.force_n.z > 0.01, steps=2000)
            hand.kill()
        # 0.5 s until the pose expires and 0.1 s until the force has faded, in steps of 5 ms; some were on their way.
        gone = wait(lambda feedback: feedback.retired, steps=200)
        assert gone.force_n == scene_pb2.Vector3()
        scene.move_tool("probe", (0.05, 0.05, 0.08))
        wait(lambda feedback: not feedback.retired, steps=200)


# --- signals while it connects ----------------------------------------------------------------------------------------


def wait_until_taken(number: signal.Signals, process: subprocess.Popen[str]) -> None:
    """Until the program takes the signal itself; before, it ends by it as any other, which may be long when busy."""
    deadline = time.monotonic() + 20.0
    while True:
        fields = dict(line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines())
        if int(fields["SigBlk"], 16) >> (number - 1) & 1:
            return
        assert time.monotonic() < deadline, "it never blocks the signal"
        time.sleep(0.01)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("where", [SILENT, NOBODY])
def test_a_signal_ends_it_while_it_connects(where: str, number: signal.Signals, tmp_path: Path) -> None:
    report_file = tmp_path / "report.json"
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if where == SILENT:
            silent.listen()
            silent.settimeout(20.0)
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        command: list[str | Path] = [PROGRAM, "--server", address, "--connect-timeout", "25", "--json", report_file]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                with contextlib.ExitStack() as connections:
                    if where == SILENT:
                        connections.enter_context(silent.accept()[0])
                    wait_until_taken(number, process)
                    time.sleep(0.5)  # until it connects, and for the test's sake a little longer
                    asked = time.monotonic()
                    process.send_signal(number)
                    _, words = process.communicate(timeout=10.0)
            finally:
                process.kill()
    assert time.monotonic() - asked < 5.0
    assert process.returncode == 1
    assert f"ended before the server at {address} answered" in words
    assert not report_file.exists()


# --- the report -------------------------------------------------------------------------------------------------------


def test_a_report_that_cannot_be_written_is_refused_before_anything_starts(tmp_path: Path) -> None:
    for wrong in (tmp_path, tmp_path / "missing" / "report.json"):
        # A server that is not there would be waited for.
        done = haptic("--server", "127.0.0.1:1", "--connect-timeout", 25, "--json", wrong)
        assert done.returncode == 2
        assert f"--json: cannot write the report to {wrong}" in done.stderr
        assert "no answer" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, which takes nothing")
def test_a_report_that_is_not_written_is_a_failure_of_the_run(
    server: tm.Server, load: Callable[[str], tm.SceneHandle]
) -> None:
    done = haptic(*at(server, load(BLOCK)), "--seconds", 0.1, "--json", "/dev/full")
    assert done.returncode == 1
    assert "cannot write the report to /dev/full: No space left on device" in done.stderr


def test_a_run_that_does_not_come_about_leaves_an_older_report(tmp_path: Path) -> None:
    report_file = tmp_path / "report.json"
    report_file.write_text("older")
    done = haptic("--server", "127.0.0.1:1", "--connect-timeout", 0.1, "--json", report_file)
    assert done.returncode == 1
    assert report_file.read_text() == "older"


def test_without_answers_the_report_is_written_and_the_scene_says_why(
    server: tm.Server, load: Callable[[str], tm.SceneHandle], tmp_path: Path
) -> None:
    report_file = tmp_path / "report.json"
    scene = load(BLOCK)
    scene.pause()
    done = haptic(*at(server, scene), "--seconds", 0.1, "--json", report_file)
    assert done.returncode == 3
    assert "no feedback answered any pose: the scene is paused" in done.stderr
    assert json.loads(report_file.read_text())["feedback_received"] == 0


# --- a daemon that refuses every pose ---------------------------------------------------------------------------------


class Refusing(control_pb2_grpc.ControlServicer):
    """Steps, answers nobody's pose, and counts every pose as refused."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self._publisher, self._poses = context.socket(zmq.PUB), context.socket(zmq.PULL)
        endpoints = []
        for bound in (self._publisher, self._poses):
            port = bound.bind_to_random_port("tcp://127.0.0.1")
            endpoints.append(f"tcp://127.0.0.1:{port}")
        self._version = control_pb2.GetVersionResponse(
            server="s", zeromq_publish_endpoint=endpoints[0], zeromq_pose_endpoint=endpoints[1]
        )
        self._rejected = 40  # before this run
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._step)
        self._thread.start()

    def stop(self) -> None:
        self._done.set()
        self._thread.join()
        self._publisher.close(linger=0)
        self._poses.close(linger=0)

    def _step(self) -> None:
        key = b"tensormass/s/demo/tool/probe/feedback\0"
        for step in itertools.count(1):
            if self._done.wait(0.01):
                return
            while self._poses.poll(0):
                self._poses.recv()
                self._rejected += 1
            self._publisher.send(key + stream_pb2.ToolFeedback(tool="probe", step=step).SerializeToString())

    def GetVersion(self, request: Any, context: Any) -> control_pb2.GetVersionResponse:  # noqa: ANN401, N802
        return self._version

    def GetTopology(self, request: Any, context: Any) -> control_pb2.GetTopologyResponse:  # noqa: ANN401, N802
        tools = [stream_pb2.ToolShape(name="probe", radius_m=0.01)]
        return control_pb2.GetTopologyResponse(topology=stream_pb2.Topology(scene="demo", tools=tools))

    def GetFrame(self, request: Any, context: Any) -> control_pb2.GetFrameResponse:  # noqa: ANN401, N802
        positions = np.array([[0, 0, 0], [0.2, 0, 0]], "<f4").tobytes()
        return control_pb2.GetFrameResponse(frame=stream_pb2.Frame(positions=positions))

    def GetFeedback(self, request: Any, context: Any) -> control_pb2.GetFeedbackResponse:  # noqa: ANN401, N802
        feedback = stream_pb2.ToolFeedback(tool="probe", position_m=scene_pb2.Vector3(z=0.1))
        return control_pb2.GetFeedbackResponse(feedback=feedback)

    def GetStatus(self, request: Any, context: Any) -> control_pb2.GetStatusResponse:  # noqa: ANN401, N802
        status = stream_pb2.SceneStatus(state=stream_pb2.SceneStatus.STATE_RUNNING, poses_rejected=self._rejected)
        return control_pb2.GetStatusResponse(status=status)


class Recovering(Refusing):
    """Answers every pose, and recovers in every tenth step."""

    def _step(self) -> None:
        key = b"tensormass/s/demo/tool/probe/feedback\0"
        pose = stream_pb2.ToolPose()
        for step in itertools.count(1):
            if self._done.wait(0.01):
                return
            while self._poses.poll(0):
                pose = stream_pb2.ToolPose.FromString(self._poses.recv().partition(b"\0")[2])
            if pose.sequence > 0:
                feedback = stream_pb2.ToolFeedback(
                    tool="probe",
                    step=step,
                    pose_sequence=pose.sequence,
                    client_id=pose.client_id,
                    client_time_ns=pose.client_time_ns,
                    position_m=pose.position_m,
                    recovering=step % 10 == 0,
                )
                self._publisher.send(key + feedback.SerializeToString())


@pytest.fixture
def refusing() -> Iterator[str]:
    """The address of a daemon that refuses every pose."""
    yield from addresses_of(Refusing)


@pytest.fixture
def recovering() -> Iterator[str]:
    """The address of a daemon that recovers in every tenth step."""
    yield from addresses_of(Recovering)


def addresses_of(daemon: type[Refusing]) -> Iterator[str]:
    with zmq.Context() as context:
        servicer = daemon(context)
        server = grpc.server(futures.ThreadPoolExecutor(2))
        control_pb2_grpc.add_ControlServicer_to_server(servicer, server)
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        try:
            yield f"127.0.0.1:{port}"
        finally:
            server.stop(grace=None).wait()
            servicer.stop()


def test_poses_that_are_refused_do_not_look_like_a_paused_scene(refusing: str) -> None:
    done = haptic("--server", refusing, "--seconds", 0.5, "--json", "-")
    report = json.loads(done.stdout)
    assert done.returncode == 3, done.stderr
    assert report["feedback_received"] == 0
    assert report["feedback_foreign"] > 0
    assert "no feedback answered any pose: the server refused" in done.stderr
    refused = int(done.stderr.partition("meanwhile (")[2].partition(")")[0])
    assert 0 < refused <= report["last_sequence_sent"], "not those from before"


def test_recoveries_are_told_at_most_once_a_second(recovering: str) -> None:
    done = haptic("--server", recovering, "--seconds", 2.5, "--json", "-")
    report = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert report["recovering_feedbacks"] >= report["recoveries"] > 5
    told = [line for line in done.stderr.splitlines() if "the scene recovers from a step" in line]
    assert 2 <= len(told) <= 4, "2.5 s, and the wait for the last answer"
    assert "times since" not in told[0]
    assert "times since the last such line" in told[1]
