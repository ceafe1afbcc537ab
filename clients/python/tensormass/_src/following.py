"""Many steps in one call, each with its own pose of a tool.

A call of `step` can make many steps, but they all see the same pose. A call for each step costs more than its way
there and back: the last step of a call also checks the elements and gathers a frame. Here the steps go as a recording,
and the server replays it: one call, a pose for each step, elements checked as often as in real time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from google.protobuf.message import DecodeError

from tensormass._shared.errors import InternalError
from tensormass._shared.vectors import Vector, finite_numbers, quaternion, vector3
from tensormass.v1 import control_pb2, recording_pb2, stream_pb2

Pose = tuple[Vector, Vector | None, Vector] | tuple[Vector, Vector | None, Vector, float]
"""Position [3] m, orientation w, x, y, z or None, joint values [rad or m]."""

# The daemon takes 1000 (server/core/recording_limits.h).
_STEPS_A_CALL = 500
# Elements are checked so often in simulated time, as in a scene that runs by the clock (loop.cpp).
_CHECKS_HZ = 4.0
# Before the message of a snapshot; recording.proto describes it.
_SNAPSHOT_HEADER_BYTES = 32


def has_blades(topology: stream_pb2.Topology) -> bool:
    """Returns whether a tool cuts. A replay makes the cuts of its recording and none of its own, so such a scene is
    followed step by step."""
    return any(shape.tool.WhichOneof("kind") in ("scalpel", "scissors") for shape in topology.tools)


class Followed(NamedTuple):
    """What a replay must name of the loaded scene."""

    scene_hash: int
    cg_iteration_limit: int

    @staticmethod
    def of(snapshot: bytes) -> Followed:
        state = recording_pb2.SnapshotState()
        try:
            state.ParseFromString(snapshot[_SNAPSHOT_HEADER_BYTES:])
        except DecodeError as error:
            raise InternalError("the daemon's snapshot is not one that this client can read") from error
        return Followed(state.scene_hash, state.cg_iteration_limit)


def requests(
    scene: str, tool: str, poses: Sequence[Pose], followed: Followed, steps_before: int, dt_s: float
) -> Iterator[control_pb2.ReplaySceneRequest]:
    """Yields the calls that make a step for each pose.

    Args:
        steps_before: number of the scene's last step.
        dt_s: length of a step.
    """
    check_every = 1 + int(1 / (dt_s * _CHECKS_HZ))
    for first in range(0, len(poses), _STEPS_A_CALL):
        request = control_pb2.ReplaySceneRequest(scene=scene, scene_hash=followed.scene_hash)
        for offset, pose in enumerate(poses[first : first + _STEPS_A_CALL]):
            number = first + offset + 1
            step = steps_before + number
            recorded = request.steps.add(
                index=number,
                step=step,
                cg_iteration_limit=followed.cg_iteration_limit,
                diagnosed=step % check_every == 1 or check_every == 1,
            )
            recorded.poses.append(_recorded(tool, *pose))
        yield request


def _recorded(
    tool: str, position_m: Vector, orientation: Vector | None, joint_values: Vector, level: float = 0.0
) -> recording_pb2.RecordedPose:
    return recording_pb2.RecordedPose(
        tool=tool,
        position_m=vector3(position_m, "position"),
        orientation=quaternion((1.0, 0.0, 0.0, 0.0) if orientation is None else orientation, "orientation"),
        joint_values=finite_numbers(joint_values, "joint_values"),
        level=finite_numbers([level], "level")[0],
    )
