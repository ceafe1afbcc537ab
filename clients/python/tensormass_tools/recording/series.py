"""What a recording says over time, as curves to draw.

Times count from the start of the recording on the server's clock, because a reset sets simulated time to zero.

| curve | from | how often |
|---|---|---|
| force on each tool | frames, otherwise statuses | each frame, or about once a second |
| step time | frames, and statuses (median, 99th percentile) | likewise |
| rate | inputs: the end of each step | each window of RATE_WINDOW_S |
| residuals, missed deadlines | statuses | about once a second |
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from tensormass import FloatArray
from tensormass.v1 import recording_pb2, stream_pb2
from tensormass_tools.output import force_n
from tensormass_tools.recording.file import RecordingReader

#: Time over which a rate is measured [s].
RATE_WINDOW_S = 0.5


class Curve(NamedTuple):
    """Values over time: both float64 [n]."""

    time_s: FloatArray
    values: FloatArray


class _Points:
    """A curve that grows."""

    def __init__(self) -> None:
        self._points: list[tuple[float, float]] = []

    def add(self, time_s: float, value: float) -> None:
        self._points.append((time_s, value))

    def curve(self) -> Curve:
        points = np.array(self._points, np.float64).reshape(-1, 2)
        return Curve(points[:, 0], points[:, 1])


@dataclass
class Series:
    """Curves of a recording, by the names of their legends. A curve without points is left out."""

    scene: str
    #: Number of frames, statuses and steps in the recording.
    frames: int = 0
    statuses: int = 0
    steps: int = 0
    lost_steps: int = 0
    forces_n: dict[str, Curve] = field(default_factory=dict)
    step_times_s: dict[str, Curve] = field(default_factory=dict)
    rates_hz: dict[str, Curve] = field(default_factory=dict)
    residuals: dict[str, Curve] = field(default_factory=dict)
    missed_deadlines: dict[str, Curve] = field(default_factory=dict)
    #: When the scene was reset, adjusted and restored, and when a guard stopped it [s].
    resets_s: list[float] = field(default_factory=list)
    adjustments_s: list[float] = field(default_factory=list)
    restores_s: list[float] = field(default_factory=list)
    stops_s: list[float] = field(default_factory=list)
    #: When each recovery began [s], and the number of steps in all of them.
    recoveries_s: list[float] = field(default_factory=list)
    recovered_steps: int = 0


def read_series(recording: RecordingReader) -> Series:
    """Reads the curves of a recording. It keeps no positions, so it needs little memory."""
    return _Reading(recording).read()


class _Reading:
    def __init__(self, recording: RecordingReader) -> None:
        self._recording = recording
        self._origin_ns = recording.start.server_time_ns
        self._series = Series(recording.start.scene)
        self._frame_forces: defaultdict[str, _Points] = defaultdict(_Points)
        self._status_forces: defaultdict[str, _Points] = defaultdict(_Points)
        self._frame_step_times = _Points()
        self._step_times: defaultdict[str, _Points] = defaultdict(_Points)
        self._rates: defaultdict[str, _Points] = defaultdict(_Points)
        self._residuals: defaultdict[str, _Points] = defaultdict(_Points)
        self._missed: defaultdict[str, _Points] = defaultdict(_Points)
        self._step_ends = _Points()
        self._recovering = False
        # Edits before the next step.
        self._edits: list[str | None] = []

    def read(self) -> Series:
        take: dict[str, Callable[[float, Any], None]] = {
            "/frames": self._frame,
            "/status": self._status,
            "/inputs": self._step,
        }
        series = self._series
        for channel, message in self._recording.entries():
            if channel == "/lost":
                series.lost_steps += message.count
            elif channel == "/edits":
                self._edits.append(message.WhichOneof("edit"))
            elif channel in take:
                take[channel](self._time_s(message.server_time_ns), message)
        series.forces_n = _curves(self._frame_forces if series.frames else self._status_forces)
        # The first is drawn below the others.
        series.step_times_s = _named("of each frame", self._frame_step_times.curve()) | _curves(self._step_times)
        series.rates_hz = _named("reached", rate_hz(*self._step_ends.curve())) | _curves(self._rates)
        series.residuals = _curves(self._residuals)
        series.missed_deadlines = _curves(self._missed)
        return series

    def _time_s(self, server_time_ns: int) -> float:
        if self._origin_ns == 0:
            self._origin_ns = server_time_ns
        return 1e-9 * (server_time_ns - self._origin_ns)  # subtracts integers, because doubles end at 2^53

    def _frame(self, time_s: float, frame: stream_pb2.Frame) -> None:
        self._series.frames += 1
        for tool in frame.tools:
            self._frame_forces[tool.tool].add(time_s, force_n(tool))
        if frame.tools and frame.tools[0].step_s > 0:  # the same in all tools of a frame
            self._frame_step_times.add(time_s, frame.tools[0].step_s)

    def _status(self, time_s: float, status: stream_pb2.SceneStatus) -> None:
        self._series.statuses += 1
        for tool in status.tools:
            self._status_forces[tool.tool].add(time_s, force_n(tool))
        if status.step == 0:
            return  # nothing is measured yet
        self._step_times["median"].add(time_s, status.step_time_p50_s)
        self._step_times["99th percentile"].add(time_s, status.step_time_p99_s)
        if status.step_budget_s > 0:
            self._step_times["budget"].add(time_s, status.step_budget_s)
        if status.state != stream_pb2.SceneStatus.STATE_LOCKSTEP:
            self._rates["target"].add(time_s, status.target_rate_hz)
            self._missed["missed"].add(time_s, status.missed_deadlines)
        self._residuals["conjugate gradients"].add(time_s, status.cg_relative_residual)
        if status.newton_iterations > 0:
            self._residuals["Newton"].add(time_s, status.newton_residual)

    def _step(self, time_s: float, step: recording_pb2.RecordedStep) -> None:
        self._series.steps += 1
        self._step_ends.add(time_s, step.index)
        if step.reset and step.index > 1:  # a recording may begin with a reset
            self._series.resets_s.append(time_s)
        self._series.adjustments_s += [time_s] * self._edits.count("adjust")
        self._series.restores_s += [time_s] * self._edits.count("restore")
        self._edits.clear()
        if step.rejected:
            self._series.stops_s.append(time_s)
        if step.recovered:
            self._series.recovered_steps += 1
            if not self._recovering:
                self._series.recoveries_s.append(time_s)
        self._recovering = step.recovered


def rate_hz(time_s: FloatArray, index: FloatArray, window_s: float = RATE_WINDOW_S) -> Curve:
    """Returns the rate of steps, at the end of each window. There are at most as many windows as steps.

    Lost steps count, because the rate comes from their indices. Without a whole window, the rate is that of all steps.

    Args:
        time_s: end of each step, [n].
        index: number of each step, [n].
    """
    time_s = np.maximum.accumulate(time_s)  # the server's clock may be set back
    if len(time_s) < 2 or not time_s[-1] > time_s[0]:
        return Curve(np.empty(0), np.empty(0))
    length_s = time_s[-1] - time_s[0]
    window_s = min(max(window_s, length_s / len(time_s)), length_s)
    bounds = time_s[0] + window_s * np.arange(1 + int(length_s / window_s))
    steps = np.interp(bounds, time_s, index)
    return Curve(bounds[1:], np.diff(steps) / np.diff(bounds))


def _named(name: str, curve: Curve) -> dict[str, Curve]:
    return {name: curve} if len(curve.time_s) else {}


def _curves(points: dict[str, _Points]) -> dict[str, Curve]:
    return {name: each.curve() for name, each in points.items()}
