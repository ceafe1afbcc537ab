"""The messages that wait for one browser, and those that it has not acknowledged yet."""

from __future__ import annotations

import asyncio
import enum
import secrets


class Stream(enum.StrEnum):
    """Streams that a browser gets, in the order in which they leave: a frame needs its topology."""

    TOPOLOGY = "topology"
    REST = "rest"
    STATUS = "status"
    FRAME = "frame"
    FIELD = "field"


OF_THE_TOPOLOGY = frozenset({Stream.REST, Stream.FRAME, Stream.FIELD})
"""Streams whose messages have a value for each vertex."""


class ProtocolError(Exception):
    """A browser broke the protocol. The text is sent back as the reason for closing."""


class Outbox:
    """Messages for one browser: the newest of each stream waits, and at most one of each is not yet acknowledged."""

    def __init__(self) -> None:
        self.replaced = 0
        """Number of frames of this scene that the browser missed, because newer ones replaced them here."""
        self._replaced_since_frame = 0
        self._frame_left = False
        self._waiting: dict[Stream, bytes] = {}
        self._on_the_way: set[Stream] = set()
        self._changed = asyncio.Event()

    @property
    def topology_known(self) -> bool:
        """Tells whether the browser has acknowledged the newest topology."""
        return Stream.TOPOLOGY not in self._waiting and Stream.TOPOLOGY not in self._on_the_way

    def offer(self, stream: Stream, message: bytes) -> None:
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

    async def take(self) -> bytes:
        """Waits for a message that may leave."""
        while True:
            for stream in Stream:
                if self._may_leave(stream):
                    self._on_the_way.add(stream)
                    if stream is Stream.FRAME:
                        self._count_frame()
                    return self._waiting.pop(stream)
            self._changed.clear()
            await self._changed.wait()

    def _may_leave(self, stream: Stream) -> bool:
        # A browser must not get values that do not fit what it draws.
        held_back = stream in OF_THE_TOPOLOGY and Stream.TOPOLOGY in self._waiting
        return stream in self._waiting and stream not in self._on_the_way and not held_back

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
        self.scene: str | None = None
        self.field = ""
        """Element field that it shows as colours; empty: none."""
        self.client_id = secrets.randbits(63) | 1
        self.pose_sequence = 0
