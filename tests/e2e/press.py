"""Presses the probe into the demo's organ in lockstep, picture by picture, for the film of pictures.mjs.

    python tests/e2e/press.py --pictures 60 --every 0.1

The first line on stdout is `control HOST:PORT`. Each line on stdin makes the steps of the next picture, and the number
of the last one appears on stdout. The end of stdin ends everything. The motion returns to its start, so the film
repeats without a jump. Lockstep makes the film independent of the machine's speed.
"""

from __future__ import annotations

import argparse
import math
import sys

import tensormass as tm

# The probe's way [m]: down from above the organ, along the surface and back, and up again.
START_M = (-0.03, 0.02, 0.078)
DEPTH_M = 0.033
SLIDE_M = 0.03
RATE_HZ = 60  # steps a second of the demo


def position_m(share: float) -> tuple[float, float, float]:
    """Returns where the probe is after a share of the film, 0 to 1."""
    down = 0.5 - 0.5 * math.cos(math.pi * min(1.0, 4 * min(share, 1 - share)))
    slide = math.sin(2 * math.pi * min(max(2 * share - 0.5, 0.0), 1.0))
    x_m, y_m, z_m = START_M
    return (x_m + 0.5 * SLIDE_M * slide, y_m, z_m - DEPTH_M * down)


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--pictures", type=int, required=True)
    parser.add_argument("--every", type=float, required=True, metavar="S", help="time between two pictures")
    options = parser.parse_args()
    with tm.launch(backend="cpu") as server:
        scene = server.load("demo", lockstep=True)
        steps = round(options.every * RATE_HZ)
        scene.move_tool("probe", START_M)
        scene.step(steps)
        print(f"control {server.address}", flush=True)
        for picture, _ in enumerate(sys.stdin):
            for step in range(steps):
                scene.move_tool("probe", position_m((picture + step / steps) / options.pictures % 1.0))
                status = scene.step()
            print(status.step, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
