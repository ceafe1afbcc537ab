"""A recording in files of bounded size. Each starts with a snapshot and replays alone.

    demo.mcap           | scene, start            | steps 1 .. 9000 |
    demo-2.mcap                                    | scene, start with a snapshot of step 9000 | steps 9001 .. |

A full file asks the daemon for a snapshot. Steps go on meanwhile, and come here later than they are made. So the file
is cut where its steps reach the one of the snapshot, and no step is lost. The number of a step starts again at a reset.
Two clocks of the server tell such steps apart: the time at which a step ended, and the time before the snapshot. Beside
an adjustment or a restore nobody knows which of the two the snapshot was taken before, so it is dropped there.

The index of a file is in memory until the file ends: about 1 KB a chunk. Memory therefore stays flat.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from google.protobuf.message import Message

from tensormass.v1 import adjustment_pb2, recording_pb2
from tensormass_tools.recording.file import RecordingWriter

#: Time from a snapshot that fitted no step to the next try [s].
RETRY_S = 1.0


class Cut(NamedTuple):
    """A place at which a new file can start."""

    step: int
    """Step of the scene after which the snapshot was taken."""
    before_ns: int
    """Time of the server before it was taken."""
    snapshot: bytes
    scene_hash: int = 0
    """Hash of the scene to which the snapshot belongs. 0: a daemon that knows no other than that of the start."""
    adjustments: adjustment_pb2.SceneAdjustments | None = None
    """Values of that scene; None: as they were loaded."""


class RecordingFiles:
    """Writes a recording. As a context manager, it ends its files properly unless writing failed."""

    def __init__(
        self,
        path: Path,
        start: recording_pb2.RecordingStart,
        begin: Callable[[RecordingWriter, recording_pb2.RecordingStart], None],
        take: Callable[[], Cut],
        max_bytes: int,
        keep: int | None = None,
    ) -> None:
        """Begins the first file.

        Args:
            path: of the first file. The others have a number at the end of the name.
            start: of the recording, as the daemon sent it.
            begin: called with each new file and its start; writes what comes before the steps.
            take: called when a file is full; takes a snapshot.
            max_bytes: size of a file at which the next one starts.
            keep: number of files that stay, the newest ones; None: all.
        """
        self.paths = [path]
        """Files that are there."""
        self._first = path
        self._start, self._begin, self._take = start, begin, take
        self._max_bytes, self._keep = max_bytes, keep
        self._count = 1
        self._cut: Cut | None = None
        self._retry_s = 0.0
        # Index of the last step, as the daemon counts, and of the last one of the file before.
        self._index = self._before = 0
        self._step = start.step
        # The file before, which may still get the check of its last step, and by how much its indices are shifted.
        self._previous: RecordingWriter | None = None
        self._previous_before = 0
        self._writer = self._open(path, start)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._end_previous()
        finally:
            self._writer.close()

    def add(self, channel: str, message: Message, time_ns: int = 0) -> None:
        """Adds a message without an index to the newest file."""
        self._writer.add(channel, message, time_ns)

    def add_step(self, step: recording_pb2.RecordedStep, edits: Sequence[recording_pb2.RecordedEdit] = ()) -> None:
        """Adds a step and the edits before it, to a new file if one is due."""
        if self._cut is not None:
            self._use(self._cut, step, edits)
        self._index, self._step = step.index, step.step
        for edit in edits:
            moved = recording_pb2.RecordedEdit()
            moved.CopyFrom(edit)
            moved.index -= self._before
            self._writer.add("/edits", moved, step.server_time_ns)
        shifted = recording_pb2.RecordedStep()
        shifted.CopyFrom(step)
        shifted.index -= self._before
        self._writer.add("/inputs", shifted, step.server_time_ns)
        if self._cut is None and self._writer.size >= self._full_bytes and time.monotonic() >= self._retry_s:
            self._cut = self._take()

    def add_check(self, check: recording_pb2.StateCheck) -> None:
        """Adds a check to the file that has its step."""
        late = check.index <= self._before
        if not late:
            self._end_previous()
        writer = self._previous if late else self._writer
        if writer is None:
            return  # too late: the file with this step has ended
        shifted = recording_pb2.StateCheck()
        shifted.CopyFrom(check)
        shifted.index -= self._previous_before if late else self._before
        writer.add("/checks", shifted)

    def add_lost(self, gap: recording_pb2.LostSteps) -> None:
        """Adds a gap after the last step."""
        shifted = recording_pb2.LostSteps()
        shifted.CopyFrom(gap)
        shifted.first_index -= self._before
        self._writer.add("/lost", shifted)

    def flush_if_due(self) -> None:
        """Writes what is held for too long. Call it often."""
        self._writer.flush_if_due()

    def _use(self, cut: Cut, step: recording_pb2.RecordedStep, edits: Sequence[recording_pb2.RecordedEdit]) -> None:
        """Starts a file before `step` if the snapshot is of the step before it. Drops a snapshot that fits no more."""
        reached = self._step == cut.step and all(edit.HasField("reset") for edit in edits)
        if reached and (step.reset or step.server_time_ns >= cut.before_ns):
            self._next_file(cut)
        elif reached or edits or step.reset or step.step > cut.step:
            # The step of the snapshot was lost, or made after an edit.
            self._retry_s = time.monotonic() + RETRY_S
        else:
            return
        self._cut = None

    def _next_file(self, cut: Cut) -> None:
        self._end_previous()
        self._writer.flush()
        self._previous, self._previous_before = self._writer, self._before
        self._before = self._index
        self._count += 1
        start = recording_pb2.RecordingStart()
        start.CopyFrom(self._start)
        start.step, start.snapshot, start.server_time_ns = cut.step, cut.snapshot, cut.before_ns
        start.scene_hash = cut.scene_hash or start.scene_hash
        start.ClearField("adjustments")
        if cut.adjustments is not None:
            start.adjustments.CopyFrom(cut.adjustments)
        path = self._first.with_name(f"{self._first.stem}-{self._count}{self._first.suffix}")
        self._writer = self._open(path, start)
        self.paths.append(path)
        if self._keep is not None and len(self.paths) > self._keep:
            self.paths.pop(0).unlink(missing_ok=True)

    def _open(self, path: Path, start: recording_pb2.RecordingStart) -> RecordingWriter:
        writer = RecordingWriter(path)
        self._begin(writer, start)
        # A snapshot may be larger than a file should be.
        self._full_bytes = max(self._max_bytes, 2 * writer.size)
        return writer

    def _end_previous(self) -> None:
        previous, self._previous = self._previous, None
        if previous is not None:
            previous.close()
