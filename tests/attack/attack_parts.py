"""What the attacks share: a daemon to attack, a scene, and what a process holds. Without a build they are skipped."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh

sys.path.insert(0, str(Path(__file__).parents[1] / "python"))
import service_parts

import tensormass as tm
from tensormass.v1 import control_pb2

DEADLINE_S = service_parts.DEADLINE_S
MIB = 1 << 20

#: A place of the probe above the block, and one in it.
IN_AIR_M = (0.05, 0.05, 0.09)
IN_TISSUE_M = (0.05, 0.05, 0.055)


def block(name: str = "block") -> tm.Scene:
    """The block of the service's tests, coarser and without weight: attacks are on the server, not on the solver."""
    scene = service_parts.block()
    scene.message.name = name
    scene.message.ClearField("gravity_m_per_s2")
    grid = scene.body("tissue").mesh.grid
    grid.cells_x, grid.cells_y, grid.cells_z = 3, 3, 2
    scene.message.tools[0].position_m.z = IN_AIR_M[2]
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


def cpu_time_of(server: tm.Server, thread: str = "") -> float:
    """Returns the CPU time that the daemon has used, or its threads of this name [s]."""
    assert server.process is not None
    process = Path(f"/proc/{server.process.process.pid}")
    of = [one for one in (process / "task").iterdir() if (one / "comm").read_text().strip() == thread]
    ticks = 0
    for one in of if thread else [process]:
        user, system = (one / "stat").read_text().rpartition(")")[2].split()[11:13]
        ticks += int(user) + int(system)
    return ticks / os.sysconf("SC_CLK_TCK")


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


def count_of(server: tm.Server, family: str, **labels: str) -> float:
    """Returns a counter of the daemon's metrics."""
    start = family + "{" + ",".join(f'{label}="{value}"' for label, value in labels.items()) + "} "
    text = server.call("GetMetrics", control_pb2.GetMetricsRequest()).text
    return float(next(line.removeprefix(start) for line in text.splitlines() if line.startswith(start)))
