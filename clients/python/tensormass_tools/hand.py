"""`tensormass hand`: a scripted hand, which moves a tool through the poses of a file, over and over.

    tool: retractor
    poses:
      - {time_s: 0, position_m: {x: 0.1, z: 0.09}, orientation: {w: 1}}
      - {time_s: 2, position_m: {x: 0.1, z: 0.06}}

Between two poses the tool accelerates and brakes smoothly (minimum jerk). A pose without orientation or joint_values
has those of the one before it. `level: 1` lets a tool with cautery burn from this pose to the next one. The last pose
should be the first one again; the tool goes on from there without a pause.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor

from tensormass import FloatArray, InvalidArgumentError, NotFoundError, SceneHandle, connect
from tensormass._shared import strict_yaml
from tensormass._shared.scene_fields import checked_fields
from tensormass._shared.vectors import quaternion
from tensormass.v1 import stream_pb2
from tensormass_tools.running import find_server

RATE_HZ = 120.0
#: Time between two checks of whether another client holds the tool [s].
BETWEEN_CHECKS_S = 1.0
#: A hand that is gone lets go after this time of the simulation [s].
VALID_FOR_S = 0.5
_HANDS = Path(__file__).parents[1] / "tensormass" / "scenes" / "hands"


class HandPose(NamedTuple):
    """A pose, as `PoseSender.send` takes it: position [3] m, orientation w, x, y, z, joints [rad or m]."""

    position_m: FloatArray
    orientation: FloatArray
    joint_values: FloatArray
    #: Share of its power that the tool uses, 0 to 1.
    level: float = 0.0


@dataclass(frozen=True)
class HandScript:
    """Poses of a tool over a period.

    times_s: ascending from 0, [poses]. positions_m: [poses, 3]. orientations: unit quaternions w, x, y, z, [poses, 4].
    joint_values: [poses, joints]. levels: [poses], each until the next pose.
    """

    tool: str
    times_s: FloatArray
    positions_m: FloatArray
    orientations: FloatArray
    joint_values: FloatArray
    levels: FloatArray

    @staticmethod
    def read(path: Path) -> HandScript:
        """Reads a file.

        Raises:
            NotFoundError: no such file.
            InvalidArgumentError: the file is not such a script; the message has the place.
        """
        try:
            text = path.read_text("utf-8")
        except OSError as error:
            raise NotFoundError(f"{path}: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise InvalidArgumentError(f"{path}: not a text in UTF-8") from error
        content = strict_yaml.load(text, str(path))
        if not isinstance(content, dict) or set(content) != {"tool", "poses"}:
            raise InvalidArgumentError(f"{path}: expected the two fields tool and poses")
        poses = content["poses"]
        if not isinstance(content["tool"], str) or not isinstance(poses, list) or len(poses) < 2:
            raise InvalidArgumentError(f"{path}: tool must be a name, and poses a list of two or more")
        times: list[float] = []
        messages: list[stream_pb2.ToolPose] = []
        for number, pose in enumerate(poses):
            at = f"{path}: poses[{number}]"
            time_s, message = _read_pose(pose, str(path), f"poses[{number}]")
            if not time_s > (times[-1] if times else -1) or (not times and time_s != 0):
                raise InvalidArgumentError(f"{at}.time_s: {time_s:g}; times start at 0 and ascend")
            if messages and messages[-1].HasField("orientation") and not message.HasField("orientation"):
                message.orientation.CopyFrom(messages[-1].orientation)
            if messages and not message.joint_values:
                message.joint_values.extend(messages[-1].joint_values)
            if messages and len(message.joint_values) != len(messages[0].joint_values):
                raise InvalidArgumentError(f"{at}.joint_values: expected as many as in the first pose")
            times.append(time_s)
            messages.append(message)
        return HandScript(
            content["tool"],
            np.array(times),
            np.array([(m.position_m.x, m.position_m.y, m.position_m.z) for m in messages]),
            np.array([_unit_quaternion(m, f"{path}: poses[{i}].orientation") for i, m in enumerate(messages)]),
            np.array([m.joint_values for m in messages], dtype=np.float64),
            np.array([m.level for m in messages]),
        )

    def at(self, time_s: float) -> HandPose:
        """Returns the pose at a time after the start."""
        time_s %= float(self.times_s[-1])
        i = int(np.searchsorted(self.times_s, time_s, side="right")) - 1
        share = (time_s - self.times_s[i]) / (self.times_s[i + 1] - self.times_s[i])
        smooth = share**3 * (10 - 15 * share + 6 * share**2)
        return HandPose(
            (1 - smooth) * self.positions_m[i] + smooth * self.positions_m[i + 1],
            _between(self.orientations[i], self.orientations[i + 1], smooth),
            (1 - smooth) * self.joint_values[i] + smooth * self.joint_values[i + 1],
            float(self.levels[i]),
        )


def script_of(scene: str) -> Path | None:
    """Returns the hand script that comes with a built-in scene; of several that of its first tool."""
    path = _HANDS / f"{scene}.yaml"
    return path if path.is_file() else None


def scripts_of(scene: str) -> dict[str, Path]:
    """Returns the hand scripts that come with a built-in scene, by tool: SCENE.yaml, and SCENE-2.yaml for another."""
    paths = [_HANDS / f"{scene}.yaml", _HANDS / f"{scene}-2.yaml"]
    return {HandScript.read(path).tool: path for path in paths if path.is_file()}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `tensormass hand`."""
    parser.add_argument("script", type=Path, help="poses of a tool (.yaml)")
    parser.add_argument("--scene", required=True, help="name of the loaded scene")
    parser.add_argument("--transport", choices=("zeromq", "zenoh"), default="zeromq", help="default: %(default)s")
    parser.add_argument("--seconds", type=float, metavar="T", help="end after so long; default: until Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Moves the tool until told to end. Returns 0."""
    if args.seconds is not None and not 0 < args.seconds < math.inf:
        raise InvalidArgumentError(f"--seconds {args.seconds:g}: must be positive and finite")
    script = HandScript.read(args.script)
    with connect(find_server(args.server), keys=args.keys) as server:
        scene = server.scene(args.scene)
        with scene.tool_stream(script.tool, args.transport, valid_for_s=VALID_FOR_S) as stream:
            watch = ClaimWatch(scene, script.tool, stream.client_id)
            start = now = time.monotonic()
            checks_at = start + BETWEEN_CHECKS_S
            while args.seconds is None or now - start < args.seconds:
                stream.send(*script.at(now - start))
                if now >= checks_at:
                    if (news := watch.check()) is not None:
                        print(news, file=sys.stderr, flush=True)
                    checks_at = now + BETWEEN_CHECKS_S
                time.sleep(1 / RATE_HZ)
                now = time.monotonic()
    return 0


class ClaimWatch:
    """Tells a hand whether the server takes its poses, because the stream itself would not."""

    def __init__(self, scene: SceneHandle, tool: str, client_id: int) -> None:
        self._scene, self._tool, self._client_id = scene, tool, client_id
        self._refused = False

    def check(self) -> str | None:
        """Returns what has changed since the last check, in words."""
        feedback = self._scene.feedback(self._tool)
        refused = feedback.claimed and feedback.client_id != self._client_id
        if refused == self._refused:
            return None
        self._refused = refused
        if refused:
            return f"{self._tool}: another client holds this tool, so poses of this hand are refused until it lets go"
        return f"{self._tool}: this hand has the tool again"


def _read_pose(pose: object, where: str, path: str) -> tuple[float, stream_pb2.ToolPose]:
    names = set(pose) if isinstance(pose, dict) else set()
    needed = {"time_s", "position_m"}
    if not isinstance(pose, dict) or not needed <= names <= needed | {"orientation", "joint_values", "level"}:
        raise InvalidArgumentError(
            f"{where}: {path}: expected time_s, position_m and perhaps orientation, joint_values and level"
        )
    time_s = pose["time_s"]
    if isinstance(time_s, bool) or not isinstance(time_s, int | float) or not 0 <= time_s < math.inf:
        raise InvalidArgumentError(f"{where}: {path}.time_s: expected seconds, got {time_s!r}")
    fields = {name: value for name, value in pose.items() if name != "time_s"}
    checked = checked_fields(fields, cast(Descriptor, stream_pb2.ToolPose.DESCRIPTOR), where, path)
    return float(time_s), json_format.ParseDict(checked, stream_pb2.ToolPose())


def _unit_quaternion(pose: stream_pb2.ToolPose, where: str) -> tuple[float, float, float, float]:
    if not pose.HasField("orientation"):
        return 1.0, 0.0, 0.0, 0.0
    q = pose.orientation
    unit = quaternion((q.w, q.x, q.y, q.z), where)
    assert unit is not None
    return unit.w, unit.x, unit.y, unit.z


def _between(a: FloatArray, b: FloatArray, share: float) -> FloatArray:
    """Returns the orientation at a share of the shorter way from one to another (slerp)."""
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    angle = math.acos(min(cosine, 1.0))
    if angle < 1e-6:
        return a
    turned: FloatArray = (math.sin((1 - share) * angle) * a + math.sin(share * angle) * b) / math.sin(angle)
    return turned
