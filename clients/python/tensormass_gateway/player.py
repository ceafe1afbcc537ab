"""The play head of a recording: which frame is on show, and when the next one is due.

    0 s        head                                     end
    |----------|----------------------------------------|
    f f  f f   f   f f f f        frames, at irregular times; on show is the last one at or before the head

The head moves with the clock while the recording plays. Time that passes between two looks at the clock is made up for
by skipping frames, so a slow reader or browser never slows the recording down.
"""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from tensormass.v1 import changes_pb2, event_pb2, recording_pb2, scene_pb2, stream_pb2


class Mark(NamedTuple):
    """Something that happened at a time of the recording."""

    time_s: float
    kind: str
    """ablated, adjust, contact, cut, cut_begun, cut_ended, guard, piece_free, recovery, reset, restore, severed, stop,
    tool_added or tool_removed"""
    text: str


class Recording(Protocol):
    """What a player needs of a recording."""

    name: str
    scene: scene_pb2.Scene
    start: recording_pb2.RecordingStart
    topology: stream_pb2.Topology
    note: str
    """Why the recording ends early; empty: it does not."""

    @property
    def times_s(self) -> Sequence[float]:
        """Returns the time of each frame from the first one. It never falls; there is at least one frame."""
        ...

    @property
    def marks(self) -> Sequence[Mark]: ...
    def frame(self, index: int) -> stream_pb2.Frame: ...
    def topology_of(self, frame: stream_pb2.Frame) -> stream_pb2.Topology:
        """Returns the topology of a frame: that of the recording, perhaps with other tools."""
        ...

    def status(self, index: int) -> stream_pb2.SceneStatus | None:
        """Returns the last status before a frame; None if there was none."""
        ...

    def changes(self, frame: stream_pb2.Frame) -> changes_pb2.SurfaceChanges | None:
        """Returns the changes of the surface that a frame shows; None: none are recorded."""
        ...

    def events(self, frame: stream_pb2.Frame) -> event_pb2.SceneEvents | None:
        """Returns the last events up to a frame; None: none are recorded."""
        ...


class Player:
    """A play head over frames at `times_s`. It starts at the first frame and stands still."""

    def __init__(self, times_s: Sequence[float], clock: Callable[[], float] = time.monotonic) -> None:
        assert len(times_s) > 0
        assert times_s[0] == 0
        self.index = 0
        """Frame on show."""
        self.playing = False
        self.speed = 1.0
        self._times_s = times_s
        self._clock = clock
        self._head_s = 0.0
        self._anchored_s = clock()

    @property
    def duration_s(self) -> float:
        return self._times_s[-1]

    @property
    def time_s(self) -> float:
        """Place of the head at the last `advance` or command."""
        return self._head_s

    def play(self) -> None:
        """Plays on; from the start if the head is at the end."""
        if self._head_s >= self.duration_s:
            self._place(0.0)
        self._anchored_s = self._clock()
        self.playing = True

    def pause(self) -> None:
        self.advance()
        self.playing = False

    def seek(self, time_s: float) -> None:
        """Moves the head, within the recording. A recording that plays goes on from there."""
        self._place(min(max(time_s, 0.0), self.duration_s))
        self._anchored_s = self._clock()

    def step(self, count: int) -> None:
        """Stands still at the frame `count` after the one on show; before it if negative."""
        self.pause()
        self.index = min(max(self.index + count, 0), len(self._times_s) - 1)
        self._head_s = self._times_s[self.index]

    def set_speed(self, speed: float) -> None:
        """Plays `speed` times as fast as the scene ran in simulated time."""
        assert speed > 0
        self.advance()
        self.speed = speed

    def advance(self) -> None:
        """Moves the head to where it is now. Stands still at the end."""
        if not self.playing:
            return
        now_s = self._clock()
        self._place(min(self._head_s + self.speed * (now_s - self._anchored_s), self.duration_s))
        self._anchored_s = now_s
        self.playing = self._head_s < self.duration_s

    def wait_s(self) -> float | None:
        """Returns the time until the next frame is due; None while the head stands still."""
        if not self.playing:
            return None
        following = bisect_right(self._times_s, self._head_s)
        due_s = self._times_s[min(following, len(self._times_s) - 1)]
        return max(0.0, (due_s - self._head_s) / self.speed - (self._clock() - self._anchored_s))

    def _place(self, time_s: float) -> None:
        self._head_s = time_s
        self.index = bisect_right(self._times_s, time_s) - 1
