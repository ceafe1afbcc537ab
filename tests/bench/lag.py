"""What lagged tangents save, and what they change: `demo` under a probe that presses and drags, and `retract`.

    python tests/bench/lag.py [--backend cuda] [--commit HASH] >> tests/bench/results/lag.jsonl

Each scene is loaded once for each lag, with the settings that `tensormass run` takes on the backend and without its
skin. The scenes follow the same hand in lockstep, in turns of 16 steps, so that a slower moment of the machine slows
all of them. The steps of a turn are made in one call. `force_percent` and `displacement_percent` are root mean squares
of what a lag changes at the ends of the turns, over those of the scene without a lag.
"""

from __future__ import annotations

import contextlib
import statistics
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from one_backend import print_rows

import tensormass as tm
from tensormass._shared import defaults
from tensormass_tools.hand import HandScript, script_of
from tensormass_tools.presets import read_for_backend

Pose = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64] | None, Sequence[float]]
_LAGS = (1, 4, 8, 16, 32)
_TURN = 16
_SECONDS = 6.0


def _drag(time_s: float) -> Pose:
    """The probe of `demo` sinks in by 10 mm within a second, then drags at up to 60 mm/s, and rests in the last two."""
    moving_s = min(time_s, _SECONDS - 2)
    down = min(moving_s, 1.0)
    turn = 2 * np.pi * max(moving_s - 1, 0) / 2
    at = [-0.03 + 0.02 * np.sin(turn), 0.02 - 0.02 * (1 - np.cos(turn)), 0.062 - 0.01 * down + 0.003 * np.sin(3 * turn)]
    return np.array(at), None, ()


def _hand(name: str) -> tuple[str, HandScript | None]:
    path = script_of(name)
    script = None if path is None else HandScript.read(path)
    return ("probe", None) if script is None else (script.tool, script)


def _measure(server: tm.Server, name: str, backend: str) -> dict[int, dict[str, float]]:
    tool, script = _hand(name)
    forces: dict[int, list[npt.NDArray[np.float64]]] = {lag: [] for lag in _LAGS}
    moves: dict[int, list[npt.NDArray[np.float64]]] = {lag: [] for lag in _LAGS}
    iterations: dict[int, list[int]] = {lag: [] for lag in _LAGS}
    with contextlib.ExitStack() as stack:
        handles: dict[int, tm.SceneHandle] = {}
        for lag in _LAGS:
            scene = read_for_backend(name, backend) or tm.Scene.from_file(name)
            for body in scene.message.bodies:
                body.ClearField("skin")
                body.ClearField("texture")
            scene.set_solver(tangent_lag_steps=lag)
            handles[lag] = stack.enter_context(server.load(scene, name=f"lag_{lag}", lockstep=True))
            dt_s = defaults.dt_s(scene.message)
        rest = {body.name: handles[_LAGS[0]].positions(body.name) for body in handles[_LAGS[0]].topology().bodies}
        for turn in range(round(_SECONDS / dt_s / _TURN)):
            times_s = [(turn * _TURN + step) * dt_s for step in range(_TURN)]
            poses = [_drag(time_s) if script is None else script.at(time_s) for time_s in times_s]
            for lag, handle in handles.items():
                iterations[lag].append(handle.follow(tool, poses).cg_iterations)
                forces[lag].append(np.asarray(handle.feedback(tool).force_n))
                moves[lag].append(np.concatenate([(handle.positions(body) - rest[body]).ravel() for body in rest]))
        times = {lag: handle.step_times() for lag, handle in handles.items()}

    def change_percent(of: dict[int, list[npt.NDArray[np.float64]]], lag: int) -> float:
        exact, lagged = np.array(of[_LAGS[0]]), np.array(of[lag])
        return round(100 * float(np.linalg.norm(lagged - exact) / np.linalg.norm(exact)), 3)

    return {
        lag: {
            "steps": of.count,
            "step_ms_median": round(1e3 * of.p50_s, 4),
            "step_ms_p99": round(1e3 * of.p99_s, 4),
            "cg_iterations": statistics.median(iterations[lag]),
            "force_percent": change_percent(forces, lag),
            "displacement_percent": change_percent(moves, lag),
        }
        for lag, of in times.items()
    }


def _rows(server: tm.Server, backend: str) -> Iterator[dict[str, Any]]:
    for name in ("demo", "retract"):
        for lag, row in _measure(server, name, backend).items():
            yield {"case": f"lag: {name}, {lag}", "scene": name, "lag": lag, **row}


def main() -> None:
    print_rows(__file__, __doc__, _rows)


if __name__ == "__main__":
    main()
