"""Runs examples/haptic/haptic_client against a daemon on free ports. Skipped if a program is not built."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes

BLOCK = """
name: block
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 4, cells_y: 4, cells_z: 2}}
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


@pytest.fixture(scope="module")
def program() -> Path:
    try:
        return processes.find_program("haptic_client", "TENSORMASS_HAPTIC_EXAMPLE")
    except tm.NotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as error:
        pytest.skip(str(error))
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server


def run(program: Path, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in (program, *words)], capture_output=True, text=True, timeout=60, check=False
    )


def test_the_example_presses_the_tissue_and_prints_the_largest_force(program: Path, server: tm.Server) -> None:
    scene = server.load(tm.Scene.from_yaml(BLOCK), name="pressed")
    done = run(program, server.address, scene.name, "probe", 2)
    scene.unload()
    assert done.returncode == 0, done.stderr
    words = re.fullmatch(r"largest force: (\S+) N in (\d+) ticks\n", done.stdout)
    assert words is not None, done.stdout
    assert 0.01 < float(words[1]) <= 3.0, "pressed, and within the device's largest force"
    assert int(words[2]) > 200, "a loop at 1 kHz for 2 s, on a machine that may be busy"


def test_the_example_ends_with_an_error_if_no_pose_is_answered(program: Path, server: tm.Server) -> None:
    scene = server.load(tm.Scene.from_yaml(BLOCK), name="paused")
    scene.pause()
    done = run(program, server.address, scene.name, "probe", 0.1)
    scene.unload()
    assert done.returncode == 3
    assert "no feedback" in done.stderr


def test_the_example_names_the_tool_that_the_scene_lacks(program: Path, server: tm.Server) -> None:
    scene = server.load(tm.Scene.from_yaml(BLOCK), name="wrong")
    done = run(program, server.address, scene.name, "scalpel", 1)
    scene.unload()
    assert done.returncode == 1
    assert "has no tool scalpel; it has probe" in done.stderr
