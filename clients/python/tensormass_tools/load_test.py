"""`tensormass load-test`: drives a daemon with real clients and measures what they see.

The scenes are copies of one scene. Haptic clients are `tensormass-haptic` processes, each with a tool of its own.
Viewers are Python processes that take every frame they can get. With the mixed transport, every second client uses
zenoh and the others ZeroMQ. Every wait has a deadline, and no process outlives the test. If a scene is stopped or a
client ends while the clients run, the test continues and reports it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tensormass import InvalidArgumentError, Scene, SceneHandle, Server, UnavailableError, connect, launch
from tensormass._shared.files import replacing
from tensormass._shared.processes import ChildProcess, end_explained, find_program
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools import load_report
from tensormass_tools.load_edits import Edits, with_editing
from tensormass_tools.load_report import Json
from tensormass_tools.output import check_writable, load_silently
from tensormass_tools.tool_sizes import movable_tools, radius_m

_MAX_TOOLS = 16
_READY_TIMEOUT_S = 60.0
# Time beyond its --seconds in which a haptic client connects (10 s), drains (1 s) and reports [s].
_HAPTIC_MARGIN_S = 20.0
_POLL_S = 0.02
_FAULTED = stream_pb2.SceneStatus.STATE_FAULTED


def run(args: argparse.Namespace) -> int:
    """Runs the load test. Returns 0 if nothing went wrong, else 1."""
    file = Path(args.json) if args.json not in (None, "-") else None
    if file is not None:
        check_writable("--json", file)
    report = load_test(args)
    try:
        if file is not None:
            with replacing(file) as aside:
                aside.write_text(json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise InvalidArgumentError(f"--json {file}: cannot be written: {error.strerror}") from error
    finally:  # if one of the two fails, the other still has the measurements
        print(json.dumps(report, indent=1) if args.json == "-" else load_report.to_text(report))
    return 1 if report["errors"] else 0


def load_test(args: argparse.Namespace) -> Json:
    """Runs the test and returns the report. Its `errors` name the clients that failed.

    Raises:
        TensormassError: the test could not be set up.
    """
    if args.stop_viewer is not None and args.viewers == 0:
        raise InvalidArgumentError("--stop-viewer needs a viewer; give --viewers 1 or more")
    if args.stop_viewer is not None and args.edits is not None:
        raise InvalidArgumentError("--stop-viewer and --edits compare parts of the same time; give one of them")
    if args.haptic > args.scenes * _MAX_TOOLS:
        raise InvalidArgumentError(
            f"--haptic {args.haptic}: at most {_MAX_TOOLS} tools in each of {args.scenes} scenes"
        )
    with contextlib.ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="tensormass-load-")))
        server = undo.enter_context(
            connect(args.server, keys=args.keys)
            if args.server
            else launch(backend=args.backend, gpu_scenes=args.scenes)
        )
        undo.enter_context(end_explained(server.process, server.log_file))
        test = _LoadTest(args, server, folder, undo)
        return test.run()


@dataclass
class _Client:
    """A client process and its task."""

    process: ChildProcess
    scene: str
    transport: str
    log_file: Path
    report_file: Path
    ready_file: Path
    status: int | None = None
    #: True if the process ended before it was told to.
    ended_early: bool = False

    def failure(self) -> str | None:
        if self.status == 0 and not self.ended_early:
            return None
        log = self.log_file.read_text(errors="replace").strip().splitlines()
        early = "ended early with " if self.ended_early else ""
        return f"{early}status {self.status}: {log[-1] if log else 'no word'}"


class _LoadTest:
    def __init__(self, args: argparse.Namespace, server: Server, folder: Path, undo: contextlib.ExitStack) -> None:
        self._args = args
        self._server = server
        self._folder = folder
        self._undo = undo
        self._errors: list[str] = []

    def run(self) -> Json:
        args = self._args
        source = Scene.from_file(args.scene).message
        tools = with_tools(source, math.ceil(args.haptic / args.scenes))
        if args.edits is not None:
            tools = with_editing(tools)
        malformed_before = self._server.version().malformed_messages
        # A shared daemon may have scenes of another load test.
        scenes = [self._load(tools, f"load-test-{os.getpid()}-{i}") for i in range(args.scenes)]
        viewers = [self._start_viewer(i, scenes[i % args.scenes]) for i in range(args.viewers)]
        self._wait_until_ready(viewers)

        started_at = time.time()
        started = time.monotonic()
        before = [scene.status() for scene in scenes]
        phase_s = float(args.stop_viewer) if args.stop_viewer is not None else 0.0
        seconds = max(args.seconds, 3 * phase_s)
        haptics = [
            self._start_haptic(i, scenes[i % args.scenes], movable_tools(tools)[i // args.scenes].name, seconds)
            for i in range(args.haptic)
        ]
        stopped = self._with_a_stopped_viewer(viewers[0], scenes[0], phase_s) if phase_s else None
        edits = None
        if args.edits is not None:
            edits = Edits(scenes, args.edits).run(seconds, lambda done: self._watch(viewers, done))
            if edits["refused"]:
                self._errors.append(f"{edits['refused']} edits were refused, the first: {edits['first_refusal']}")
        self._watch(viewers, lambda: time.monotonic() >= started + seconds)
        self._watch(
            viewers,
            lambda: (
                time.monotonic() >= started + seconds + _HAPTIC_MARGIN_S or not any(c.process.running for c in haptics)
            ),
        )
        after = [scene.status() for scene in scenes]
        measured_s = time.monotonic() - started
        haptic_reports = [self._end_haptic(client) for client in haptics]
        viewer_reports, ages = self._end_viewers(viewers, stopped is not None)

        version = self._server.version()
        malformed = version.malformed_messages - malformed_before
        if malformed:
            self._errors.append(f"{malformed} messages reached the daemon malformed")
        reports = [client for client in haptic_reports if client]
        for status in after:
            if status.state == _FAULTED:
                self._errors.append(f"scene {status.scene} is faulted: {status.fault}")
        sent: dict[str, int | None] = {scene.name: 0 for scene in scenes}
        for client, of in zip(haptics, haptic_reports, strict=True):
            so_far = sent[client.scene]
            # Without its report, the number of poses that a client sent is unknown.
            sent[client.scene] = so_far + int(of["poses_sent"]) if of and so_far is not None else None
        scene_reports = [
            load_report.scene_report(b, a, sent[scene.name]) for scene, b, a in zip(scenes, before, after, strict=True)
        ]
        if args.max_missed is not None:
            self._errors += load_report.above_max_missed(scene_reports, args.max_missed)
        return {
            "started_unix_s": started_at,
            "seconds": measured_s,
            "scene_source": args.scene,
            "cpu_count": os.cpu_count(),
            "server": {
                "version": version.version,
                "backend": version.backend,
                "device": version.device,
                "own": args.server is None,
            },
            "pose_to_force": load_report.merged_histogram(client["pose_to_force"] for client in reports),
            "answered_pose_age": load_report.merged_histogram(client["answered_pose_age"] for client in reports),
            **{
                part: load_report.merged_histogram(client[part] for client in reports)
                for part in load_report.PARTS_OF_THE_AGE
            },
            "frame_age": load_report.percentiles(ages),
            "poses_lost_at_end": sum(
                int(client["last_sequence_sent"] - client["last_sequence_echoed"]) for client in reports
            ),
            "scenes": scene_reports,
            "haptic": reports,
            "viewers": viewer_reports,
            "stopped_viewer": stopped,
            "edits": edits,
            "errors": self._errors,
        }

    # --- set-up -------------------------------------------------------------------------------------------------------

    def _load(self, scene: scene_pb2.Scene, name: str) -> SceneHandle:
        handle = self._server.load(scene, name=name, lockstep=False, progress=load_silently)
        if self._args.server is not None:  # the test's own daemon ends anyway
            self._undo.callback(handle.unload)
        return handle

    def _transport(self, index: int) -> str:
        if self._args.transport != "mixed":
            return str(self._args.transport)
        return "zenoh" if index % 2 else "zeromq"

    def _keys(self) -> list[str | Path]:
        return ["--keys", self._args.keys] if self._args.keys else []

    def _start(self, name: str, scene: SceneHandle, transport: str, command: Sequence[str | Path]) -> _Client:
        """Starts a client. Its command gets the names of its files from `_file`."""
        log_file = self._file(name, "log")
        with log_file.open("wb") as log:
            process = ChildProcess(command, output=log)
        self._undo.callback(process.stop)
        return _Client(process, scene.name, transport, log_file, self._file(name, "report"), self._file(name, "ready"))

    def _file(self, name: str, kind: str) -> Path:
        return self._folder / f"{name}.{kind}"

    def _start_viewer(self, index: int, scene: SceneHandle) -> _Client:
        name, transport = f"viewer-{index}", self._transport(index)
        command: list[str | Path] = [
            sys.executable,
            "-m",
            "tensormass_tools.load_viewer",
            "--server",
            self._server.address,
        ]
        command += ["--scene", scene.name, "--transport", transport, *self._keys()]
        command += ["--ready", self._file(name, "ready"), "--report", self._file(name, "report")]
        return self._start(name, scene, transport, command)

    def _start_haptic(self, index: int, scene: SceneHandle, tool: str, seconds: float) -> _Client:
        name, transport = f"haptic-{index}", self._transport(index)
        command: list[str | Path] = [find_program("tensormass-haptic", "TENSORMASS_HAPTIC")]
        command += ["--server", self._server.address, "--scene", scene.name, "--tool", tool, *self._keys()]
        command += ["--transport", transport, "--seconds", str(seconds), "--json", self._file(name, "report")]
        return self._start(name, scene, transport, command)

    def _wait_until_ready(self, viewers: Sequence[_Client]) -> None:
        deadline = time.monotonic() + _READY_TIMEOUT_S
        late = list(viewers)

        def done() -> bool:
            late[:] = [v for v in late if not v.ready_file.exists()]
            return not late or any(v.ended_early for v in viewers) or time.monotonic() >= deadline

        self._watch(viewers, done)
        for viewer in viewers:
            if viewer.ended_early:
                viewer.status = viewer.process.stop()
                raise UnavailableError(f"a viewer of {viewer.scene} ({viewer.transport}) {viewer.failure()}")
        if late:
            raise UnavailableError(
                f"{len(late)} of {len(viewers)} viewers saw no frame in {_READY_TIMEOUT_S:g} s; "
                f"does {self._args.scene} stream frames (streams.frame_rate_hz)?"
            )

    # --- while it runs ------------------------------------------------------------------------------------------------

    def _watch(self, viewers: Sequence[_Client], done: Callable[[], bool]) -> None:
        """Waits for `done`. Marks a viewer that ends earlier, for the report. Raises if the daemon is gone as well."""
        while not done():
            for viewer in viewers:
                if not viewer.ended_early and not viewer.process.running:
                    viewer.ended_early = True
                    self._server.version()
            time.sleep(_POLL_S)

    def _with_a_stopped_viewer(self, viewer: _Client, scene: SceneHandle, phase_s: float) -> Json | None:
        """Stops a viewer for a while and measures; None if the viewer ended."""

        def phase(name: str) -> Json:
            before = scene.status()
            end = time.monotonic() + phase_s
            self._watch([viewer], lambda: time.monotonic() >= end)
            status = scene.status()
            missed = status.missed_deadlines - before.missed_deadlines
            return {"name": name, **load_report.step_times(before, status), "missed_deadlines": missed}

        phases = [phase("before")]
        viewer.process.process.send_signal(signal.SIGSTOP)
        phases.append(phase("while stopped"))
        viewer.process.process.send_signal(signal.SIGCONT)
        phases.append(phase("after"))
        if viewer.ended_early:
            return None
        return {"scene": viewer.scene, "transport": viewer.transport, "seconds": phase_s, "phases": phases}

    # --- the end ------------------------------------------------------------------------------------------------------

    def _end_haptic(self, client: _Client) -> Json | None:
        if client.process.running:
            self._errors.append(f"haptic client of {client.scene} ({client.transport}): did not end by itself")
        client.status = client.process.stop()
        failure = client.failure()
        if failure:
            self._errors.append(f"haptic client of {client.scene} ({client.transport}): {failure}")
            return None
        report: Json = json.loads(client.report_file.read_text())
        lost = int(report["last_sequence_sent"] - report["last_sequence_echoed"])
        where = f"haptic client of {report['scene']}/{report['tool']} ({report['transport']})"
        if lost:
            self._errors.append(f"{where}: the last {lost} poses were never answered")
        if report["feedback_malformed"]:
            self._errors.append(f"{where}: {report['feedback_malformed']:g} malformed messages")
        return report

    def _end_viewers(
        self, viewers: Sequence[_Client], first_was_stopped: bool
    ) -> tuple[list[Json], npt.NDArray[np.float64]]:
        """Ends the viewers. Returns all reports, and the frame ages of the viewers that were not stopped on purpose."""
        reports: list[Json] = []
        ages: list[npt.NDArray[np.float64]] = [np.empty(0)]
        for index, viewer in enumerate(viewers):
            viewer.status = viewer.process.stop()
            failure = viewer.failure()
            if failure:
                self._errors.append(f"viewer of {viewer.scene} ({viewer.transport}): {failure}")
                continue
            was_stopped = first_was_stopped and index == 0
            with np.load(viewer.report_file) as data:
                ages_s, dropped = data["ages_s"], int(data["dropped"])
            if not was_stopped:
                ages.append(ages_s)
            reports.append(
                {
                    "scene": viewer.scene,
                    "transport": viewer.transport,
                    "was_stopped": was_stopped,
                    "frame_age": load_report.percentiles(ages_s),
                    "frames_dropped": dropped,
                }
            )
        return reports, np.concatenate(ages)


def with_tools(scene: scene_pb2.Scene, count: int) -> scene_pb2.Scene:
    """Returns the scene with at least `count` tools that clients can move. Added ones are copies of its first of them,
    side by side along x."""
    movable = movable_tools(scene)
    if count and not movable:
        raise InvalidArgumentError(f"scene {scene.name!r} has no tool for a haptic client; give --haptic 0")
    result = scene_pb2.Scene()
    result.CopyFrom(scene)
    names = {tool.name for tool in scene.tools}
    for index in range(len(movable) + 1, count + 1):
        tool = result.tools.add()
        tool.CopyFrom(movable[0])
        tool.name = next(name for name in (f"tool-{index + k}" for k in range(_MAX_TOOLS + 1)) if name not in names)
        names.add(tool.name)
        tool.position_m.x += 3.0 * radius_m(tool) * (index - 1)
    return result
