"""A stream of frames of a scene, with the changes of its surface."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

from tensormass._src.frames import Frame
from tensormass._src.streams import Closing
from tensormass._src.subscriptions import Subscription
from tensormass.v1 import changes_pb2, stream_pb2


class FrameSource(Protocol):
    """What a stream needs of a scene's handle."""

    def frame(self) -> Frame: ...
    def _decode(self, frame: stream_pb2.Frame) -> Frame | None: ...
    def _take_changes(self, changes: changes_pb2.SurfaceChanges) -> None: ...


def _follows(frame: Frame, first: Frame) -> bool:
    """Returns whether a frame of the bus is newer than `first`, which a call returned.

    The bus may still bring frames that were published before the call, and once more the state that the call returned.
    Counts decide, because the server's clock may be set back. The call returns the sequence of the last frame that was
    published before it, and at most one frame waited to be published then.
    """
    if frame.topology.version != first.topology.version:
        return True
    if frame.sequence != first.sequence + 1:
        return frame.sequence > first.sequence
    # That one may have waited. A reset or a pause publishes a step number again, at another time.
    return frame.step > first.step or frame.server_time_ns > first.server_time_ns


class FrameStream(Closing, Iterator[Frame]):
    """Iterates over the frames of a scene; see `SceneHandle.frames`."""

    def __init__(
        self,
        scene: FrameSource,
        subscription: Subscription[stream_pb2.Frame],
        timeout_s: float,
        follow_changes: Callable[[], Subscription[changes_pb2.SurfaceChanges]] | None = None,
    ) -> None:
        """Makes a stream.

        Args:
            follow_changes: subscribes to the changes of the surface; called with the first frame of a changed one.
        """
        #: Number of frames that newer ones replaced before they were taken.
        self.dropped_count = 0
        self._scene = scene
        self._subscription = subscription
        self._follow_changes = follow_changes
        self._changes: Subscription[changes_pb2.SurfaceChanges] | None = None
        self._timeout_s = timeout_s
        # The frame of the call at the start, and the newest one that came, whether it was handed out or not.
        self._first: Frame | None = None
        self._last: Frame | None = None

    def __next__(self) -> Frame:
        if self._first is None or self._last is None:
            self._first = self._last = self._scene.frame()
            return self._first
        while True:
            message = self._subscription.receive(self._timeout_s)
            if message.revision > 0:
                self._read_changes()
            frame = self._scene._decode(message)
            if frame is None:
                continue
            if frame.topology.version == self._last.topology.version:
                self.dropped_count += max(0, frame.sequence - self._last.sequence - 1)
            self._last = frame
            if _follows(frame, self._first):
                return frame

    def _read_changes(self) -> None:
        """Takes the newest changes. What the bus repeats for a late subscriber may take a second, so asks once, too."""
        if self._changes is None:
            if self._follow_changes is None:
                return
            self._changes = self._follow_changes()
            self._scene.frame()
        changes = self._changes.newest()
        if changes is not None:
            self._scene._take_changes(changes)

    def close(self) -> None:
        """Ends the subscription."""
        self._subscription.close()
        if self._changes is not None:
            self._changes.close()
