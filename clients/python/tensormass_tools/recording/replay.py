"""`tensormass replay`: makes the steps of a recording again and compares the state.

On the same backend, device and layout of nodes every hash must be the same. Elsewhere sums are rounded in another
order, so displacements of sampled nodes are compared within a tolerance.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tensormass import LOAD_TIMEOUT_S, FloatArray, InvalidArgumentError, ResourceExhaustedError, SceneHandle, Server
from tensormass._shared.processes import end_explained
from tensormass.v1 import control_pb2, recording_pb2, scene_pb2
from tensormass_tools.daemon_arguments import daemon_of
from tensormass_tools.output import load_line, print_json
from tensormass_tools.recording.chunks import MAX_EDITS_OF_STEP
from tensormass_tools.recording.file import RecordingReader

# The daemon's own limit is 1000 (server/core/recording_limits.h).
_STEPS_A_CALL = 250
# Bytes of edits after which a call ends: a snapshot has its own. The daemon takes 200 MiB by default.
_EDIT_BYTES_A_CALL = 16 << 20


@dataclass
class Comparison:
    """What the checks of a replay found."""

    #: Every hash must be equal.
    exact: bool = True
    steps: int = 0
    edits: int = 0
    equal_hashes: int = 0
    checks: int = 0
    #: Largest difference of a sampled node [m], and the scene's step at which it was.
    worst_m: float = 0.0
    worst_step: int = 0
    #: Steps of the scene at which a check failed; the first ones.
    failed: list[int] = field(default_factory=list)

    def take(self, recorded: recording_pb2.StateCheck, now: recording_pb2.StateCheck, tolerance_m: float) -> None:
        """Compares two checks of one step."""
        self.checks += 1
        equal = recorded.hash == now.hash
        self.equal_hashes += equal
        before, after = _samples(recorded), _samples(now)
        if before.shape != after.shape:
            raise InvalidArgumentError("the recording's checks have other nodes than the loaded scene")
        if not equal and len(before):
            worst_m = float(np.sqrt(np.square(after - before).sum(axis=1)).max())
            if not worst_m <= self.worst_m:
                self.worst_m, self.worst_step = worst_m, recorded.step
        else:
            worst_m = 0.0
        if not (equal if self.exact else worst_m <= tolerance_m):
            self.failed.append(recorded.step)


def run(args: argparse.Namespace) -> int:
    """Replays and compares. Returns 0 if every check agrees."""
    if not 0 < args.tolerance < 1:
        raise InvalidArgumentError(f"--tolerance {args.tolerance:g}: must be between 0 and 1")
    recording = RecordingReader(args.file)
    largest_m = max((check.largest_displacement_m for check in _checks(recording)), default=0.0)
    scene = scene_pb2.Scene()
    scene.CopyFrom(recording.scene)
    scene.stepping.lockstep = True
    if args.cpu_threads is not None:
        scene.solver.cpu_threads = args.cpu_threads
    elif recording.start.backend == "cpu":
        scene.solver.cpu_threads = max(recording.start.patch_count, 1)
    with daemon_of(args, backend=_backend(args, recording)) as server, end_explained(server.process, server.log_file):
        name = _unique_name(scene.name) if args.server else None
        handle = server.load(scene, name=name, progress=load_line(quiet=args.json))
        try:
            if recording.start.HasField("adjustments"):
                changes = recording.start.adjustments
                request = control_pb2.AdjustSceneRequest(scene=handle.name, changes=changes)
                server.call("AdjustScene", request, timeout_s=LOAD_TIMEOUT_S)
            if recording.start.snapshot:
                handle.restore(recording.start.snapshot)
            else:
                handle.reset()  # as the recording began; an adjustment leaves another energy balance
            found, ended = _replay(args, recording, server, handle, args.tolerance * largest_m)
        finally:
            handle.unload()
    summary = {
        "file": str(args.file),
        "scene": scene.name,
        "steps": found.steps,
        "edits": found.edits,
        "checks": found.checks,
        "equal_hashes": found.equal_hashes,
        "exact": found.exact,
        "failed_steps": found.failed[:10],
        "worst_m": found.worst_m,
        "worst_step": found.worst_step,
        "largest_displacement_m": largest_m,
        "tolerance": None if found.exact else args.tolerance,
        "cut_off": recording.cut_off or recording.damaged,
        "lost": ended,
    }
    if args.json:
        print_json(summary)
    else:
        print("\n".join(_lines(summary)))
    return 0 if found.checks > 0 and not found.failed and ended is None else 1


def _replay(
    args: argparse.Namespace,
    recording: RecordingReader,
    server: Server,
    handle: SceneHandle,
    tolerance_m: float,
) -> tuple[Comparison, str | None]:
    """Returns the comparison, and why it ended early if it did."""
    version = server.version()
    start = recording.start
    same = version.backend == start.backend and version.device == start.device
    found = Comparison()
    recorded_checks = _Checks(recording)
    scene_hash = start.scene_hash
    for steps, edits in batches(recording):
        if steps[0].index != found.steps + 1:
            return found, f"step {found.steps + 1} and others up to {steps[0].index - 1} are lost in the recording"
        checks = recorded_checks.up_to(steps[-1].index)
        request = control_pb2.ReplaySceneRequest(
            scene=handle.name,
            scene_hash=scene_hash,
            steps=steps,
            edits=edits,
            check_indices=[step.index for step in steps if step.index in checks],
        )
        response = server.call("ReplayScene", request, timeout_s=LOAD_TIMEOUT_S)
        found.exact = same and response.layout_hash == start.layout_hash
        found.steps += len(steps)
        found.edits += len(edits)
        # Adjustments change it. Daemons did not always say it, when they knew no adjustments either.
        scene_hash = response.scene_hash or scene_hash
        for check in response.checks:
            found.take(checks[check.index], check, tolerance_m)
        if found.exact and found.failed:
            return found, None  # every later hash differs too
    return found, None


def _checks(recording: RecordingReader) -> Iterator[recording_pb2.StateCheck]:
    return (entry.message for entry in recording.entries() if entry.channel == "/checks")


class _Checks:
    """The checks of a recording, read as its steps are. The file may be larger than memory."""

    def __init__(self, recording: RecordingReader) -> None:
        self._left = _checks(recording)
        self._next = next(self._left, None)

    def up_to(self, index: int) -> dict[int, recording_pb2.StateCheck]:
        """Returns the checks since the last call, up to a step, by the index of their step."""
        out: dict[int, recording_pb2.StateCheck] = {}
        while self._next is not None and self._next.index <= index:
            out[self._next.index] = self._next
            self._next = next(self._left, None)
        return out


def batches(
    recording: RecordingReader,
) -> Iterator[tuple[list[recording_pb2.RecordedStep], list[recording_pb2.RecordedEdit]]]:
    """Yields the steps of a recording with their edits, in parts without gaps.

    Raises ResourceExhaustedError if more edits precede a step than a recording has.
    """
    steps: list[recording_pb2.RecordedStep] = []
    edits: list[recording_pb2.RecordedEdit] = []
    coming: list[recording_pb2.RecordedEdit] = []
    edit_bytes = 0
    for entry in recording.entries():
        if entry.channel == "/edits":
            if len(coming) == MAX_EDITS_OF_STEP:
                raise ResourceExhaustedError(
                    f"{recording.path}: more than {MAX_EDITS_OF_STEP} edits before step {entry.message.index}"
                )
            coming.append(entry.message)
            edit_bytes += entry.message.ByteSize()
        elif entry.channel == "/inputs":
            full = len(steps) == _STEPS_A_CALL or edit_bytes > _EDIT_BYTES_A_CALL
            if steps and (full or entry.message.index != steps[-1].index + 1):
                yield steps, edits
                steps, edits = [], []
                edit_bytes = sum(edit.ByteSize() for edit in coming)
            steps.append(entry.message)
            edits += [edit for edit in coming if edit.index == entry.message.index]
            coming = []
    if steps:
        yield steps, edits


def _lines(summary: dict[str, Any]) -> list[str]:
    edits = f" with {summary['edits']} edits" if summary["edits"] else ""
    out = [f"replayed {summary['steps']} steps of {summary['scene']}{edits}: {summary['checks']} checks"]
    if summary["exact"]:
        out[0] += f", {summary['equal_hashes']} hashes equal"
        if summary["failed_steps"]:
            out.append(f"the state differs from the recording at step {summary['failed_steps'][0]}")
    else:
        out[0] += " (another backend, device or number of threads: compared within a tolerance)"
        out.append(
            f"largest difference {summary['worst_m']:.3g} m at step {summary['worst_step']}; largest displacement "
            f"{summary['largest_displacement_m']:.3g} m, tolerance {summary['tolerance']:g} of it"
        )
        if summary["failed_steps"]:
            out.append(f"beyond the tolerance at step {summary['failed_steps'][0]}")
    if summary["checks"] == 0:
        out.append("nothing was compared: the recording has no checks")
    if summary["cut_off"]:
        out.append("the recording was cut off; it was read up to its last whole chunk")
    if summary["lost"]:
        out.append(f"the replay ended early: {summary['lost']}")
    return out


def _samples(check: recording_pb2.StateCheck) -> FloatArray:
    return np.frombuffer(check.sample_displacements, dtype="<f8").reshape(-1, 3)


def _backend(args: argparse.Namespace, recording: RecordingReader) -> str:
    """Returns the backend of a daemon to start: without --backend that of the recording."""
    recorded = str(recording.start.backend)
    return recorded if args.backend == "auto" and recorded in ("cpu", "cuda") else str(args.backend)


def _unique_name(scene: str) -> str:
    """Returns a name for a scene in a daemon that others use."""
    return f"{scene[:40]}-replay-{os.getpid()}"
