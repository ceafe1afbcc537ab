"""The daemon and the commands as processes: how they start, what they print, how they end."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from daemon_parts import make_viewer
from service_parts import BLOCK, DEADLINE_S, block
from test_client import wait_until

import tensormass as tm
from tensormass._shared import processes


def test_launch_ends_its_daemon_cleanly() -> None:
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        server.load(block(), name="block")
        assert server.process is not None
        process = server.process.process
        log_file = server.log_file
        assert process.poll() is None
    assert process.returncode == 0
    assert log_file is not None
    assert not log_file.exists()
    with pytest.raises(tm.UnavailableError):
        server.version()


def test_a_wrong_flag_is_reported() -> None:
    with pytest.raises(tm.UnavailableError, match="no-such-flag"):
        tm.launch(backend="cpu", options=["--no-such-flag"])


def command(*args: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tensormass", *args], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_inspect_works_without_a_daemon() -> None:
    with command("inspect", "beam", "--backend", "cpu", "--json") as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    report = json.loads(out)
    assert report["bodies"][0]["element_count"] == 20160
    assert any("conjugate gradients" in stage["name"] for stage in report["stages"])


def test_a_scripted_hand_moves_a_tool_and_lets_go(tmp_path: Path) -> None:
    script = tmp_path / "press.yaml"
    script.write_text("""
tool: probe
poses:
  - {time_s: 0, position_m: {x: 0.05, y: 0.05, z: 0.08}}
  - {time_s: 0.5, position_m: {x: 0.05, y: 0.05, z: 0.055}}
  - {time_s: 100, position_m: {x: 0.05, y: 0.05, z: 0.055}}
""")
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        scene = server.load(block(), name="block")
        with command("hand", str(script), "--scene", "block", "--server", server.address) as process:
            wait_until(lambda: process.poll() is not None or scene.feedback("probe").force_n[2] > 0.05)
            process.send_signal(signal.SIGTERM)
            _, err = process.communicate(timeout=DEADLINE_S)
        assert process.returncode == 143, err
        wait_until(lambda: scene.feedback("probe").retired)
        assert scene.feedback("probe").force_n[2] == 0


def test_run_steps_reports_and_ends_on_ctrl_c(tmp_path: Path, runtime_folder: Path) -> None:
    scene_file = tmp_path / "block.yaml"
    scene_file.write_text(BLOCK)
    options = ["--backend", "cpu", "--no-viewer", "--json"]
    try:
        processes.find_program("tensormass-haptic", "TENSORMASS_HAPTIC")
    except tm.NotFoundError:
        options.append("--no-haptic")
    with command("run", str(scene_file), *options) as process:
        try:
            assert process.stdout is not None
            lines = map(json.loads, process.stdout)
            with tm.connect(next(lines)["control"]) as client:
                assert [status.scene for status in client.scenes()] == ["block"]
            said = next(said for said in lines if said["status"]["step"] > 20)
            assert said["status"]["scene"] == "block"
            assert said["status"]["state"] == "STATE_RUNNING"
            with command("list") as listing:  # finds that daemon, which listens on a free port
                assert "\nblock  running  step " in listing.communicate(timeout=60)[0]
            children = children_of(process.pid)
            assert any("tensormassd" in name for name in children.values())
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
    assert (process.returncode, err) == (0, "")
    assert list(runtime_folder.iterdir()) == []
    for pid in children:
        assert not Path(f"/proc/{pid}").exists(), f"{children[pid]} is left running"


def test_the_address_that_run_prints_leads_to_a_frame(tmp_path: Path, runtime_folder: Path) -> None:
    scene_file = tmp_path / "block.yaml"
    scene_file.write_text(BLOCK)
    options = ["--backend", "cpu", "--no-haptic", "--viewer", str(make_viewer(tmp_path / "dist")), "--json"]
    with command("run", str(scene_file), *options) as process:
        try:
            assert process.stdout is not None
            address = next(map(json.loads, process.stdout))["viewer"]
            # As a newcomer's wait is measured (tests/setup/from_nothing.py).
            first_frame = Path(__file__).parents[1] / "setup" / "first_frame.py"
            seen = subprocess.run([sys.executable, first_frame, address], capture_output=True, text=True, timeout=120)
            assert seen.returncode == 0, seen.stderr
            assert int(seen.stdout) > 1000
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=DEADLINE_S)


def test_run_says_a_warning_once(tmp_path: Path) -> None:
    scene_file = tmp_path / "scene.yaml"
    # A linear law under a load that it is not made for, and its status looked at several times.
    scene_file.write_text(BLOCK.replace("st_venant_kirchhoff", "hooke").replace("z: -9.81", "z: -2000"))
    options = ["--backend", "cpu", "--no-viewer", "--no-haptic", "--seconds", "3"]
    run_module = "import sys; from tensormass_tools import cli, run; run._LOG_PERIOD_S = 0.5; sys.exit(cli.main())"
    with subprocess.Popen(
        [sys.executable, "-c", run_module, "run", str(scene_file), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    lines = out.splitlines()
    assert sum("Hz" in line for line in lines) >= 3
    assert sum(line.startswith("warning: body 'tissue': hooke has left its range") for line in lines) == 1


def children_of(parent: int) -> dict[int, str]:
    """Names by process id."""
    children = {}
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError, ValueError):
            name, _, rest = (entry / "stat").read_text().partition(" (")[2].rpartition(") ")
            if int(rest.split()[1]) == parent:
                children[int(entry.name)] = name
    return children
