"""How smoothly the force changes while the probe slides 50 mm over the demo organ: results/slide.jsonl.

python -m accuracy.slide [--backend cpu|cuda] >> accuracy/results/slide.jsonl

The probe follows the organ's surface at rest, at a depth, with 960 steps a second. Its speed rises to 50 mm/s within
0.1 s. A line has the largest change of the force from one step to the next as a share of its mean.
"""

from __future__ import annotations

import argparse
import itertools
import json

import numpy as np

from tensormass._src.launching import launch
from tensormass._src.meshes import FloatArray
from tensormass._src.organ import liver
from tensormass._src.scene import Scene
from tensormass._src.server import Server

from . import record

DT_S, SPEED_M_PER_S, WAY_M = 1 / 960, 0.05, 0.05
START_X_M, Y_M = -0.06, 0.015
DEPTHS_M, FRICTIONS = (0.004, 0.006), (0.0, 0.2)
_SINKS_S, _LOWERS_S, _WAITS_S, _STARTS_S = 0.1, 0.2, 0.2, 0.1


def _top_m(x_m: float) -> float:
    """Returns the height of the organ's top."""
    low, high = 0.0, 0.06
    for _ in range(40):
        middle = (low + high) / 2
        is_inside = liver(np.array([[x_m, Y_M, middle]]))[0] > 0
        low, high = (middle, high) if is_inside else (low, middle)
    return low


def _way_m(time_s: float) -> float:
    """Returns the way after a time: uniformly accelerated for _STARTS_S, then at constant speed."""
    if time_s < _STARTS_S:
        return SPEED_M_PER_S * time_s**2 / (2 * _STARTS_S)
    return SPEED_M_PER_S * (time_s - _STARTS_S / 2)


def slide(server: Server, depth_m: float, friction: float) -> FloatArray:
    """Returns the force of each step, [step, 3] N."""
    scene = Scene.from_file("demo")
    scene.message.stepping.dt_s = DT_S
    (tool,) = scene.message.tools
    tool.friction_coefficient = friction
    tool.max_speed_m_per_s = 1.0
    radius_m = tool.spherical_probe.radius_m

    def at(way_m: float, above_m: float = 0.0) -> tuple[float, float, float]:
        x_m = START_X_M + way_m
        return x_m, Y_M, _top_m(x_m) + radius_m - depth_m + above_m

    forces = []
    with server.load(scene, lockstep=True) as handle:
        handle.step(round(_SINKS_S / DT_S))
        for above_m in np.linspace(0.01, 0, round(_LOWERS_S / DT_S)):
            handle.move_tool(tool.name, at(0, above_m))
            handle.step()
        handle.step(round(_WAITS_S / DT_S))
        for i in range(1, round((WAY_M / SPEED_M_PER_S + _STARTS_S / 2) / DT_S) + 1):
            handle.move_tool(tool.name, at(_way_m(i * DT_S)))
            force = handle.step().tools[0].force_n
            forces.append((force.x, force.y, force.z))
    return np.array(forces)


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    backend = parser.parse_args().backend
    with launch(backend=backend, zenoh=False) as server:
        for depth_m, friction in itertools.product(DEPTHS_M, FRICTIONS):
            forces = slide(server, depth_m, friction)
            mean_n = float(np.linalg.norm(forces, axis=1).mean())
            jumps_n = np.linalg.norm(np.diff(forces, axis=0), axis=1)
            row = {
                "depth_m": depth_m,
                "friction": friction,
                "mean_n": round(mean_n, 4),
                "largest_jump": round(float(jumps_n.max()) / mean_n, 4),
                "p99_jump": round(float(np.quantile(jumps_n, 0.99)) / mean_n, 4),
            }
            where = {"device": server.version().device, "commit": record.commit()}
            print(json.dumps({**row, **where, "command": f"python -m accuracy.slide --backend {backend}"}), flush=True)


if __name__ == "__main__":
    main()
