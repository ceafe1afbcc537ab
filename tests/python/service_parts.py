"""What the tests with a real daemon share. Without build/bin/tensormassd they are skipped."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes
from tensormass_tools.cli import main

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

DEADLINE_S = 60.0

# A block on a table with a probe above its middle; light enough for a busy machine.
BLOCK = """
name: block
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 5, cells_y: 5, cells_z: 3}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    rayleigh_stiffness_s: 0.01
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.015}
    position_m: {x: 0.05, y: 0.05, z: 0.08}
accepted_findings:
  - {code: softening_law, reason: these tests press little}
  - {code: coarse_surface, reason: few elements make these tests fast}
"""


def block() -> tm.Scene:
    return tm.Scene.from_yaml(BLOCK)


def change_from_two_clients(
    server: tm.Server, scene: tm.SceneHandle, change: Callable[[tm.SceneHandle], object]
) -> None:
    """Lets two clients change the scene at the same time, four times each. A change may be refused.

    Args:
        change: changes the scene, and changes it back.
    """

    def work() -> None:
        with tm.connect(server.address) as client:
            for _ in range(4):
                with contextlib.suppress(tm.AlreadyExistsError, tm.NotFoundError, tm.ResourceExhaustedError):
                    change(client.scene(scene.name))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def record_changes(
    server: tm.Server, scene: tm.SceneHandle, text: str, folder: Path, change: Callable[[tm.SceneHandle], object]
) -> Path:
    """Records three seconds in which another client changes the scene again and again. Checks that a replay agrees.

    Args:
        text: the scene's file.
        change: changes the scene, and changes it back.
    """
    scene_file, path = folder / "scene.yaml", folder / "changes.mcap"
    scene_file.write_text(text)
    ends = threading.Event()

    def work() -> None:
        with tm.connect(server.address) as client:
            other = client.scene(scene.name)
            while not ends.is_set():
                change(other)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        arguments = ["record", str(scene_file), "--attach", scene.name, "--server", server.address, "--frames"]
        assert main([*arguments, "-o", str(path), "--seconds", "3", "--check-every", "20"]) == 0
    finally:
        ends.set()
        thread.join()
    assert main(["replay", str(path)]) == 0
    return path
