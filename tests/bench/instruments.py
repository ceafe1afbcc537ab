"""What an instrument costs: the steps of each built-in scene with a scripted hand, with its instrument and without.

    python tests/bench/instruments.py [--backend cuda] [--commit HASH] >> tests/bench/results/instruments.jsonl

The scenes are those that `tensormass run` shows on the backend. Each is stepped in lockstep through one period of its
hand, and for as long without its instrument. The two take turns of 1024 steps, over which the daemon keeps the step
times.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from typing import Any

import tensormass as tm
from tensormass._src.demo import builtin_scenes
from tensormass_tools.hand import HandScript, script_of
from tensormass_tools.presets import read_for_backend

#: The daemon keeps the times of so many steps (SceneStatus.step_time_p50_s).
_TURN = 1024


def _scene(name: str, backend: str) -> tm.Scene:
    return read_for_backend(name, backend) or tm.Scene.from_file(name)


def _measure(server: tm.Server, name: str, backend: str) -> dict[str, Any]:
    path = script_of(name)
    assert path is not None
    script = HandScript.read(path)
    alone = _scene(name, backend)
    for tool in [tool for tool in alone.message.tools if not tool.fixed]:
        alone.message.tools.remove(tool)  # obstacles stay: without its table an organ would fall for ever
    times: dict[str, list[tuple[float, float]]] = {"touched": [], "alone": []}
    force_n = 0.0
    with (
        server.load(_scene(name, backend), name=name, lockstep=True) as touched,
        server.load(alone, name=f"{name}-alone", lockstep=True) as untouched,
    ):
        dt_s = alone.message.stepping.dt_s if alone.message.stepping.HasField("dt_s") else 1 / 60
        turns = max(1, round(float(script.times_s[-1]) / dt_s / _TURN))
        for turn in range(turns):
            for step in range(_TURN):
                touched.move_tool(script.tool, *script.at((turn * _TURN + step) * dt_s))
                felt = next(tool for tool in touched.step().tools if tool.tool == script.tool)
                force_n = max(force_n, math.hypot(felt.force_n.x, felt.force_n.y, felt.force_n.z))
            untouched.step(_TURN)
            for key, handle in (("touched", touched), ("alone", untouched)):
                status = handle.status()
                times[key].append((1e3 * status.step_time_p50_s, 1e3 * status.step_time_p99_s))
        warnings = list(touched.status().warnings)
        assert touched.report is not None
        elements = sum(body.element_count for body in touched.report.bodies)
    row: dict[str, Any] = {
        "case": f"instrument: {name}",
        "elements": elements,
        "steps": turns * _TURN,
        "dt_ms": round(1e3 * dt_s, 4),
        "largest_force_n": round(force_n, 3),
    }
    for key, prefix in (("touched", "step"), ("alone", "alone")):
        row[f"{prefix}_ms_median"] = round(statistics.median(p50 for p50, _ in times[key]), 4)
        row[f"{prefix}_ms_p99"] = round(max(p99 for _, p99 in times[key]), 4)
    return {**row, "warnings": warnings}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    command = f"python tests/bench/instruments.py --backend {args.backend}"
    with tm.launch(backend=args.backend, zenoh=False) as server:
        said = server.version()
        where = {"backend": said.backend, "device": said.device, "commit": args.commit, "command": command}
        for name in builtin_scenes():
            if script_of(name) is None:
                continue
            print(json.dumps({**_measure(server, name, args.backend), **where}), flush=True)
            print(f"{name}: done", file=sys.stderr)


if __name__ == "__main__":
    main()
