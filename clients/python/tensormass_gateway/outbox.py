"""The messages that wait for one browser, and those that it has not acknowledged yet."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import secrets
import time
from collections.abc import Callable
from typing import TypeAlias

from tensormass_gateway.encoding import FrameEncoder, SharedFrame
from tensormass_gateway.requests import ProtocolError


class Stream(enum.StrEnum):
    """Streams that a browser gets, in the order in which they leave: a frame needs its topology."""

    TOPOLOGY = "topology"
    CHANGES = "changes"
    REST = "rest"
    STATUS = "status"
    EVENTS = "events"
    FRAME = "frame"
    FIELD = "field"


OF_THE_TOPOLOGY = frozenset({Stream.CHANGES, Stream.REST, Stream.FRAME, Stream.FIELD})
"""Streams whose messages mean nothing without their topology."""

OF_THE_SCENE = frozenset({Stream.STATUS, Stream.EVENTS})
"""Streams that are the same in every detail."""


Message: TypeAlias = bytes | SharedFrame
"""Bytes as they leave, or a frame that each browser gets in its own codec."""


class Pace:
    """Limits how many frames leave in a second. Frames that come irregularly still reach the rate on average."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._period_s = 0.0
        self._due_s = clock()

    def set_rate(self, rate_hz: float | None) -> None:
        """Limits the rate from now on; None: no limit."""
        self._period_s = 0.0 if rate_hz is None else 1 / rate_hz
        self._due_s = min(self._due_s, self._clock() + self._period_s)

    def wait_s(self) -> float:
        """Returns the time until the next frame may leave; zero: now."""
        return max(0.0, self._due_s - self._clock()) if self._period_s > 0 else 0.0

    def leave(self) -> None:
        """Takes note that a frame leaves now."""
        now_s = self._clock()
        late = now_s - self._due_s >= self._period_s
        self._due_s = (now_s if late else self._due_s) + self._period_s


class Outbox:
    """Messages for one browser: the newest of each stream waits, and at most one of each is not yet acknowledged."""

    def __init__(self) -> None:
        self.pace = Pace()
        self.replaced = 0
        """Number of frames of this scene that the browser missed, because newer ones replaced them here."""
        self._replaced_since_frame = 0
        self._frame_left = False
        self._waiting: dict[Stream, Message] = {}
        self._on_the_way: set[Stream] = set()
        self._changed = asyncio.Event()

    @property
    def topology_known(self) -> bool:
        """Tells whether the browser has acknowledged the newest topology."""
        return Stream.TOPOLOGY not in self._waiting and Stream.TOPOLOGY not in self._on_the_way

    def offer(self, stream: Stream, message: Message) -> None:
        """Puts `message` into its slot and replaces the one that waited there."""
        if stream is Stream.TOPOLOGY:
            self._drop_values()
        if stream is Stream.FRAME and stream in self._waiting:
            self._replaced_since_frame += 1
        self._waiting[stream] = message
        self._changed.set()

    def clear(self) -> None:
        """Forgets messages and counts, when the browser turns to another scene."""
        self._waiting.clear()
        self._drop_values()
        self.replaced = 0

    def acknowledge(self, stream: Stream) -> None:
        """Lets the next message of `stream` leave. Raises ProtocolError if no message awaits acknowledgement."""
        if stream not in self._on_the_way:
            raise ProtocolError(f"acknowledged a {stream} message, but none is on its way")
        self._on_the_way.remove(stream)
        self._changed.set()

    def set_rate(self, rate_hz: float | None) -> None:
        """Limits the rate of frames; None: every frame leaves."""
        self.pace.set_rate(rate_hz)
        self._changed.set()

    async def take(self) -> Message:
        """Waits for a message that may leave."""
        while True:
            for stream in Stream:
                if self._may_leave(stream):
                    self._on_the_way.add(stream)
                    if stream is Stream.FRAME:
                        self._count_frame()
                        self.pace.leave()
                    return self._waiting.pop(stream)
            self._changed.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._frame_due_in_s()):
                    await self._changed.wait()

    def _may_leave(self, stream: Stream) -> bool:
        if stream is Stream.FRAME and self.pace.wait_s() > 0:
            return False
        return self._has_way(stream)

    def _has_way(self, stream: Stream) -> bool:
        # A browser must not get values that do not fit what it draws.
        held_back = stream in OF_THE_TOPOLOGY and Stream.TOPOLOGY in self._waiting
        return stream in self._waiting and stream not in self._on_the_way and not held_back

    def _frame_due_in_s(self) -> float | None:
        """Returns the time after which the rate lets the waiting frame leave [s]; None if it holds back no frame."""
        return self.pace.wait_s() if self._has_way(Stream.FRAME) else None

    def _count_frame(self) -> None:
        if self._frame_left:
            self.replaced += self._replaced_since_frame
        self._replaced_since_frame = 0
        self._frame_left = True

    def _drop_values(self) -> None:
        """Drops the values that wait and the count of frames, because they belong to the previous topology."""
        for stream in OF_THE_TOPOLOGY:
            self._waiting.pop(stream, None)
        self._replaced_since_frame = 0
        self._frame_left = False


class Watcher:
    """A browser, as feeds know it. It gets the streams of one scene at a time."""

    def __init__(self) -> None:
        self.outbox = Outbox()
        self.encoder = FrameEncoder()
        self.scene: str | None = None
        self.field = ""
        """Element field that it shows as colours; empty: none."""
        self.client_id = secrets.randbits(63) | 1
        self.session = secrets.randbits(64) | 1
        """Known to the daemon alone, so that nobody else uses up the sequences of this browser's poses."""
        self.pose_sequence = 0

    @property
    def detail(self) -> float:
        """Share of the triangles that it shows."""
        return self.encoder.choice.detail
