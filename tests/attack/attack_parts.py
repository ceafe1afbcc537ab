"""What the attacks share: a daemon to attack, a scene, and what a process holds. Without a build they are skipped."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh

import tensormass as tm
from tensormass._src import processes

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

DEADLINE_S = 60.0
MIB = 1 << 20

# A small block with a probe above its middle: the attacks are on the server, not on the solver.
BLOCK = """
name: block
stepping: {dt_s: 0.005}
bodies:
  - name: tissue
    mesh: {grid: {size_m: {x: 0.1, y: 0.1, z: 0.05}, cells_x: 3, cells_y: 3, cells_z: 2}}
    law: {st_venant_kirchhoff: {young_modulus_pa: 8000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    rayleigh_mass_per_s: 2.0
    rayleigh_stiffness_s: 0.01
    fixed:
      - box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.015}
    position_m: {x: 0.05, y: 0.05, z: 0.09}
"""

#: A place of the probe above the block, and one in it.
IN_AIR_M = (0.05, 0.05, 0.09)
IN_TISSUE_M = (0.05, 0.05, 0.055)


def block(name: str = "block") -> tm.Scene:
    scene = tm.Scene.from_yaml(BLOCK)
    scene.message.name = name
    return scene


@contextlib.contextmanager
def attacked(*options: str, zenoh: bool = False) -> Iterator[tm.Server]:
    """A daemon of its own for an attack."""
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=zenoh, options=options) as server:
        yield server


def wait_for(what: str, condition: Callable[[], bool], deadline_s: float = DEADLINE_S) -> None:
    deadline = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {deadline_s:g} s for {what}"
        time.sleep(0.002)


def memory_of(server: tm.Server, line: str = "VmRSS") -> int:
    """Returns bytes that the daemon holds; VmHWM is the most that it has held."""
    assert server.process is not None
    with open(f"/proc/{server.process.process.pid}/status") as status:
        return next(int(row.split()[1]) * 1024 for row in status if row.startswith(line + ":"))


def restart_high_water_mark(server: tm.Server) -> None:
    """VmHWM counts anew from now on."""
    assert server.process is not None
    with open(f"/proc/{server.process.process.pid}/clear_refs", "w") as clear:
        clear.write("5")


def zenoh_session(server: tm.Server, mode: str = "client") -> zenoh.Session:
    """A session of a stranger, with nothing of the SDK. It has no shared memory, so the daemon must read all bytes."""
    config = zenoh.Config()
    for key, value in {
        "mode": mode,
        "connect/endpoints": [server.version().zenoh_locator],
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)
