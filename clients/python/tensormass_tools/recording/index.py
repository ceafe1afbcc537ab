"""An index of the frames of a recording, and its frames on demand: for recordings larger than memory.

    file    | chunk 0 | chunk 1 | ...
              scene     frame, step, step, frame, status ...      compressed
    index   for each frame: time, chunk, place in the chunk       a few bytes

One pass over the file makes the index. It checks every chunk's sum and forgets its content. A frame is read by its
chunk alone. A file that was cut off or damaged is indexed up to its last whole chunk.

Times of frames count simulated time, so that playing at speed 1 shows tissue as fast as it moved. A pause of the scene
takes no time, and after a reset or a restored snapshot the time goes on where it was. A snapshot of a later step than
the scene's takes the time in between.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import OrderedDict
from pathlib import Path
from typing import Final, TypeVar

from google.protobuf.message import Message

from tensormass import InvalidArgumentError, ResourceExhaustedError
from tensormass._shared.enums import short_name
from tensormass.v1 import changes_pb2, event_pb2, recording_pb2, stream_pb2
from tensormass_gateway.player import Mark
from tensormass_gateway.requests import is_name
from tensormass_tools.output import force_n
from tensormass_tools.recording.chunks import (
    CHANNELS,
    DAMAGE,
    Channels,
    ChunkPlace,
    Found,
    chunk_content,
    chunk_places,
)
from tensormass_tools.recording.edits import TEXTS
from tensormass_tools.recording.file import RecordingReader

#: Bytes of chunks that are held, because the next frame is often in the same one. At least one chunk is held.
MAX_HELD_BYTES = 64 << 20
#: Frames of a recording. An index of so many takes 440 MB.
MAX_FRAMES = 10_000_000
#: Marks of a recording. Later ones are left out.
MAX_MARKS = 500
#: Characters of the text of a mark.
MAX_MARK_TEXT = 200
#: A tool that touches again within this time makes no new mark.
CONTACT_APART_S = 0.5
#: Events that make a mark. Edits, steps and statuses make those of the others.
MARKED_EVENTS = frozenset(
    {
        event_pb2.SceneEvent.KIND_ABLATED,
        event_pb2.SceneEvent.KIND_CUT,
        event_pb2.SceneEvent.KIND_CUT_BEGUN,
        event_pb2.SceneEvent.KIND_CUT_ENDED,
        event_pb2.SceneEvent.KIND_PIECE_FREE,
        event_pb2.SceneEvent.KIND_SEVERED,
        event_pb2.SceneEvent.KIND_TOOL_ADDED,
        event_pb2.SceneEvent.KIND_TOOL_REMOVED,
        event_pb2.SceneEvent.KIND_ATTACHMENT_ADDED,
        event_pb2.SceneEvent.KIND_ATTACHMENT_REMOVED,
    }
)

#: Fields in which topologies of a recording differ.
_PARTS: Final = ("version", "tools", "attachments", "attachment_point_count")

Kind = TypeVar("Kind", bound=Message)


class RecordingIndex:
    """A recording with frames, as the gateway plays it.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: the file is not a recording, or has no frames.
        ResourceExhaustedError: a named limit of this file is exceeded.
    """

    def __init__(self, path: Path) -> None:
        reader = RecordingReader(path)
        self.name = path.name
        self.scene, self.start = reader.scene, reader.start
        #: With the tools and attachments of the first frame.
        self.topology = stream_pb2.Topology()
        # Tools and attachments of each version of the topology, which differ by nothing else.
        self._parts: dict[int, stream_pb2.Topology] = {}
        # What topology_of made last: a topology may hold pictures, and most frames follow one of the same version.
        self._with_other_parts = stream_pb2.Topology()
        #: Time of each frame from the first one [s].
        self.times_s = array("d")
        self.marks: list[Mark] = []
        #: Why the recording ends early; empty: it does not.
        self.note = ""
        self._path = path
        self._whole_bytes, self._cut_off = reader.whole_bytes, reader.cut_off
        self._held: OrderedDict[int, bytes] = OrderedDict()
        self._frames = _Places()
        self._statuses = _Places()
        self._changes, self._events = _Places(), _Places()
        # Revision of each message of changes, and time of the newest event in each message of events. Both rise.
        self._revisions, self._event_times_ns = array("Q"), array("Q")
        # Number of statuses before each frame.
        self._statuses_before = array("I")
        damaged = self._read()
        if not self.times_s:
            raise InvalidArgumentError(
                f"{path}: has no frames to show; record them: tensormass record SCENE --frames -o FILE.mcap"
            )
        if not is_name(self.topology.scene):
            raise InvalidArgumentError(f"{path}: its scene has no valid name; the file is damaged")
        if damaged or self._cut_off:
            how = "is damaged" if damaged else "was cut off"
            self.note = f"The file {how}. It is shown up to its last whole chunk, at {self.times_s[-1]:.2f} s."

    def frame(self, index: int) -> stream_pb2.Frame:
        """Reads a frame. Raises InvalidArgumentError if the file has changed since it was opened."""
        return self._message(self._frames, index, stream_pb2.Frame)

    def status(self, index: int) -> stream_pb2.SceneStatus | None:
        """Reads the last status before a frame; None if there was none. Raises like `frame`."""
        before = self._statuses_before[index]
        return self._message(self._statuses, before - 1, stream_pb2.SceneStatus) if before > 0 else None

    def topology_of(self, frame: stream_pb2.Frame) -> stream_pb2.Topology:
        """Returns the topology with the tools and attachments of a frame."""
        if frame.topology_version == self.topology.version:
            return self.topology
        if frame.topology_version != self._with_other_parts.version:
            out = stream_pb2.Topology()
            out.CopyFrom(self.topology)
            for name in _PARTS:
                out.ClearField(name)
            out.MergeFrom(self._parts[frame.topology_version])
            self._with_other_parts = out
        return self._with_other_parts

    def changes(self, frame: stream_pb2.Frame) -> changes_pb2.SurfaceChanges | None:
        """Reads the newest changes of the surface that are not newer than a frame. Raises like `frame`."""
        at = bisect_right(self._revisions, frame.revision) - 1
        return self._message(self._changes, at, changes_pb2.SurfaceChanges) if at >= 0 else None

    def events(self, frame: stream_pb2.Frame) -> event_pb2.SceneEvents | None:
        """Reads the events up to a frame; None: none are recorded. Raises like `frame`."""
        at = bisect_right(self._event_times_ns, frame.server_time_ns) - 1
        return self._message(self._events, at, event_pb2.SceneEvents) if at >= 0 else None

    @property
    def held_bytes(self) -> int:
        """Bytes of the chunks that are held now."""
        return sum(map(len, self._held.values()))

    def _read(self) -> bool:
        """Makes the index. Returns whether a damaged chunk ended it."""
        timeline = _Timeline(self.times_s, self.marks)
        channels = Channels()
        with self._path.open("rb") as file:
            try:
                for place in chunk_places(self._path, self._whole_bytes, cut_off=self._cut_off):
                    for found in channels.messages(chunk_content(file, place)):
                        self._take(found, place, timeline)
            except DAMAGE:
                return True
        return False

    def _take(self, found: Found, place: ChunkPlace, timeline: _Timeline) -> None:
        message = CHANNELS[found.channel].FromString(found.data)
        if isinstance(message, stream_pb2.Topology):
            if not self._parts:
                self.topology = message
            if len(message.bodies) == len(self.topology.bodies):
                self._parts[message.version] = _parts_of(message)
        elif isinstance(message, recording_pb2.RecordedEdit):
            timeline.take_edit(message)
        elif isinstance(message, recording_pb2.RecordedStep):
            timeline.take_step(message)
        elif isinstance(message, stream_pb2.SceneStatus):
            timeline.take_status(message)
            self._statuses.add(place, found.at, len(found.data))
        elif isinstance(message, changes_pb2.SurfaceChanges):
            rises = not self._revisions or message.revision >= self._revisions[-1]
            if rises and message.topology_version in self._parts:
                self._revisions.append(message.revision)
                self._changes.add(place, found.at, len(found.data))
        elif isinstance(message, event_pb2.SceneEvents):
            newest_ns = message.events[-1].server_time_ns if message.events else 0
            if newest_ns >= (self._event_times_ns[-1] if self._event_times_ns else 1):
                timeline.take_events(message)
                self._event_times_ns.append(newest_ns)
                self._events.add(place, found.at, len(found.data))
        elif isinstance(message, stream_pb2.Frame) and message.topology_version in self._parts:
            base = 12 * sum(body.vertex_count for body in self.topology.bodies)
            more = len(message.positions) - base
            if more < 0 or more % 12 or (more and message.revision == 0):
                raise ValueError("a frame does not fit its topology")
            if len(self.times_s) == MAX_FRAMES:
                raise ResourceExhaustedError(f"{self._path}: has more than {MAX_FRAMES} frames")
            timeline.take_frame(message)
            self._frames.add(place, found.at, len(found.data))
            self._statuses_before.append(len(self._statuses))

    def _message(self, places: _Places, index: int, kind: type[Kind]) -> Kind:
        place, at, size = places.of(index)
        try:
            content = self._held.get(place.at)
            if content is None:
                with self._path.open("rb") as file:
                    content = chunk_content(file, place)
                self._hold(place.at, content)
            self._held.move_to_end(place.at)
            return kind.FromString(content[at : at + size])
        except OSError as error:
            raise InvalidArgumentError(f"{self._path}: {error.strerror}") from error
        except DAMAGE as error:
            raise InvalidArgumentError(f"{self._path}: has changed since it was opened; open it again") from error

    def _hold(self, chunk_at: int, content: bytes) -> None:
        self._held[chunk_at] = content
        while len(self._held) > 1 and self.held_bytes > MAX_HELD_BYTES:
            self._held.popitem(last=False)


def _parts_of(topology: stream_pb2.Topology) -> stream_pb2.Topology:
    return stream_pb2.Topology(
        version=topology.version,
        tools=topology.tools,
        attachments=topology.attachments,
        attachment_point_count=topology.attachment_point_count,
    )


class _Places:
    """The places of messages in the file: 32 bytes each."""

    def __init__(self) -> None:
        self._numbers = array("Q")

    def __len__(self) -> int:
        return len(self._numbers) // 4

    def add(self, place: ChunkPlace, at: int, size: int) -> None:
        """Adds a message: its chunk, and its own place and size in the content of the chunk."""
        self._numbers.extend((place.at, place.size, at, size))

    def of(self, index: int) -> tuple[ChunkPlace, int, int]:
        chunk_at, chunk_size, at, size = self._numbers[4 * index : 4 * index + 4]
        return ChunkPlace(chunk_at, chunk_size), at, size


class _Timeline:
    """Turns simulated times, which start again at a reset, into times that never fall. Notes what happened.

    Frames and steps come by two ways, so a frame may come before or after the edit that it shows.
    """

    def __init__(self, times_s: array[float], marks: list[Mark]) -> None:
        self._times_s = times_s
        self._marks = marks
        self._last = stream_pb2.Frame()
        self._touched_s: dict[str, float] = {}
        self._guard_events: int | None = None
        self._recovering = False
        # The last frame whose step fell, by its place and its dt, until an edit says why.
        self._fell: tuple[int, float] | None = None
        # Step of a restored snapshot that no frame has shown yet.
        self._restored: int | None = None
        self._last_event = 0

    def take_frame(self, frame: stream_pb2.Frame) -> None:
        if not math.isfinite(frame.simulated_time_s):
            raise ValueError("a frame has no finite time")
        last = self._last
        now_s = 0.0
        if self._times_s:
            if frame.step < last.step:
                dt_s = frame.simulated_time_s / frame.step if frame.step > 0 else 0.0
                begin_s = 0.0
                if self._restored is None:
                    self._fell = (len(self._times_s), dt_s)
                else:
                    begin_s = self._restored * dt_s
                self._restored = None
            else:
                begin_s = last.simulated_time_s
            now_s = self._times_s[-1] + max(0.0, frame.simulated_time_s - begin_s)
            self._times_s.append(now_s)
        else:
            self._times_s.append(now_s)
        self._last = stream_pb2.Frame(step=frame.step, simulated_time_s=frame.simulated_time_s)
        for tool in frame.tools:
            if force_n(tool) > 0:
                if not now_s - self._touched_s.get(tool.tool, -math.inf) < CONTACT_APART_S:
                    self._mark("contact", f"{tool.tool} touches.")
                self._touched_s[tool.tool] = now_s

    def take_edit(self, edit: recording_pb2.RecordedEdit) -> None:
        kind = edit.WhichOneof("edit")
        if kind is None or (kind == "reset" and edit.index == 1):  # a recording may begin with a reset
            return
        self._mark(kind, TEXTS[kind])
        if kind == "adjust":
            return
        fell, self._fell = self._fell, None
        self._restored = None
        if kind == "reset":
            return
        if fell is None:
            self._restored = edit.step
            return
        at, dt_s = fell
        passed_s = self._times_s[at] - self._times_s[at - 1]
        for later in range(at, len(self._times_s)):
            self._times_s[later] -= min(edit.step * dt_s, passed_s)

    def take_step(self, step: recording_pb2.RecordedStep) -> None:
        if step.reset and step.edits == 0 and step.index > 1:  # the recording has no edits
            self._fell = None
            self._mark("reset", TEXTS["reset"])
        if step.rejected:
            self._mark("stop", "A guard stopped the scene.")
        if step.recovered and not self._recovering:
            self._mark("recovery", "The scene recovers: tools back off, or the tissue is held.")
        self._recovering = step.recovered

    def take_events(self, message: event_pb2.SceneEvents) -> None:
        for event in message.events:
            if event.sequence > self._last_event:
                self._last_event = event.sequence
                if event.kind in MARKED_EVENTS:
                    kind = short_name(event_pb2.SceneEvent.Kind.DESCRIPTOR, event.kind)
                    self._mark(kind, f"{event.text[:1].upper()}{event.text[1:]}.")

    def take_status(self, status: stream_pb2.SceneStatus) -> None:
        # Steps of a recovery leave their bounds too, but `take_step` marks them.
        events = status.guard_events - status.recovering_steps
        before, self._guard_events = self._guard_events, events
        if before is not None and events > before:
            self._mark("guard", status.guard_text)

    def _mark(self, kind: str, text: str) -> None:
        if len(self._marks) < MAX_MARKS:
            self._marks.append(Mark(self._times_s[-1] if self._times_s else 0.0, kind, text[:MAX_MARK_TEXT]))
