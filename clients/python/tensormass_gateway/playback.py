"""A recording in the place of a daemon: the gateway serves it as a scene, with a play head that all browsers share.

    recording --frames on demand--> player --streams--> a slot per browser and stream --WebSocket--> browser
                                      ^---- commands of operators ----------------------------------

Browsers share the head as they share a running scene: who opens the page later sees what the others see. The
recording pauses when the last browser leaves.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from tensormass import TensormassError
from tensormass.v1 import changes_pb2, event_pb2, gateway_pb2, scene_pb2, stream_pb2
from tensormass_gateway.control import Action, Command, CommandError, Outcome
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.player import Player, Recording
from tensormass_gateway.requests import ProtocolError, printable
from tensormass_gateway.streams import SceneStreams

SERVER = "recording"
"""Name of the server in the keys of the streams."""

SHORTEST_WAIT_S = 1 / 60
"""Frames that follow each other faster are skipped."""


class _Shown(NamedTuple):
    """A frame of the recording with everything that belongs to it."""

    frame: stream_pb2.Frame
    topology: stream_pb2.Topology
    status: stream_pb2.SceneStatus
    changes: changes_pb2.SurfaceChanges | None
    events: event_pb2.SceneEvents | None


class RecordedStreams(SceneStreams):
    """The streams of the scene in a recording."""

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording.topology.scene)
        self._recording = recording

    @property
    def server(self) -> str:
        return SERVER

    @property
    def known(self) -> scene_pb2.Scene | None:
        return self._recording.scene


class Playback:
    """Plays a recording to browsers.

    It has those methods of `daemon.Daemon` and `control.Control` that a gateway uses.
    """

    def __init__(
        self,
        recording: Recording,
        on_change: Callable[[], None],
        on_head: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Makes a playback that stands still at the first frame.

        Args:
            on_change: called when `state` has changed.
            on_head: called when `head` has changed.
        """
        self.player = Player(recording.times_s, clock)
        self.malformed = 0
        self._recording = recording
        self._streams = RecordedStreams(recording)
        self._on_change = on_change
        self._on_head = on_head
        self._problem = ""
        self._commanded = asyncio.Event()
        self._shown: int | None = None
        self._status: stream_pb2.SceneStatus | None = None
        self._sent_status = self._sent_events = b""
        self._sequence = 0

    async def follow(self) -> None:
        """Plays until cancelled."""
        self._streams.set_topology(self._recording.topology)
        while True:
            self._commanded.clear()
            self.player.advance()
            await self._show()
            wait_s = self.player.wait_s()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if wait_s is None else max(wait_s, SHORTEST_WAIT_S)):
                    await self._commanded.wait()

    async def close(self) -> None:
        self._streams.close()

    async def metrics(self) -> str:
        """Returns nothing: a recording has no daemon."""
        return ""

    def watch(self, watcher: Watcher, scene: str) -> None:
        """Moves `watcher` to `scene`. Another scene than the recorded one has no streams."""
        self._streams.watchers.discard(watcher)
        watcher.outbox.clear()
        watcher.scene, watcher.field = scene, ""
        if scene == self._streams.scene:
            self._streams.add(watcher)

    def leave(self, watcher: Watcher) -> None:
        """Removes `watcher`. Pauses when the last one leaves."""
        self._streams.watchers.discard(watcher)
        if not self._streams.watchers and self.player.playing:
            self.player.pause()
            self._commanded.set()

    def show_detail(self, watcher: Watcher) -> None:
        """Sends `watcher` the recording in the detail that it chose anew."""
        if watcher in self._streams.watchers:
            self._streams.show_detail(watcher)

    def show_field(self, watcher: Watcher, name: str) -> None:
        """Does nothing: element fields are not recorded."""

    def move_tool(
        self,
        watcher: Watcher,
        tool: str,
        position_m: Sequence[float],
        orientation_wxyz: Sequence[float] | None,
        level: float = 0.0,
    ) -> None:
        raise ProtocolError("a recording takes no poses")

    async def execute(self, command: Command) -> Outcome:
        """Executes a command. Raises CommandError with the reason of a failure."""
        if command.scene != self._streams.scene:
            raise CommandError(f"this gateway shows a recording of {self._streams.scene!r} only")
        match command.action:
            case Action.PAUSE:
                self.player.pause()
            case Action.RESUME:
                self.player.play()
            case Action.STEP:
                self.player.step(command.steps)
            case Action.STEP_BACK:
                self.player.step(-command.steps)
            case Action.RESET:
                self.player.seek(0.0)
            case Action.SEEK:
                self.player.seek(command.time_s)
            case Action.SPEED:
                self.player.set_speed(command.speed)
            case Action.LOAD | Action.UNLOAD | Action.ADJUST:
                raise CommandError("this gateway shows a recording; it neither loads nor adjusts scenes")
        self._commanded.set()
        return Outcome(command.scene)

    def state(self) -> gateway_pb2.DaemonState:
        """Returns what all browsers are told in place of a daemon."""
        start = self._recording.start
        return gateway_pb2.DaemonState(
            server=SERVER,
            version=start.server_version,
            backend=start.backend,
            device=start.device,
            scenes=[self._streams.scene],
            recording=gateway_pb2.ShownRecording(
                file=printable(self._recording.name),
                duration_s=self.player.duration_s,
                frames=len(self._recording.times_s),
                marks=[gateway_pb2.RecordingMark(**mark._asdict()) for mark in self._recording.marks],
                note=printable(self._problem or self._recording.note),
            ),
        )

    def head(self) -> gateway_pb2.PlayHead:
        """Returns where the play head is."""
        player = self.player
        return gateway_pb2.PlayHead(
            time_s=player.time_s, frame=player.index, playing=player.playing, speed=player.speed
        )

    async def _show(self) -> None:
        """Publishes the frame at the head, and the status that belongs to it."""
        index, playing = self.player.index, self.player.playing
        if index != self._shown:
            try:
                # Reads the disk, while browsers are served.
                shown = await asyncio.to_thread(self._read, index)
            except TensormassError as error:
                self.player.pause()
                self._tell(str(error))
            else:
                self._tell("")
                if self._streams.topology is None or self._streams.topology.version != shown.topology.version:
                    self._streams.set_topology(shown.topology)
                self._publish_changes(shown)
                self._publish_status(shown.status, playing=playing)
                self._publish_frame(shown.frame)
            self._shown = index
        elif self._status is not None:
            self._publish_status(self._status, playing=playing)
        self._on_head()

    def _read(self, index: int) -> _Shown:
        frame = self._recording.frame(index)
        status = self._recording.status(index) or stream_pb2.SceneStatus(server_time_ns=frame.server_time_ns)
        topology = self._recording.topology_of(frame)
        return _Shown(frame, topology, status, self._recording.changes(frame), self._recording.events(frame))

    def _publish_changes(self, shown: _Shown) -> None:
        """Publishes surface and events as they were at a frame, which may be earlier than what is on show."""
        version = self._recording.topology.version
        try:
            changes = shown.changes or changes_pb2.SurfaceChanges()
            changes.topology_version = shown.topology.version  # they may be older than the tools
            self._streams.set_changes(changes, may_go_back=True)
        except ValueError as error:
            self._tell(str(error))
        message = self._streams.message(Stream.EVENTS, shown.events or event_pb2.SceneEvents(topology_version=version))
        if message != self._sent_events and (self._sent_events or shown.events is not None):
            self._sent_events = message
            self._streams.publish(Stream.EVENTS, message)

    def _publish_frame(self, frame: stream_pb2.Frame) -> None:
        # Counts what is sent, because a gap in the recorded sequence is not a frame that a browser has missed.
        self._sequence += 1
        frame.sequence = self._sequence
        self._streams.publish(Stream.FRAME, self._streams.shared(self._streams.message(Stream.FRAME, frame), frame))

    def _publish_status(self, status: stream_pb2.SceneStatus, *, playing: bool) -> None:
        """Publishes a status, if it differs from the last one. The state of a scene that had stopped stays."""
        if status.state != stream_pb2.SceneStatus.STATE_FAULTED:
            playing_state, still = stream_pb2.SceneStatus.STATE_RUNNING, stream_pb2.SceneStatus.STATE_PAUSED
            status.state = playing_state if playing else still
        status.scene = self._streams.scene
        message = self._streams.message(Stream.STATUS, status)
        if message != self._sent_status:
            self._streams.publish(Stream.STATUS, message)
        self._status, self._sent_status = status, message

    def _tell(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            self._on_change()
