"""What `make build` says while it compiles, and in how many jobs: Ninja is a program of the test."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def build() -> ModuleType:
    spec = importlib.util.spec_from_file_location("build_progress", ROOT / ".setup/build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def said(build: ModuleType, folder: Path, program: str, period_s: float = 3600.0) -> tuple[int, list[str]]:
    lines: list[str] = []
    status = build.run([sys.executable, "-c", program], build.Progress(folder), lines.append, period_s=period_s)
    return status, lines


def test_steps_are_counted_and_what_compilers_print_is_passed_on(build: ModuleType, tmp_path: Path) -> None:
    program = "print('[1/2] Building a.o'); print('a.cpp:1: warning: x'); print('[2/2] Linking b')"
    status, lines = said(build, tmp_path, program)
    assert status == 0
    assert lines[0] == "a.cpp:1: warning: x"
    assert lines[1].startswith("build: 2 of 2 steps, ")
    assert len(lines) == 2


def test_a_long_step_does_not_leave_the_terminal_silent(build: ModuleType, tmp_path: Path) -> None:
    # The program goes on until it has been spoken of, so the test needs no clock.
    flag = tmp_path / "said"
    program = f"import os\nprint('[3/9] Building a.o', flush=True)\nwhile not os.path.exists({str(flag)!r}): pass"
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        if "3 of 9" in line:
            flag.touch()

    assert build.run([sys.executable, "-c", program], build.Progress(tmp_path), say, period_s=0.01) == 0
    assert any(line.startswith("build: 3 of 9 steps") for line in lines)


def test_crates_of_zenoh_are_counted_while_cargo_runs(build: ModuleType, tmp_path: Path) -> None:
    cargo = tmp_path / "server/bus/zenoh"
    cargo.mkdir(parents=True)
    (cargo / "cargo.log").write_text("   Compiling old v1.0.0\n")
    os.utime(cargo / "cargo.log", (1, 1))
    assert "crates" not in build.Progress(tmp_path).text(), "a log of an earlier build"
    progress = build.Progress(tmp_path)
    (cargo / "crates.txt").write_text("40\n")
    (cargo / "cargo.log").write_text("  Downloaded a v1\n   Compiling a v1.0.0\n   Compiling b v2.0.0 (proc-macro)\n")
    assert progress.text().endswith("2 of 40 crates of zenoh")


def test_a_failure_is_the_exit_status_and_the_last_line(build: ModuleType, tmp_path: Path) -> None:
    program = "print('[1/2] Building a.o'); print('FAILED: a.o'); print('a.cpp:1: error: y'); raise SystemExit(1)"
    status, lines = said(build, tmp_path, program)
    assert status == 1
    assert lines[:2] == ["FAILED: a.o", "a.cpp:1: error: y"]
    assert lines[-1].endswith("FAILED")


def test_nothing_to_do_says_nothing(build: ModuleType, tmp_path: Path) -> None:
    assert said(build, tmp_path, "print('ninja: Entering directory `build\\''); print('ninja: no work to do.')") == (
        0,
        [],
    )


def test_a_quota_of_the_container_bounds_the_jobs(tmp_path: Path) -> None:
    def cores(cpu_max: str) -> int:
        (tmp_path / "cpu.max").write_text(cpu_max)
        done = subprocess.run([ROOT / ".setup/cores.sh", tmp_path / "cpu.max"], capture_output=True, check=True)
        return int(done.stdout)

    here = cores("max 100000\n")
    assert here >= 1
    assert cores("100000 100000\n") == 1
    assert cores("150000 100000\n") == min(2, here)
    assert cores("1000 100000\n") == 1
    assert cores(f"{100_000 * (here + 1)} 100000\n") == here
    assert cores("nonsense\n") == here
