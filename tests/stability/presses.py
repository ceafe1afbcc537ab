"""Straight presses of the demo's probe from above through the whole organ, at a hand's speeds.

python -m stability.presses [--backend cpu|cuda] [--write FILE]

Each press goes on to its end, with a force that stays below the tool's largest and that no step changes by more than
15 % of it.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import tensormass as tm
from tensormass._shared import defaults

from . import csv_rows

SPEEDS_M_PER_S = (0.02, 0.1, 0.25, 0.5)
RATE_HZ = 960
#: The probe starts and ends this far from the organ's middle, above and below.
FROM_M, TO_M = 0.085, -0.1
LARGEST_JUMP = 0.15


@dataclass
class Press:
    """One press. Steps count from its start."""

    backend: str
    speed_m_per_s: float
    steps: int
    largest_force_n: float
    largest_change_n: float
    at_step: int
    recoveries: int
    recovering_steps: int
    held_steps: int
    verdict: str


def run_press(server: tm.Server, backend: str, speed_m_per_s: float) -> Press:
    """Presses once, in lockstep."""
    scene = tm.Scene.from_file("demo")
    scene.message.stepping.dt_s = 1 / RATE_HZ
    tool = scene.message.tools[0]
    tool.position_m.z = FROM_M
    largest_n = defaults.largest_loads(tool)[0]
    steps = round((FROM_M - TO_M) / speed_m_per_s * RATE_HZ)
    forces = np.zeros((steps + 1, 3))
    verdict = "goes on"
    with server.load(scene, lockstep=True) as handle:
        try:
            for step in range(1, steps + 1):
                place = (tool.position_m.x, tool.position_m.y, FROM_M - step * speed_m_per_s / RATE_HZ)
                force = handle.follow(tool.name, [(place, None, ())]).tools[0].force_n
                forces[step] = force.x, force.y, force.z
        except tm.TensormassError as stop:
            verdict = f"stopped: {stop}"[:200]
        status = handle.status()
    changes = np.linalg.norm(np.diff(forces, axis=0), axis=1)
    largest = float(np.linalg.norm(forces, axis=1).max())
    if verdict == "goes on" and largest > largest_n:
        verdict = "beyond the largest force"
    elif verdict == "goes on" and changes.max() > LARGEST_JUMP * largest_n:
        verdict = "the force jumps"
    return Press(
        backend=backend,
        speed_m_per_s=speed_m_per_s,
        steps=steps,
        largest_force_n=round(largest, 3),
        largest_change_n=round(float(changes.max()), 3),
        at_step=int(changes.argmax()) + 1,
        recoveries=status.recoveries,
        recovering_steps=status.recovering_steps,
        held_steps=status.held_steps,
        verdict=verdict,
    )


def main() -> int:
    """Makes the presses and prints a row for each."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m stability.presses", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--write", type=Path, help="CSV file for the rows")
    arguments = parser.parse_args()
    rows = []
    with tm.launch(backend=arguments.backend, zenoh=False) as server:
        for speed in SPEEDS_M_PER_S:
            rows.append(run_press(server, arguments.backend, speed))
            print(rows[-1], flush=True)
    if arguments.write:
        csv_rows.write(arguments.write, rows)
    return int(any(row.verdict != "goes on" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
