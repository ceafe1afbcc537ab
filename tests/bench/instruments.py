"""What an instrument costs: the steps of each built-in scene with a scripted hand, with its instrument and without.

    python tests/bench/instruments.py [--backend cuda] [--commit HASH] >> tests/bench/results/instruments.jsonl

The scenes are those that `tensormass run` shows on the backend. Each is stepped in lockstep through whole periods of
its hands, at least 1000 steps, and for as long without its instruments. They take turns of at most 256 steps, so that a
slower moment of the machine slows both. Both make their steps in calls of many, and the times are those of all steps.
With two hands each call makes one step, in both scenes.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from one_backend import print_rows

import tensormass as tm
from tensormass._src.demo import builtin_scenes
from tensormass_tools.hand import HandScript, scripts_of
from tensormass_tools.presets import read_for_backend

#: Steps of a scene until the other one takes its turn.
_TURN = 256
#: A 99th percentile of fewer steps is one of the few slowest, and scatters.
_LEAST_STEPS = 1000


def _scene(name: str, backend: str) -> tm.Scene:
    return read_for_backend(name, backend) or tm.Scene.from_file(name)


def play(
    touched: tm.SceneHandle, untouched: tm.SceneHandle, hands: Sequence[HandScript], steps: range, dt_s: float
) -> float:
    """Makes steps of both scenes, the first with its tools moved by their hands. Returns the largest force at its end.

    `follow` moves one tool. So with several hands the others move before each step.
    """
    first, *others = hands
    calls = [steps] if not others else [range(step, step + 1) for step in steps]
    for call in calls:
        for hand in others:
            pose = hand.at(call[0] * dt_s)
            touched.move_tool(hand.tool, pose.position_m, pose.orientation, pose.joint_values, pose.level)
        status = touched.follow(first.tool, [first.at(step * dt_s) for step in call])
        untouched.step(len(call))
    tools = {hand.tool for hand in hands}
    forces = (felt.force_n for felt in status.tools if felt.tool in tools)
    return max(math.hypot(force.x, force.y, force.z) for force in forces)


def _measure(server: tm.Server, name: str, backend: str) -> dict[str, Any]:
    hands = [HandScript.read(path) for path in scripts_of(name).values()]
    alone = _scene(name, backend)
    for tool in [tool for tool in alone.message.tools if not tool.fixed]:
        alone.message.tools.remove(tool)  # obstacles stay: without its table an organ would fall for ever
    force_n = 0.0
    with (
        server.load(_scene(name, backend), name=name, lockstep=True) as touched,
        server.load(alone, name=f"{name}-alone", lockstep=True) as untouched,
    ):
        dt_s = alone.message.stepping.dt_s if alone.message.stepping.HasField("dt_s") else 1 / 60
        period = round(max(float(hand.times_s[-1]) for hand in hands) / dt_s)
        steps = period * math.ceil(_LEAST_STEPS / period)
        for first in range(0, steps, _TURN):
            turn = range(first, min(first + _TURN, steps))
            force_n = max(force_n, play(touched, untouched, hands, turn, dt_s))
        times = {"step": touched.step_times(), "alone": untouched.step_times()}
        warnings = list(touched.status().warnings)
        assert touched.report is not None
        elements = sum(body.element_count for body in touched.report.bodies)
    row: dict[str, Any] = {
        "case": f"instrument: {name}",
        "elements": elements,
        "steps": steps,
        "dt_ms": round(1e3 * dt_s, 4),
        "largest_force_n_at_turns": round(force_n, 3),
    }
    for prefix, of in times.items():
        assert of.count == steps
        row[f"{prefix}_ms_median"] = round(1e3 * of.p50_s, 4)
        row[f"{prefix}_ms_p99"] = round(1e3 * of.p99_s, 4)
        row[f"{prefix}_ms_p999"] = round(1e3 * of.p999_s, 4)
    return {**row, "warnings": warnings}


def _rows(server: tm.Server, backend: str) -> Iterator[dict[str, Any]]:
    for name in builtin_scenes():
        if not scripts_of(name):
            continue
        yield _measure(server, name, backend)
        print(f"{name}: done", file=sys.stderr)


def main() -> None:
    print_rows(__file__, __doc__, _rows)


if __name__ == "__main__":
    main()
