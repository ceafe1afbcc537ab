"""`tensormass record`: records the inputs of a scene and checks of its state to an MCAP file.

    daemon ──RecordScene──> thread ──> queue ──> main thread ──> file
           ──frames───────> thread ──┘             │ a status each second

A file that is full is followed by another one (files.py).

If the disk is too slow, the queue fills, gRPC stops reading, and the daemon counts the steps that are lost. The file
then says which.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import queue
import threading
import time
from collections.abc import Iterator
from typing import Any

import grpc

from tensormass import (
    LOAD_TIMEOUT_S,
    DeadlineExceededError,
    InvalidArgumentError,
    NotFoundError,
    SceneHandle,
    Server,
    TensormassError,
)
from tensormass._shared.errors import from_rpc_error
from tensormass._shared.processes import end_explained
from tensormass.v1 import changes_pb2, control_pb2, event_pb2, recording_pb2, stream_pb2
from tensormass_tools import presets
from tensormass_tools.daemon_arguments import daemon_of
from tensormass_tools.output import check_writable, load_line, print_json
from tensormass_tools.recording.file import RecordingWriter
from tensormass_tools.recording.files import Cut, RecordingFiles
from tensormass_tools.running import announced

# Messages that wait for the disk.
_QUEUED = 64
_STATUS_S = 1.0
_WAIT_S = 0.1
# Larger numbers are mistakes.
_MOST_STEPS = 10**9
# Steps of one call in lockstep, so that the recorder keeps up.
_STEPS_A_CALL = 1000


def run(args: argparse.Namespace) -> int:
    """Records. Returns 0 if no step was lost."""
    if args.output.suffix != ".mcap":
        raise InvalidArgumentError(f"--output {args.output}: must end in .mcap")
    check_writable("--output", args.output)
    if args.steps is not None and not 0 < args.steps <= _MOST_STEPS:
        raise InvalidArgumentError(f"--steps {args.steps}: must be 1 to {_MOST_STEPS}")
    if args.seconds is not None and not 0 < args.seconds <= _MOST_STEPS:
        raise InvalidArgumentError(f"--seconds {args.seconds:g}: must be positive")
    if not 0 <= args.check_every < 2**32:
        raise InvalidArgumentError(f"--check-every {args.check_every}: must be 0 or more")
    if not args.max_size > 0:
        raise InvalidArgumentError(f"--max-size {args.max_size}: must be positive")
    if args.keep is not None and args.keep < 1:
        raise InvalidArgumentError(f"--keep {args.keep}: at least the newest file must stay")
    if args.attach is not None and args.server is None:
        raise InvalidArgumentError("--attach needs --server: which daemon has the scene?")
    scene = presets.read_scene(args.scene, args.preset)
    lockstep = args.lockstep or scene.message.stepping.lockstep
    if lockstep and args.steps is None and args.attach is None and args.server is None:
        raise InvalidArgumentError(f"scene {scene.name!r} steps only when asked: give --steps")
    with daemon_of(args, zenoh=True) as server, end_explained(server.process, server.log_file):
        if args.attach is not None:
            handle = server.scene(args.attach)
            handle.message = scene.message
        else:
            handle = server.load(scene, lockstep=args.lockstep, progress=load_line(quiet=args.json))
        try:
            with contextlib.nullcontext() if args.server else announced(server.address, handle.name):
                if not args.json:
                    until = "" if args.steps or args.seconds else " until Ctrl-C"
                    print(f"recording {handle.name} to {args.output}{until}, control {server.address}", flush=True)
                recorder = Recorder(args, server, handle)
                recorder.record()
        finally:
            if args.attach is None:
                with contextlib.suppress(TensormassError):
                    handle.unload()
    summary = recorder.summary()
    if args.json:
        print_json(summary)
    else:
        files = ", ".join(summary["files"])
        print(f"wrote {files}: {summary['steps']} steps, {summary['checks']} checks")
        if recorder.recovered:
            print(f"the scene recovered in {recorder.recovered} steps: tools backed off, or the tissue was held")
        if recorder.checks == 0 and recorder.steps > 0:
            print("without checks a replay compares nothing; record more steps, or give a smaller --check-every")
        if recorder.lost:
            print(f"{recorder.lost} steps were lost, because the file was written too slowly: a replay ends there")
    return 1 if recorder.lost else 0


class Recorder:
    """One recording."""

    def __init__(self, args: argparse.Namespace, server: Server, handle: SceneHandle) -> None:
        self._args = args
        self._server = server
        self._handle = handle
        self._queue: queue.Queue[Any] = queue.Queue(_QUEUED)
        self._ends = threading.Event()
        self.steps = self.recovered = self.checks = self.frames = self.lost = self.lost_checks = self.edits = 0
        self.files: list[str] = [str(args.output)]
        # The newest ones: each file begins with them.
        self._changes: changes_pb2.SurfaceChanges | None = None
        self._events: event_pb2.SceneEvents | None = None
        self._topology_version = 0  # the newest one in the file
        self._due_checks = 0  # each comes after its step, perhaps in a later message, or is counted as lost

    def summary(self) -> dict[str, Any]:
        """Returns counts of the recording, for people and JSON."""
        return {
            "scene": self._handle.name,
            "output": str(self._args.output),
            "files": self.files,
            "steps": self.steps,
            "recovered_steps": self.recovered,
            "edits": self.edits,
            "checks": self.checks,
            "frames": self.frames,
            "lost_steps": self.lost,
            "lost_checks": self.lost_checks,
        }

    def record(self) -> None:
        """Records until told to end, or until the scene is unloaded."""
        request = control_pb2.RecordSceneRequest(
            scene=self._handle.name, check_every_steps=self._args.check_every, reset=self._args.attach is None
        )
        stream = self._server.call("RecordScene", request, timeout_s=None)
        with _explained():
            start = next(stream).start
        # Now, because a file that is there must not be lost to a call that fails.
        files = RecordingFiles(self._args.output, start, self._begin, self._cut, self._args.max_size, self._args.keep)
        with files as writer:
            threads = [threading.Thread(target=self._read, args=(stream,), name="record")]
            if self._args.frames:
                threads.append(threading.Thread(target=self._read_frames, name="record frames"))
            try:
                for thread in threads:
                    thread.start()
                self._write(writer)
            except KeyboardInterrupt:
                pass  # this is how a recording ends
            finally:
                self._ends.set()
                stream.cancel()
                for thread in threads:
                    if thread.ident is not None:
                        thread.join()
                        self._drain(writer)
                self.files = [str(path) for path in writer.paths]

    def _begin(self, writer: RecordingWriter, start: recording_pb2.RecordingStart) -> None:
        assert self._handle.message is not None
        writer.add("/scene", self._handle.message, start.server_time_ns)
        writer.add("/start", start)
        if self._args.frames:
            self._add_topology(writer)
            if self._changes is None:
                with contextlib.suppress(TensormassError):  # a scene without frames
                    self._changes = self._handle.frame().surface.changes
            if self._changes is not None and self._changes.revision > 0:
                writer.add("/changes", self._changes)
            if self._events is not None:
                writer.add("/events", self._events)
        writer.flush()

    def _add_topology(self, writer: RecordingWriter | RecordingFiles) -> None:
        topology = self._handle.topology()
        self._topology_version = topology.version
        writer.add("/topology", topology)

    def _cut(self) -> Cut:
        before_ns = self._handle.status().server_time_ns
        request = control_pb2.SnapshotSceneRequest(scene=self._handle.name)
        reply = self._server.call("SnapshotScene", request, timeout_s=LOAD_TIMEOUT_S)
        adjustments = reply.adjustments if reply.HasField("adjustments") else None
        return Cut(reply.step, before_ns, reply.snapshot, reply.scene_hash, adjustments)

    def _write(self, writer: RecordingFiles) -> None:
        begin = next_status_s = time.monotonic()
        self._start_steps()
        while not self._is_over(begin):
            with contextlib.suppress(queue.Empty):
                self._add(writer, self._queue.get(timeout=_WAIT_S))
            if time.monotonic() >= next_status_s:
                with contextlib.suppress(NotFoundError):  # unloaded: the stream ends too
                    status = self._handle.status()
                    writer.add("/status", status, status.server_time_ns)
                next_status_s = time.monotonic() + _STATUS_S
            writer.flush_if_due()

    def _is_over(self, begin: float) -> bool:
        args = self._args
        if self._ends.is_set() and self._queue.empty():
            return True
        if args.seconds is not None and time.monotonic() - begin >= args.seconds:
            return True
        return (
            args.steps is not None
            and self.steps + self.lost >= args.steps
            and self.checks + self.lost_checks >= self._due_checks
        )

    def _start_steps(self) -> None:
        """Steps a scene in lockstep, on a thread of its own."""
        if self._args.steps is None or self._handle.status().state != stream_pb2.SceneStatus.STATE_LOCKSTEP:
            return

        def steps() -> None:
            left = self._args.steps
            while left > 0 and not self._ends.is_set():
                count = min(left, _STEPS_A_CALL)
                self._handle.step(count)
                left -= count

        threading.Thread(target=self._guarded, args=(steps,), name="steps", daemon=True).start()

    def _guarded(self, work: Any) -> None:  # noqa: ANN401
        """Runs the work of a thread. Its error ends the recording, and `_add` raises it."""
        try:
            work()
        except TensormassError as error:
            self._put(error)

    def _read(self, stream: Any) -> None:  # noqa: ANN401
        try:
            for response in stream:
                self._put(response)
        except grpc.RpcError as error:
            if not self._ends.is_set():
                self._put(from_rpc_error(error))
        finally:
            self._ends.set()

    def _read_frames(self) -> None:
        def frames() -> None:
            plane, name = self._server.data_plane, self._handle.name
            with (
                plane.subscribe(name, "changes", changes_pb2.SurfaceChanges, "zeromq") as changes,
                plane.subscribe(name, "events", event_pb2.SceneEvents, "zeromq") as events,
                plane.subscribe(name, "frame", stream_pb2.Frame, "zeromq") as frames,
            ):
                while not self._ends.is_set():
                    frame = None
                    with contextlib.suppress(DeadlineExceededError):
                        frame = frames.receive(_WAIT_S)
                    # One thread for all three: changes come before the frames that follow them.
                    for item in (changes.newest(), events.newest(), frame):
                        if item is not None:
                            self._put(item)

        self._guarded(frames)

    def _put(self, item: Any) -> None:  # noqa: ANN401
        """Waits while the disk is behind. Drops the item once the main thread writes no more."""
        while True:
            with contextlib.suppress(queue.Full):
                self._queue.put(item, timeout=_WAIT_S)
                return
            if self._ends.is_set():
                return

    def _drain(self, writer: RecordingFiles) -> None:
        with contextlib.suppress(queue.Empty, TensormassError):
            while True:
                self._add(writer, self._queue.get_nowait())

    def _add(self, writer: RecordingFiles, item: Any) -> None:  # noqa: ANN401
        if isinstance(item, TensormassError):
            raise item
        if isinstance(item, changes_pb2.SurfaceChanges):
            if item.revision > (self._changes.revision if self._changes is not None else 0):
                self._changes = item
                writer.add("/changes", item)
            return
        if isinstance(item, event_pb2.SceneEvents):
            # The bus repeats a message when somebody else subscribes.
            if item.events and item != self._events:
                self._events = item
                writer.add("/events", item)
            return
        if isinstance(item, stream_pb2.Frame):
            if item.topology_version > self._topology_version:  # tools were added or removed
                with contextlib.suppress(NotFoundError):  # unloaded: the stream ends too
                    self._add_topology(writer)
            writer.add("/frames", item, item.server_time_ns)
            self.frames += 1
            return
        for gap in item.lost:
            writer.add_lost(gap)
            self.lost += gap.count
        edits = iter(item.edits)
        for step in item.steps:
            writer.add_step(step, list(itertools.islice(edits, step.edits)))
            self._due_checks += self._has_check(step)
        for check in item.checks:
            writer.add_check(check)
        self.steps += len(item.steps)
        self.edits += len(item.edits)
        self.recovered += sum(step.recovered for step in item.steps)
        self.checks += len(item.checks)
        self.lost_checks = item.lost_checks

    def _has_check(self, step: recording_pb2.RecordedStep) -> bool:
        every = self._args.check_every
        return every > 0 and step.index % every == 0 and not step.rejected


@contextlib.contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except grpc.RpcError as error:
        raise from_rpc_error(error) from error
