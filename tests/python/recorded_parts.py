"""Recordings with frames, written without a daemon."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from fake_daemon import triangle_topology
from google.protobuf.message import Message

from tensormass.v1 import changes_pb2, recording_pb2, scene_pb2, stream_pb2
from tensormass_tools.recording.file import RecordingWriter

TOPOLOGY = triangle_topology("liver", version=1000)
#: Steps of each frame, in a scene with 100 steps a second that is reset after step 30.
STEPS = (10, 20, 30, 30, 0, 10, 20, 30, 40, 50)
#: Frames of one chunk.
A_CHUNK = 2


def recorded_frame(step: int, sequence: int, force_n: float = 0.0) -> stream_pb2.Frame:
    """Makes a frame whose positions tell its sequence."""
    return stream_pb2.Frame(
        topology_version=TOPOLOGY.version,
        sequence=sequence,
        step=step,
        simulated_time_s=step / 100,
        server_time_ns=2000 + sequence,
        positions=np.full((3, 3), sequence, "<f4").tobytes(),
        tools=[
            stream_pb2.ToolFeedback(
                tool="probe",
                position_m=scene_pb2.Vector3(z=0.01 * sequence),
                orientation=scene_pb2.Quaternion(w=1),
                force_n=scene_pb2.Vector3(z=force_n),
            )
        ],
    )


def write_recording(
    path: Path,
    steps: Iterable[int] = STEPS,
    *,
    topology: stream_pb2.Topology | None = TOPOLOGY,
    statuses: bool = True,
    touching: Iterable[int] = (),
    rejected: Iterable[int] = (),
    recovered: Iterable[int] = (),
    changing: Mapping[int, Sequence[Message]] | None = None,
    edits: Mapping[int, recording_pb2.RecordedEdit] | None = None,
    late_edits: bool = False,
) -> Path:
    """Writes a recording with a frame for each of `steps`.

    Args:
        touching: sequences of frames in which the tool feels a force.
        rejected: sequences of frames before which a guard stopped the scene.
        recovered: sequences of frames whose step belongs to a recovery.
        changing: changes of the surface and events, by the sequence of the frame that follows them. Frames have the
            revision of the last changes.
        edits: by the sequence of the frame whose step follows; None: as recordings were before they had any, with a
            flag at each step that is a reset.
        late_edits: they come after their frame, as steps may.
    """
    recovered = set(recovered)
    last, revision = -1, 0
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="liver"), 1000)
        writer.add("/start", recording_pb2.RecordingStart(scene="liver", backend="cpu", device="test"))
        if topology is not None:
            writer.add("/topology", topology)
        writer.flush()
        for sequence, step in enumerate(steps, start=1):
            if edits is None and step < last:
                writer.add("/inputs", recording_pb2.RecordedStep(index=sequence, step=step, reset=True))
            last = step
            edit = (edits or {}).get(sequence)
            if edit is not None and not late_edits:
                writer.add("/edits", edit)
            if sequence in set(rejected):
                writer.add("/inputs", recording_pb2.RecordedStep(index=sequence, step=step, rejected=True))
            elif recovered:
                recovers = sequence in recovered
                writer.add("/inputs", recording_pb2.RecordedStep(index=sequence, step=step, recovered=recovers))
            if statuses and sequence % A_CHUNK == 1:
                running = stream_pb2.SceneStatus.STATE_RUNNING
                writer.add(
                    "/status", stream_pb2.SceneStatus(scene="liver", state=running, step=step, cg_iterations=step)
                )
            for message in (changing or {}).get(sequence, ()):
                if isinstance(message, changes_pb2.SurfaceChanges):
                    revision = message.revision
                writer.add("/changes" if isinstance(message, changes_pb2.SurfaceChanges) else "/events", message)
            force_n = 0.5 if sequence in set(touching) else 0.0
            frame = recorded_frame(step, sequence, force_n)
            frame.revision = revision
            writer.add("/frames", frame)
            if edit is not None and late_edits:
                writer.add("/edits", edit)
            if sequence % A_CHUNK == 0:
                writer.flush()
    return path
