"""Commands find programs and viewer in an installed wheel, in a checkout, or on PATH."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes
from tensormass_gateway import options
from tensormass_tools import programs

NAME = "tensormassd"
VARIABLE = "TENSORMASSD"


def make_program(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / NAME
    program.write_text('#!/bin/sh\necho "$0" "$@"\n')
    program.chmod(0o755)
    return program


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Moves every searched place into an empty folder."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(processes, "BUNDLE", tmp_path / "bundle")
    monkeypatch.setattr(options, "BUNDLE", tmp_path / "bundle")
    monkeypatch.setattr(programs, "BUNDLE", tmp_path / "bundle")
    monkeypatch.setattr(processes, "BUILD_BIN", tmp_path / "build")
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    return tmp_path


def test_a_program_is_found_in_order(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("path", "build", "bundle"):  # each before the one that was made earlier
        made = make_program(places / folder)
        assert processes.find_program(NAME, VARIABLE) == made
    named = make_program(places / "named")
    monkeypatch.setenv(VARIABLE, str(named))
    assert processes.find_program(NAME, VARIABLE) == named


def test_a_file_that_cannot_run_is_passed_over(places: Path) -> None:
    make_program(places / "bundle").chmod(0o644)
    built = make_program(places / "build")
    assert processes.find_program(NAME, VARIABLE) == built


def test_a_missing_program_names_what_to_do(places: Path) -> None:
    with pytest.raises(tm.NotFoundError, match=r"tensormassd is not built: not in .*build.*make wheel.*\$TENSORMASSD"):
        processes.find_program(NAME, VARIABLE)


def test_the_viewer_of_a_wheel_comes_first(places: Path) -> None:
    assert options.find_viewer().parts[-2:] == ("web", "dist")
    (places / "bundle" / "viewer").mkdir(parents=True)
    assert options.find_viewer() == places / "bundle" / "viewer"


def test_a_command_of_the_wheel_becomes_its_program(tmp_path: Path) -> None:
    bundle = tmp_path / "bundle"
    code = f"from pathlib import Path; from tensormass_tools import programs; programs.BUNDLE = Path({str(bundle)!r}); "
    command = [sys.executable, "-c", code + "programs.daemon()", "--version"]
    path = os.pathsep.join([str(make_program(tmp_path / "path").parent), os.environ["PATH"]])
    environment = os.environ | {"PATH": path}

    missing = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert missing.returncode == 1, "PATH may hold this command itself"
    assert f"tensormassd: not in {bundle}" in missing.stderr

    program = make_program(bundle)
    found = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.split() == [str(program), "--version"]
