"""A monkey's hand on every built-in scene with every instrument: what a trainee does, and worse.

python -m stability.monkey [--backend cpu|cuda] [--walks N] [--first N] [--blades] [--jobs N] [--rate HZ]
                           [--limit SECONDS] [--write FILE]

A walk has a scene, an instrument, a motion and a mesh by its number, so that anyone can repeat it: `--first 17 --walks
1`. The hand moves for 5 s at up to 0.5 m/s through the box around the bodies and 3 cm beyond, turned at random, with
joints that open and close. Then the tool leaves, and 3 s later the tissue is compared with that of a scene that nobody
touched.

Each walk must go on to its end, with finite positions, no load above the tool's largest, and tissue that is back within
1 mm. A body that nothing holds is where the hand left it, so that its place is not compared. Nor is that of tissue that
was cut: with `--blades` the hand has a scalpel or scissors, in the scene `cut`.
"""

from __future__ import annotations

import argparse
import itertools
import math
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import tensormass as tm
from tensormass._shared import defaults
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import stream_pb2
from tensormass_tools.trade.knobs import Knobs

from . import csv_rows

Array = NDArray[np.float64]
#: Place, orientation and joints, as `SceneHandle.follow` takes them.
Pose = tuple[tuple[float, ...], tuple[float, ...] | None, tuple[float, ...]]

SCENES = ("demo", "retract", "grasp", "demo-abdomen", "table", "two_organs")
#: Kind and shape of each instrument; None is the scene's own tool.
INSTRUMENTS: dict[str, dict[str, Any] | None] = {
    "own": None,
    "spherical_probe": {"radius_m": 0.006},
    "capsule": {"radius_m": 0.004, "length_m": 0.15},
    "retractor": {"radius_m": 0.003, "blade_length_m": 0.03, "shaft_length_m": 0.12},
    "grasper": {"radius_m": 0.003, "jaw_length_m": 0.025},
    "box": {"size_x_m": 0.02, "size_y_m": 0.02, "size_z_m": 0.03, "edge_radius_m": 0.002},
}
#: The same for scenes with `editing.cutting`. Their walks have numbers of their own.
BLADES: dict[str, dict[str, Any]] = {
    "scalpel": {"length_m": 0.02, "thickness_m": 0.0005, "spacing_m": 0.001},
    "scissors": {
        "radius_m": 0.002,
        "blade_length_m": 0.03,
        "edge_offset_m": 0.002,
        "thickness_m": 5e-4,
        "spacing_m": 1e-3,
    },
}
BLADE_SCENES = ("cut",)
FIRST_BLADE_WALK = 100_000
MOTIONS = ("walk", "stabs", "sweeps", "held", "walk")
RESOLUTIONS = (1.0, 0.7)
HAND_S, AWAY_S = 5.0, 3.0
FASTEST_M_PER_S = 0.5
BEYOND_M = 0.03
#: Largest angle of a joint.
WIDEST_RAD = 1.4
LARGEST_LEFT_M = 1e-3


@dataclass
class Row:
    """One walk and what came of it. Loads are shares of the tool's largest."""

    walk: int
    scene: str
    instrument: str
    motion: str
    resolution: float
    rate_hz: float
    speed_m_per_s: float
    stopped_at_s: float | None
    recoveries: int
    recovering_steps: int
    held_steps: int
    gives_way_s: float
    largest_force_n: float
    force_share: float
    torque_share: float
    joint_share: float
    left_mm: float | None
    verdict: str
    seconds: float


def smooth(rng: np.random.Generator, count: int, low: Array, high: Array) -> Array:
    """Returns a smooth random way [count, n] that reaches both ends of each range."""
    time_ = np.linspace(0, 1, count)
    way = np.empty((count, len(low)))
    for c in range(len(low)):
        waves = np.zeros(count)
        for wave in range(1, 9):
            turns = wave * rng.uniform(0.5, 1.5)
            waves += rng.normal() / wave * np.sin(2 * math.pi * (turns * time_ + rng.uniform()))
        waves -= waves.min()
        way[:, c] = low[c] + (high[c] - low[c]) * waves / max(float(waves.max()), 1e-9)
    return way


def no_faster(way: Array, dt_s: float, speed_m_per_s: float) -> Array:
    """Returns the way in as many steps, walked as far as the speed allows."""
    lengths = np.linalg.norm(np.diff(way, axis=0), axis=1)
    times = np.concatenate([[0], np.cumsum(np.maximum(lengths / speed_m_per_s, 1e-9))])
    at = np.arange(len(way)) * dt_s
    return np.stack([np.interp(np.minimum(at, times[-1]), times, way[:, c]) for c in range(way.shape[1])], axis=1)


def motion_of(kind: str, rng: np.random.Generator, count: int, dt_s: float, speed: float, box: Array) -> Array:
    """Returns the hand's places [count, 3] m; box: [2, 3]."""
    low, high = box[0] - BEYOND_M, box[1] + BEYOND_M
    if kind == "walk":
        return no_faster(smooth(rng, count, low, high), dt_s, speed)
    if kind == "held":
        inside = rng.uniform(box[0], box[1])
        return np.tile(inside, (count, 1))
    ends = []
    for _ in range(40):
        if kind == "stabs":
            target = rng.uniform(box[0], box[1])
            outside = target + (0.03 + float(np.linalg.norm(box[1] - box[0])) / 2) * _direction(rng)
            ends += [outside, target, outside]
        else:
            ends.append(rng.uniform(low, high))
    corners = np.array(ends)
    fine = np.concatenate([np.linspace(a, b, 200, endpoint=False) for a, b in itertools.pairwise(corners)])
    if len(fine) < count:
        fine = np.concatenate([fine, np.tile(fine[-1], (count - len(fine), 1))])
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    at = np.minimum(np.arange(count) * dt_s * speed, lengths[-1])
    return np.stack([np.interp(at, lengths, fine[:, c]) for c in range(3)], axis=1)


def _direction(rng: np.random.Generator) -> Array:
    way = rng.normal(size=3)
    return np.asarray(way / np.linalg.norm(way))


def scene_of(name: str, instrument: str, resolution: float, rate_hz: float) -> tm.Scene:
    scene = tm.Scene.from_file(name)
    if resolution != 1.0:
        with tempfile.TemporaryDirectory() as folder:
            knobs = Knobs(SceneFile.read(name), Path(folder) / "meshes")
            if "resolution" in knobs.knobs:
                file = Path(folder) / f"{name}.yaml"
                knobs.write({"resolution": resolution}, file, "made by monkey.py")
                scene = tm.Scene.from_file(file)
    if rate_hz > 0:
        scene.message.stepping.dt_s = 1 / rate_hz
    shape = {**INSTRUMENTS, **BLADES}[instrument]
    if shape is None:
        return scene
    own = next(tool for tool in scene.message.tools if not tool.fixed)
    place = (own.position_m.x, own.position_m.y, own.position_m.z)
    name_ = own.name
    scene.message.tools.remove(own)
    scene.add_tool(name_, instrument, position_m=place, **shape)
    return scene


def plan_of(number: int) -> tuple[str, str, str, float]:
    """Returns scene, instrument, motion and resolution of a walk."""
    if number >= FIRST_BLADE_WALK:
        blades = list(BLADES)
        return (
            BLADE_SCENES[number % len(BLADE_SCENES)],
            blades[number // len(BLADE_SCENES) % len(blades)],
            MOTIONS[number // len(blades) % len(MOTIONS)],
            1.0,
        )
    return (
        SCENES[number % len(SCENES)],
        list(INSTRUMENTS)[number // len(SCENES) % len(INSTRUMENTS)],
        MOTIONS[number % len(MOTIONS)],
        RESOLUTIONS[number // 3 % len(RESOLUTIONS)],
    )


def run_walk(server: tm.Server, number: int, rate_hz: float) -> Row:
    began = time.monotonic()
    rng = np.random.default_rng(number)
    name, instrument, motion, resolution = plan_of(number)
    scene = scene_of(name, instrument, resolution, rate_hz)
    scene.message.name = f"monkey-{number}"
    tool = next(one for one in scene.message.tools if not one.fixed)
    dt_s = defaults.dt_s(scene.message)
    count, away = round(HAND_S / dt_s), round(AWAY_S / dt_s)
    speed = float(rng.uniform(0.05, FASTEST_M_PER_S))
    largest = defaults.largest_loads(tool)
    with server.load(scene, lockstep=True) as handle:
        bodies = [body.name for body in handle.topology().bodies]
        rest = {body: handle.positions(body) for body in bodies}
        every = np.concatenate(list(rest.values()))
        box = np.stack([every.min(axis=0), every.max(axis=0)])
        places = motion_of(motion, rng, count, dt_s, speed, box)
        turns = no_faster(smooth(rng, count, -np.full(3, 1.5), np.full(3, 1.5)), dt_s, 3.0)
        opening = no_faster(smooth(rng, count, np.zeros(1), np.full(1, WIDEST_RAD)), dt_s, 3.0)[:, 0]
        row = Row(number, name, instrument, motion, resolution, round(1 / dt_s, 3), round(speed, 3), None,
                  0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, None, "", 0.0)  # fmt: skip
        far = (float(box[0, 0]) - 0.3, float(box[0, 1]) - 0.3, float(box[1, 2]) + 0.3)
        has_joints = tool.WhichOneof("kind") in ("grasper", "scissors")
        poses = [_pose(places[i], turns[i], opening[i] if has_joints else None) for i in range(count)]
        poses += [(far, None, (0.0,) if has_joints else ())] * away
        step = 0
        try:
            while step < len(poses):
                status = handle.follow(tool.name, [poses[step]])
                step += 1
                _take(row, next(one for one in status.tools if one.tool == tool.name), largest, dt_s)
        except tm.TensormassError as stop:
            row.stopped_at_s = round(step * dt_s, 3)
            row.verdict = f"stopped: {stop}"[:200]
        status = handle.status()
        row.recoveries = int(getattr(status, "recoveries", 0))
        row.recovering_steps = int(getattr(status, "recovering_steps", 0))
        row.held_steps = int(getattr(status, "held_steps", 0))
        if row.stopped_at_s is None:
            if number < FIRST_BLADE_WALK:
                row.left_mm = _left_mm(scene, handle, tool.name, far, bodies, has_joints)
            row.verdict = _verdict(row)
    row.seconds = round(time.monotonic() - began, 1)
    return row


def _pose(place: Array, turn: Array, opening: float | None) -> Pose:
    angle = float(np.linalg.norm(turn)) + 1e-12
    axis = turn / angle
    orientation = (math.cos(angle / 2), *(float(x) for x in math.sin(angle / 2) * axis))
    return tuple(float(x) for x in place), orientation, () if opening is None else (float(opening),)


def _take(row: Row, feedback: stream_pb2.ToolFeedback, largest: tuple[float, float, float], dt_s: float) -> None:
    force = math.hypot(feedback.force_n.x, feedback.force_n.y, feedback.force_n.z)
    torque = math.hypot(feedback.torque_n_m.x, feedback.torque_n_m.y, feedback.torque_n_m.z)
    joint = max((abs(load) for load in feedback.joint_loads), default=0.0)
    row.largest_force_n = max(row.largest_force_n, force)
    row.force_share = max(row.force_share, force / largest[0])
    row.torque_share = max(row.torque_share, torque / largest[1])
    row.joint_share = max(row.joint_share, joint / largest[2])
    if not math.isfinite(force + torque + joint):
        row.force_share = math.inf
    row.gives_way_s += dt_s if feedback.gives_way else 0.0


def _left_mm(
    scene: tm.Scene,
    handle: tm.SceneHandle,
    tool: str,
    far: tuple[float, float, float],
    bodies: list[str],
    has_joints: bool,
) -> float | None:
    """Distance of the farthest node from where it is without a hand [mm], over bodies that something holds."""
    held = [body.name for body in scene.message.bodies if body.fixed or body.prescribed]
    if not held or len(held) < len(bodies):
        return None
    now = {body: handle.positions(body) for body in held}
    if not all(np.isfinite(place).all() for place in now.values()):
        return math.inf
    handle.reset()
    steps = round(AWAY_S / defaults.dt_s(scene.message))
    handle.follow(tool, [(far, None, (0.0,) if has_joints else ())] * steps)
    return round(1e3 * max(float(np.linalg.norm(now[b] - handle.positions(b), axis=1).max()) for b in held), 3)


def _verdict(row: Row) -> str:
    if max(row.force_share, row.torque_share, row.joint_share) > 1 + 1e-9:
        return "beyond the largest load"
    if row.left_mm is not None and row.left_mm > 1e3 * LARGEST_LEFT_M:
        return "tissue is not back"
    return "goes on"


def _work(
    backend: str, rate_hz: float, numbers: multiprocessing.Queue[int | None], rows: multiprocessing.Queue[Row | None]
) -> None:
    with tm.launch(backend=backend, zenoh=False) as server:
        while (number := numbers.get()) is not None:
            try:
                rows.put(run_walk(server, number, rate_hz))
            except Exception as broken:  # a walk that cannot be made is a row, too
                rows.put(broken_row(number, broken))
    rows.put(None)


def broken_row(number: int, broken: Exception) -> Row:
    scene, instrument, motion, resolution = plan_of(number)
    values: dict[str, Any] = dict.fromkeys((field.name for field in fields(Row)), 0)
    values |= {"walk": number, "scene": scene, "instrument": instrument, "motion": motion, "resolution": resolution}
    values |= {"left_mm": None, "stopped_at_s": None, "verdict": f"broke: {type(broken).__name__}: {broken}"[:200]}
    return Row(**values)


def walks(
    backend: str, numbers: list[int], jobs: int, rate_hz: float = 0.0, limit_s: float = math.inf
) -> Iterator[Row]:
    """Makes walks, some at a time, each job with a daemon of its own. limit_s: no walk starts after this time."""
    context = multiprocessing.get_context("spawn")
    queue, rows = context.Queue(), context.Queue()
    workers = [context.Process(target=_work, args=(backend, rate_hz, queue, rows), daemon=True) for _ in range(jobs)]
    for worker in workers:
        worker.start()
    left, ended, waiting = list(numbers), 0, 0
    began = time.monotonic()
    for _ in range(min(jobs, len(left))):
        queue.put(left.pop(0))
        waiting += 1
    while waiting > 0:
        row = rows.get()
        waiting -= 1
        if left and time.monotonic() - began < limit_s:
            queue.put(left.pop(0))
            waiting += 1
        yield row
    for _ in workers:
        queue.put(None)
    while ended < len(workers):
        ended += rows.get() is None
    for worker in workers:
        worker.join()


def table(rows: list[Row]) -> str:
    """A line for each scene."""
    lines = [
        "| scene | walks | stopped | with a recovery | steps in recoveries | tissue held | largest force "
        "| tissue left away, at most |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for scene in SCENES + BLADE_SCENES:
        of = [row for row in rows if row.scene == scene]
        if not of:
            continue
        left = max((row.left_mm for row in of if row.left_mm is not None), default=None)
        lines.append(
            f"| `{scene}` | {len(of)} | {sum(row.stopped_at_s is not None for row in of)} "
            f"| {sum(row.recoveries > 0 for row in of)} | {sum(row.recovering_steps for row in of)} "
            f"| {sum(row.held_steps for row in of)} | {max(row.largest_force_n for row in of):.3g} N "
            f"| {'free body, or cut' if left is None else f'{left:.3g} mm'} |"
        )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m stability.monkey", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--walks", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--blades", action="store_true", help="walks with a scalpel or scissors")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--rate", type=float, default=0.0, help="steps a second; default: the scene's")
    parser.add_argument("--limit", type=float, default=math.inf, help="start no walk after this time [s]")
    parser.add_argument("--write", type=Path, help="CSV file for the rows")
    arguments = parser.parse_args()
    first = arguments.first + (FIRST_BLADE_WALK if arguments.blades else 0)
    numbers = list(range(first, first + arguments.walks))
    rows = []
    for row in walks(arguments.backend, numbers, arguments.jobs, arguments.rate, arguments.limit):
        rows.append(row)
        print(
            f"{row.walk} {row.scene} {row.instrument} {row.motion} ×{row.resolution}: {row.verdict}; "
            f"{row.largest_force_n:.3g} N, {row.recovering_steps} steps in recoveries, {row.seconds} s",
            flush=True,
        )
    rows.sort(key=lambda row: row.walk)
    print(table(rows))
    if arguments.write:
        csv_rows.write(arguments.write, rows)
    return int(any(row.verdict != "goes on" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
