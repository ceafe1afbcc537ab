"""Measures the first steps of a scene under its tool, before a hand or a viewer comes.

The scene is loaded in lockstep and steps as fast as it can: from rest, while the scripted hand of the scene, or a press
like that of `tensormass trade`, moves the tool. If a few steps are too slow, the path is made again with the same
steps. The least time of each step is the one that other programs disturbed least.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from tensormass import FloatArray, SceneHandle, Server, TensormassError, UnavailableError
from tensormass._shared import defaults
from tensormass.v1 import scene_pb2
from tensormass_tools.fitting import Measured
from tensormass_tools.hand import HandPose, HandScript
from tensormass_tools.trade.script import Script

#: Rate of the poses [Hz]. Faster scenes make several steps for each.
_POSE_RATE_HZ = 60.0
#: Simulated time in which a scripted hand makes its whole path [s], four times as fast as it does for people.
_HAND_S = 2.5
#: Depth of the press in radii of the tool, as deep as the simulated device presses the demo, and its duration [s].
_PRESS_RADII, _PRESS_S = 1.0, 0.8
#: The path is left after so many steps if this share of them is too slow.
_FEW_STEPS, _LEAVE_SHARE = 30, 0.5
#: A path with some slow steps is made again, because other programs may have disturbed them. That ends once the mean of
#: the least times stays above this share of the mean before, or after so many passes.
_CALM, MOST_PASSES = 0.95, 12
_SLOW_QUANTILE = 0.99
#: Time after which a measurement ends [s].
MOST_S = 4.0


def measure(
    server: Server,
    scene: scene_pb2.Scene,
    hand: HandScript | None,
    share: float,
    prepare: Callable[[], object] = lambda: None,
) -> Measured | None:
    """Loads a scene, makes its first steps and unloads it.

    Args:
        hand: moves its tool; None: the first tool that can move presses.
        share: largest share of the period that a step may take, for which fewer steps may suffice.
        prepare: () -> ignored. Called once the scene is loaded, before its first step.

    Returns:
        None if the scene stopped, was refused, or is one step to equilibrium.

    Raises:
        UnavailableError: the daemon is gone.
    """
    try:
        path = _Path(scene, hand)
        if path.script.one_step:
            return None
        with server.load(scene, lockstep=True) as handle:
            prepare()
            times_s = _times_s(handle, path, share)
            report = handle.report
    except UnavailableError:
        raise
    except TensormassError:
        return None
    if times_s is None or report is None:
        return None
    median_s, slow_s = np.quantile(times_s, [0.5, _SLOW_QUANTILE])
    elements = sum(body.element_count for body in report.bodies)
    return Measured(float(median_s), float(slow_s), path.dt_s, elements)


class _Path:
    """The motion of the tool, again and again."""

    def __init__(self, scene: scene_pb2.Scene, hand: HandScript | None) -> None:
        self.script = Script.of(scene, _PRESS_S, _PRESS_RADII)
        self.dt_s = defaults.dt_s(scene)
        self._hand = hand
        self.duration_s = self.script.duration_s if hand is None else _HAND_S

    def move(self, handle: SceneHandle, time_s: float) -> None:
        if self._hand is not None:
            pose: HandPose = self._hand.at(time_s / _HAND_S * float(self._hand.times_s[-1]))
            handle.move_tool(self._hand.tool, *pose)
        elif self.script.tool is not None:
            handle.move_tool(self.script.tool, self.script.pose(time_s))


def _times_s(handle: SceneHandle, path: _Path, share: float) -> FloatArray | None:
    """Returns the least time of each step [s], of several steps with one pose their mean; None if the scene stopped."""
    at_once = max(1, round(1 / (_POSE_RATE_HZ * path.dt_s)))
    calls = max(1, round(path.duration_s / (at_once * path.dt_s)))
    limit_s = share * path.dt_s
    until = time.monotonic() + MOST_S
    times_s = np.full(calls, np.inf)
    mean_s = np.inf
    for _ in range(MOST_PASSES):
        for i in range(calls):
            path.move(handle, (i + 1) * at_once * path.dt_s)
            began = time.perf_counter()
            status = handle.step(at_once)
            times_s[i] = min(times_s[i], (time.perf_counter() - began) / at_once)
            if status.fault:
                return None
            known = times_s[np.isfinite(times_s)]
            leaves = len(known) * at_once >= _FEW_STEPS and (known > limit_s).mean() > _LEAVE_SHARE
            if leaves or time.monotonic() > until:
                return known
        fits = np.quantile(times_s, _SLOW_QUANTILE) <= limit_s
        before_s, mean_s = mean_s, float(times_s.mean())
        if fits or mean_s > _CALM * before_s:
            break
        handle.reset()
    return times_s
