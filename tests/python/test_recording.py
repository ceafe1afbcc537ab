"""Recording and replaying a scene of a real daemon, and its snapshots."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from service_parts import BLOCK, DEADLINE_S, block

import tensormass as tm
from tensormass.v1 import recording_pb2
from tensormass_tools.cli import main
from tensormass_tools.recording.file import Entry, RecordingReader, RecordingWriter
from tensormass_tools.recording.replay import batches

# Two threads share it: see kMinNodesPerThread in cpu_backend.cpp.
LARGE = BLOCK.replace("cells_x: 5, cells_y: 5, cells_z: 3", "cells_x: 12, cells_y: 12, cells_z: 8")


@contextlib.contextmanager
def recording(path: Path, *args: str) -> Iterator[subprocess.Popen[str]]:
    """Runs `tensormass record` in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tensormass", "record", str(path.parent / "block.yaml"), "-o", str(path), *args],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        # A shell's background job ignores Ctrl-C, and so would this process.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def command(*args: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    status = main([*args, "--json"])
    return status, json.loads(capsys.readouterr().out)


def wait_for_steps(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 3 * DEADLINE_S
    while time.monotonic() < deadline:
        with contextlib.suppress(tm.TensormassError):
            if sum(entry.channel == "/inputs" for entry in RecordingReader(path).entries()) >= count:
                return
        if process.poll() is not None:
            pytest.fail(f"`tensormass record` ended: {''.join(process.communicate())}")
        time.sleep(0.05)
    process.kill()
    pytest.fail(f"{path} has not got {count} steps; it said {''.join(process.communicate())}")


def wait_for_step(scene: tm.SceneHandle, step: int) -> None:
    deadline = time.monotonic() + 3 * DEADLINE_S
    while scene.status().step < step:
        assert time.monotonic() < deadline, f"the scene does not come to step {step}"
        time.sleep(0.02)


def wait_for_reset(path: Path) -> None:
    deadline = time.monotonic() + 3 * DEADLINE_S
    while not any(entry.channel == "/inputs" and entry.message.reset for entry in RecordingReader(path).entries()):
        assert time.monotonic() < deadline, f"{path} has no reset"
        time.sleep(0.05)


def address_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if "control " not in line:
        pytest.fail(f"`tensormass record` ended: {line}{process.communicate()[1]}")
    return line.rpartition("control ")[2].strip()


def move_at_random(address: str, seed: int, ends: threading.Event) -> None:
    """A client that presses and drags the probe."""
    random = np.random.default_rng(seed)
    with tm.connect(address) as server:
        scene = server.scene("block")
        # Without valid_for_s nobody claims the probe, so that both move it.
        with scene.tool_stream("probe") as poses:
            while not ends.is_set():
                poses.send(random.uniform([0.03, 0.03, 0.05], [0.07, 0.07, 0.07]))
                time.sleep(0.004)


def press(address: str, ends: threading.Event) -> None:
    """A client that presses the probe up and down."""
    with tm.connect(address) as server:
        poses = server.scene("edited").tool_stream("probe")
        with poses:
            begin_s = time.monotonic()
            while not ends.is_set():
                poses.send((0.05, 0.05, 0.06 + 0.01 * np.sin(10 * (time.monotonic() - begin_s))))
                time.sleep(0.004)


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "block.yaml"
    path.write_text(BLOCK)
    return path


def test_a_scene_in_lockstep_is_repeated_to_the_last_bit(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scene_file.with_name("block.mcap")
    record = ["record", str(scene_file), "-o", str(path), "--lockstep", "--steps", "1200", "--backend", "cpu"]
    status, said = command(*record, "--check-every", "50", capsys=capsys)
    assert (status, said["steps"], said["checks"], said["lost_steps"]) == (0, 1200, 24, 0)
    status, said = command("replay", str(path), capsys=capsys)
    assert (status, said["steps"], said["checks"], said["equal_hashes"]) == (0, 1200, 24, 24)
    assert said["exact"]
    assert not said["cut_off"]


def test_steps_of_a_recovery_are_marked_and_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "blow.yaml"
    # A blow of 30 ms moves nodes by more than they may.
    path.write_text(
        BLOCK
        + "gravity_schedule: {time_s: [0.052, 0.053, 0.082, 0.083], factor: [0.1, 8, 8, 0.1]}\n"
        + "guard: {max_move_m: 6.0e-4, on_fault: go_on}\n"
    )
    output = str(tmp_path / "blow.mcap")
    record = ["record", str(path), "-o", output, "--lockstep", "--steps", "40", "--backend", "cpu"]
    status, said = command(*record, "--check-every", "5", capsys=capsys)
    assert status == 0
    steps = [entry.message for entry in RecordingReader(Path(output)).entries() if entry.channel == "/inputs"]
    recovered = [step.index for step in steps if step.recovered]
    assert recovered[0] == 11
    assert len(recovered) == said["recovered_steps"] < 20
    assert not steps[-1].recovered
    status, said = command("replay", output, capsys=capsys)
    assert (status, said["exact"], said["equal_hashes"]) == (0, True, 8)
    assert said["largest_displacement_m"] > 1e-4


def test_two_clients_and_a_kill_leave_a_recording_that_replays(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scene_file.with_name("block.mcap")
    ends = threading.Event()
    with recording(path, "--backend", "cpu", "--check-every", "20", "--frames") as process:
        address = address_of(process)
        clients = [threading.Thread(target=move_at_random, args=(address, seed, ends)) for seed in (1, 2)]
        for client in clients:
            client.start()
        try:
            wait_for_steps(path, 400, process)
        finally:
            ends.set()
            for client in clients:
                client.join()
        process.send_signal(signal.SIGKILL)
        process.wait()
    reader = RecordingReader(path)
    assert reader.cut_off
    kinds = {entry.channel for entry in reader.entries()}
    assert kinds >= {"/scene", "/start", "/inputs", "/checks", "/status", "/topology", "/frames"}
    clients_seen = {
        pose.client_id for entry in reader.entries() if entry.channel == "/inputs" for pose in entry.message.poses
    }
    assert len(clients_seen) == 2
    status, said = command("replay", str(path), capsys=capsys)
    assert status == 0
    assert said["steps"] >= 400
    assert said["checks"] == said["equal_hashes"] >= 15
    assert said["cut_off"]


def test_a_recording_says_how_it_ends_and_that_it_lacks_checks(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scene_file.with_name("block.mcap")
    record = ["record", str(scene_file), "-o", str(path), "--backend", "cpu"]
    assert main([*record, "--lockstep", "--steps", "4"]) == 0
    said = capsys.readouterr().out
    assert f"recording block to {path}, control " in said
    assert "4 steps, 0 checks\nwithout checks a replay compares nothing; record more steps" in said
    with recording(path, "--backend", "cpu") as process:
        assert process.stdout is not None
        assert f" to {path} until Ctrl-C, control " in process.stdout.readline()


def test_ctrl_c_ends_a_recording_properly(scene_file: Path) -> None:
    path = scene_file.with_name("block.mcap")
    with recording(path, "--backend", "cpu", "--json") as process:
        wait_for_steps(path, 20, process)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, err) == (0, "")
    assert not RecordingReader(path).cut_off
    with path.open("rb") as file:
        assert json.loads(out)["steps"] == len(list(make_reader(file).iter_messages(topics=["/inputs"])))


def test_a_loaded_scene_is_recorded_from_where_it_is(
    server: tm.Server, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = scene_file.with_name("block.mcap")
    with server.load(block(), name="running") as scene:
        scene.move_tool("probe", (0.05, 0.05, 0.055))
        while scene.status().step < 50:
            time.sleep(0.01)
        attach = ["--attach", "running", "--server", server.address, "--steps", "200", "--check-every", "40"]
        status, said = command("record", str(scene_file), "-o", str(path), *attach, capsys=capsys)
        assert (status, said["lost_steps"]) == (0, 0)
        assert scene.status().step >= 250, "it goes on"
    assert RecordingReader(path).start.step >= 50
    status, said = command("replay", str(path), "--server", server.address, capsys=capsys)
    assert status == 0
    assert said["checks"] == said["equal_hashes"] >= 5
    assert server.scenes() == []


def test_a_replay_holds_no_more_edits_than_a_step_can_have() -> None:
    class Endless(RecordingReader):
        def __init__(self) -> None:
            self.path = Path("endless.mcap")

        def entries(self) -> Iterator[Entry]:
            while True:
                yield Entry("/edits", recording_pb2.RecordedEdit(index=7, restore=b"state"))

    with pytest.raises(tm.ResourceExhaustedError, match="more than 67 edits before step 7"):
        next(batches(Endless()))


@pytest.mark.parametrize("precision", ["PRECISION_FLOAT", "PRECISION_DOUBLE"])
def test_edits_are_recorded_and_repeated_to_the_last_bit(
    precision: str, server: tm.Server, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A scene that was adjusted before is adjusted twice more while its tool moves, restored and reset."""
    text = BLOCK + f"solver: {{precision: {precision}}}\n"
    scene_file.write_text(text)
    path = scene_file.with_name("block.mcap")
    record = ["record", str(scene_file), "-o", str(path), "--attach", "edited", "--server", server.address]
    with contextlib.ExitStack() as last:
        with server.load(tm.Scene.from_yaml(text), name="edited") as scene:
            scene.adjust(gravity_m_per_s2=(0, 0, -5))
            process = last.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "tensormass", *record, "--check-every", "5", "--frames", "--json"],
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
            last.callback(process.kill)
            ends = threading.Event()
            hand = threading.Thread(target=press, args=(server.address, ends))
            try:
                wait_for_steps(path, 1, process)
                hand.start()
                before = scene.status().poses_received
                # Changes that come at once, also while the tool touches.
                scene.adjust(stiffness_factor={"tissue": 1.2}, rayleigh_mass_per_s={"tissue": 4})
                wait_for_step(scene, scene.status().step + 40)
                snapshot = scene.snapshot()
                scene.adjust(stiffness_factor={"tissue": 1})
                with pytest.raises(tm.FailedPreconditionError, match="or of other values"):
                    scene.restore(snapshot)
                scene.adjust(stiffness_factor={"tissue": 1.2})
                wait_for_step(scene, scene.restore(snapshot).step + 40)
                scene.reset()
                wait_for_step(scene, 40)
                wait_for_reset(path)
                assert scene.status().poses_received > before
            finally:
                ends.set()
                if hand.ident is not None:
                    hand.join()
        # The recording ends with the scene.
        said = json.loads(process.communicate(timeout=DEADLINE_S)[0])
    reader = RecordingReader(path)
    assert reader.start.adjustments.gravity_m_per_s2.z == -5
    edits = [entry.message.WhichOneof("edit") for entry in reader.entries() if entry.channel == "/edits"]
    assert len(edits) == said["edits"]
    assert edits[0] == "adjust"
    assert edits[-1] == "reset"
    assert edits.count("restore") == 1
    assert edits.count("adjust") in (2, 3)  # two of them may have had no step in between
    status, said = command("replay", str(path), "--server", server.address, capsys=capsys)
    assert (status, said["exact"], said["edits"]) == (0, True, len(edits))
    assert said["equal_hashes"] == said["checks"] > 30
    assert main(["replay", str(path), "--server", server.address]) == 0
    assert f" with {len(edits)} edits: " in capsys.readouterr().out


def test_another_layout_is_compared_within_a_tolerance(
    tmp_path: Path, scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene_file.write_text(LARGE)
    path = scene_file.with_name("block.mcap")
    record = ["record", str(scene_file), "-o", str(path), "--lockstep", "--steps", "200", "--backend", "cpu"]
    assert main([*record, "--cpu-threads", "1"]) == 0
    status, said = command("replay", str(path), "--cpu-threads", "2", capsys=capsys)
    assert (status, said["exact"], said["checks"]) == (0, False, 2)
    assert said["equal_hashes"] == 0, "sums are rounded in another order"
    assert 0 < said["worst_m"] < said["tolerance"] * said["largest_displacement_m"]
    status, said = command("replay", str(path), "--cpu-threads", "2", "--tolerance", "1e-12", capsys=capsys)
    assert status == 1
    assert said["failed_steps"] == [100, 200]


def changed(path: Path, change: Any) -> Path:  # noqa: ANN401
    """Copies a recording message by message. change: (channel, message) -> whether the message stays."""
    copy = path.with_name("changed.mcap")
    with RecordingWriter(copy) as writer:
        for entry in RecordingReader(path).entries():
            if change(entry.channel, entry.message):
                writer.add(entry.channel, entry.message)
    return copy


def test_what_differs_is_found(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = scene_file.with_name("block.mcap")
    record = ["record", str(scene_file), "-o", str(path), "--lockstep", "--steps", "300", "--backend", "cpu"]
    assert main(record) == 0

    def flip(channel: str, message: Any) -> bool:  # noqa: ANN401
        if channel == "/checks" and message.index == 200:
            message.hash ^= 1
        return True

    status, said = command("replay", str(changed(path, flip)), capsys=capsys)
    assert (status, said["failed_steps"]) == (1, [200])

    def lose(channel: str, message: Any) -> bool:  # noqa: ANN401
        return not (channel == "/inputs" and message.index == 150)

    status, said = command("replay", str(changed(path, lose)), capsys=capsys)
    assert (status, said["steps"]) == (1, 149)
    assert said["lost"] == "step 150 and others up to 150 are lost in the recording"

    def soften(channel: str, message: Any) -> bool:  # noqa: ANN401
        if channel == "/scene":
            message.bodies[0].law.st_venant_kirchhoff.young_modulus_pa = 7000
        return True

    status, said = command("replay", str(changed(path, soften)), capsys=capsys)
    assert status == 1
    assert "the recording is of another scene than the loaded 'block'" in said["error"]

    status, said = command("replay", str(changed(path, lambda channel, _: channel != "/checks")), capsys=capsys)
    assert (status, said["checks"]) == (1, 0)


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["-o", "out.txt"], "must end in .mcap"),
        (["-o", "out.mcap", "--steps", "0"], "--steps 0"),
        (["-o", "out.mcap", "--seconds", "nan"], "--seconds nan"),
        (["-o", "out.mcap", "--check-every", "-1"], "--check-every -1"),
        (["-o", "out.mcap", "--attach", "x"], "--attach needs --server"),
    ],
)
def test_bad_options_are_refused(
    args: list[str], says: str, scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scene_file.parent)
    status, said = command("record", str(scene_file), *args, capsys=capsys)
    assert status == 1
    assert says in said["error"]


def test_a_snapshot_goes_on_from_bytes_and_from_a_file(server: tm.Server, tmp_path: Path) -> None:
    path = tmp_path / "block.tmsnap"
    with server.load(block(), lockstep=True) as scene:
        scene.move_tool("probe", (0.05, 0.05, 0.055))
        scene.step(40)
        path.write_bytes(scene.snapshot())
        scene.step(40)
        once = scene.positions("tissue")
        assert scene.restore(path).step == 40
        scene.step(40)
        np.testing.assert_array_equal(scene.positions("tissue"), once)
        assert scene.restore(path.read_bytes()).step == 40
        with pytest.raises(tm.InvalidArgumentError, match="cut off or damaged"):
            scene.restore(path.read_bytes()[:-1])
        with pytest.raises(tm.NotFoundError, match=r"none\.tmsnap: No such file"):
            scene.restore(tmp_path / "none.tmsnap")
    softer = block()
    softer.message.bodies[0].density_kg_per_m3 = 900
    with (
        server.load(softer, lockstep=True) as other,
        pytest.raises(tm.FailedPreconditionError, match="it is of another scene"),
    ):
        other.restore(path)
