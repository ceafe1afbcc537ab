"""How our programs are compiled: what an error in memory cannot do to them."""

from __future__ import annotations

import shutil
import subprocess

import pytest

import tensormass as tm
from tensormass._shared import processes


@pytest.fixture(params=[("tensormassd", "TENSORMASSD"), ("tensormass-haptic", "TENSORMASS_HAPTIC")], ids=lambda p: p[0])
def program(request: pytest.FixtureRequest) -> str:
    if shutil.which("readelf") is None:
        pytest.skip("there is no readelf")
    try:
        return str(processes.find_program(*request.param))
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))


def readelf(program: str, *options: str) -> str:
    return subprocess.run(["readelf", "-W", *options, program], check=True, capture_output=True, text=True).stdout


def test_addresses_are_random_and_read_only(program: str) -> None:
    assert "DYN (Position-Independent Executable file)" in readelf(program, "-h")
    segments = [line.split() for line in readelf(program, "-l").splitlines()]
    assert [line[6] for line in segments if line[:1] == ["GNU_STACK"]] == ["RW"]
    assert any(line[:1] == ["GNU_RELRO"] for line in segments)
    flags = [line for line in readelf(program, "-d").splitlines() if "(FLAGS" in line]
    assert any("NOW" in line for line in flags), flags


def test_stack_and_copies_are_checked(program: str) -> None:
    undefined = [line.partition(" UND ")[2] for line in readelf(program, "--dyn-syms").splitlines() if " UND " in line]
    symbols = {name.partition("@")[0].strip() for name in undefined}
    assert "__stack_chk_fail" in symbols
    assert [name for name in symbols if name.startswith("__") and name.endswith("_chk")], symbols
