"""Measures the first steps of a scene under its tool, before a hand or a viewer comes.

The scene is loaded in lockstep and steps as fast as it can: from rest, while the scripted hand of the scene, or a
press like that of `tensormass trade`, moves the tool. The daemon times each step itself. Without the pauses of a fixed
rate, in which caches cool down, a step is a little faster than later.
"""

from __future__ import annotations

import time

from tensormass._src import defaults
from tensormass._src.errors import TensormassError, UnavailableError
from tensormass._src.scene_handle import SceneHandle
from tensormass._src.server import Server
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_tools.fitting import Measured
from tensormass_tools.hand import HandPose, HandScript
from tensormass_tools.trade.script import Script

#: Rate of the poses [Hz]. Faster scenes make several steps for each.
_POSE_RATE_HZ = 60.0
#: Simulated time in which a scripted hand makes its whole path [s], four times as fast as it does for people.
_HAND_S = 2.5
#: Depth of the press in radii of the tool: as deep as the simulated device presses the demo.
_PRESS_RADII = 1.0
#: Steps from rest after which a scene that is too slow even in the median needs no further ones.
_FEW_STEPS = 30
#: A path is repeated until this number of steps. The 99th percentile of fewer would be the slowest one.
_ENOUGH_STEPS = 150
#: The same for a scene that is too slow in few steps only, because the machine may have been busy.
_MOST_STEPS = 750
#: Time after which a measurement ends [s].
_MOST_S = 4.0


def measure(server: Server, scene: scene_pb2.Scene, hand: HandScript | None, share: float) -> Measured | None:
    """Loads a scene, makes its first steps and unloads it.

    Args:
        hand: moves its tool; None: the first tool that can move presses.
        share: largest share of the period that a step may take, for which fewer steps may suffice.

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
            status = _step(handle, path, share)
            return None if status.fault else _measured(status, path.dt_s, handle.report)
    except UnavailableError:
        raise
    except TensormassError:
        return None


class _Path:
    """The motion of the tool, again and again."""

    def __init__(self, scene: scene_pb2.Scene, hand: HandScript | None) -> None:
        self.script = Script.of(scene, None, _PRESS_RADII)
        self.dt_s = defaults.dt_s(scene)
        self._hand = hand
        self.duration_s = self.script.duration_s if hand is None else _HAND_S

    def move(self, handle: SceneHandle, time_s: float) -> None:
        if self._hand is not None:
            pose: HandPose = self._hand.at(time_s / _HAND_S * float(self._hand.times_s[-1]))
            handle.move_tool(self._hand.tool, *pose)
        elif self.script.tool is not None:
            handle.move_tool(self.script.tool, self.script.pose(time_s))


def _step(handle: SceneHandle, path: _Path, share: float) -> stream_pb2.SceneStatus:
    """Makes the steps of whole paths until the times are known well enough. Returns the last status."""
    at_once = max(1, round(1 / (_POSE_RATE_HZ * path.dt_s)))
    calls = max(1, round(path.duration_s / (at_once * path.dt_s)))
    limit_s = share * path.dt_s
    until = time.monotonic() + _MOST_S
    count = 0
    while True:
        for i in range(1, calls + 1):
            path.move(handle, i * at_once * path.dt_s)
            status = handle.step(at_once)
            count += at_once
            too_slow = count >= _FEW_STEPS and status.step_time_p50_s > limit_s
            if status.fault or too_slow or time.monotonic() > until:
                return status
        if count >= (_ENOUGH_STEPS if status.step_time_p99_s <= limit_s else _MOST_STEPS):
            return status
        handle.reset()


def _measured(status: stream_pb2.SceneStatus, dt_s: float, report: control_pb2.SceneReport | None) -> Measured:
    assert report is not None
    elements = sum(body.element_count for body in report.bodies)
    return Measured(status.step_time_p50_s, status.step_time_p99_s, dt_s, elements)
