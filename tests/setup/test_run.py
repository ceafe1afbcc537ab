"""tests/run.sh runs the few C++ tests that failed again, once, and its end says which passed only then."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

RUN = Path(__file__).resolve().parents[1] / "run.sh"
CTEST = shutil.which("ctest")

pytestmark = pytest.mark.skipif(CTEST is None, reason="ctest is not installed")

PASSES = "true"
FAILS = "echo the reason; false"
FAILS_ONCE = "test -e {mark} || { touch {mark}; false; }"
SKIPS = r'printf "%s\n" "a_test.cpp:1: Skipped" "no GPU"'


def run(folder: Path, tests: dict[str, str]) -> tuple[int, str]:
    """The status of `tests/run.sh ctest` for these tests, each a shell command, and what its summary says."""
    (folder / "tests").mkdir()
    shutil.copy(RUN, folder / "tests")
    build = folder / "build"
    build.mkdir()
    lines = []
    for name, command in tests.items():
        (folder / name).write_text(command.replace("{mark}", str(folder / f"{name}.mark")) + "\n", "utf-8")
        lines.append(f'add_test({name} "/bin/sh" "{folder / name}")\n')
    (build / "CTestTestfile.cmake").write_text("".join(lines), "utf-8")
    assert CTEST
    environment = {**os.environ, "PATH": f"{Path(CTEST).parent}:{os.environ['PATH']}", "JOBS": "1", "BUILD": "build"}
    ended = subprocess.run(
        ["bash", str(folder / "tests" / "run.sh"), "ctest"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    return ended.returncode, ended.stdout.partition("==== Summary")[2]


def test_a_test_that_fails_once_is_named(tmp_path: Path) -> None:
    status, summary = run(tmp_path, {"quiet": PASSES, "flaky": FAILS_ONCE, "lacks": SKIPS})
    assert status == 0
    assert "passed only when run again (ctest): flaky\n" in summary
    assert "skipped (ctest): 1: no GPU\n" in summary  # although the log of the first run has been replaced
    assert "FAILED" not in summary


def test_a_test_that_fails_twice_fails_the_run(tmp_path: Path) -> None:
    status, summary = run(tmp_path, {"quiet": PASSES, "flaky": FAILS_ONCE, "broken": FAILS})
    assert status == 1
    assert "FAILED (ctest): broken: Failed\n" in summary
    assert "passed only when run again (ctest): flaky\n" in summary
    assert "FAILED (ctest): flaky" not in summary


def test_many_that_fail_do_not_run_again(tmp_path: Path) -> None:
    status, summary = run(tmp_path, {f"flaky_{n}": FAILS_ONCE for n in range(6)})
    assert status == 1
    assert summary.count("FAILED (ctest): flaky_") == 6
    assert "run again" not in summary


def test_nothing_runs_again_when_all_pass(tmp_path: Path) -> None:
    status, summary = run(tmp_path, {"quiet": PASSES})
    assert status == 0
    assert "run again" not in summary
    assert "FAILED" not in summary
