"""Hashes of whole states: every built-in scene, and every law in every shape, in both precisions.

    cd tests && python -m bench.state_hashes [--backend cuda] > before.csv
    cd tests && python -m bench.state_hashes [--backend cuda] --against before.csv

A change that must not touch the physics, such as a split file or another build option, leaves every hash as it was. A
snapshot holds all that the next step needs, so its SHA-256 is the state's. Hashes are of one machine: another processor
or GPU may round otherwise.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import tensormass as tm
from accuracy import meshes
from accuracy.laws import LAWS
from tensormass.v1 import recording_pb2, scene_pb2
from tensormass_tools.hand import HandScript, script_of

COLUMNS = ("scene", "shape", "law", "precision", "steps", "sha256")
BUILTIN_STEPS = 80
_SNAPSHOT_HEADER_BYTES = 32  # recording.proto
BLOCK_STEPS = 8
#: The block that each law deforms in each shape; small, because there are many.
BLOCK_CELLS, BLOCK_SIZE_M = (5, 3, 2), (0.08, 0.06, 0.04)
PRECISIONS = {"float": scene_pb2.Solver.PRECISION_FLOAT, "double": scene_pb2.Solver.PRECISION_DOUBLE}
INTEGRATORS = (
    scene_pb2.Solver.INTEGRATOR_IMPLICIT_EULER,
    scene_pb2.Solver.INTEGRATOR_BDF2,
    scene_pb2.Solver.INTEGRATOR_IMPLICIT_MIDPOINT,
)


def _press(handle: tm.SceneHandle, scene: scene_pb2.Scene, steps: int) -> None:
    """Moves the scene's first movable tool: along its scripted hand, else 3 cm down."""
    tool = next((tool for tool in scene.tools if not tool.fixed), None)
    script = script_of(scene.name)
    hand = HandScript.read(script) if script is not None else None
    for step in range(steps):
        if hand is not None:
            pose = hand.at(2.5 + 2 * step / steps)
            handle.move_tool(hand.tool, pose.position_m, pose.orientation, joint_values=pose.joint_values)
        elif tool is not None:
            start = tool.position_m
            handle.move_tool(tool.name, (start.x, start.y, start.z - 0.03 * min(1.0, 2 * (step + 1) / steps)))
        handle.step()


def _block(shape: str, law: str, precision: str, number: int) -> scene_pb2.Scene:
    """A clamped block that gravity bends; schemes and quadratures take turns."""
    shaken = meshes.shaken(3, 0.1, BLOCK_CELLS)
    mesh = meshes.box(shape, BLOCK_CELLS, BLOCK_SIZE_M, lambda nodes: shaken(nodes / BLOCK_SIZE_M) * BLOCK_SIZE_M)
    scene = scene_pb2.Scene(name=f"block-{shape}-{law}-{precision}")
    scene.stepping.dt_s = 0.01
    scene.stepping.lockstep = True
    scene.gravity_m_per_s2.z = -9.81
    scene.solver.precision = PRECISIONS[precision]
    scene.solver.integrator = INTEGRATORS[number % len(INTEGRATORS)]
    scene.solver.newton_max_iterations = 1 + number % 2
    body = scene.bodies.add(name="block", mesh=mesh.message(), law=LAWS[law].message, density_kg_per_m3=1000)
    clamped = np.flatnonzero(mesh.nodes[:, 0] < 1e-3)
    body.fixed.add().nodes.indices.extend(clamped.tolist())
    return scene


def _digest(handle: tm.SceneHandle) -> str:
    state = recording_pb2.SnapshotState.FromString(handle.snapshot()[_SNAPSHOT_HEADER_BYTES:])
    for tool in state.tools:  # the state does not tell when and by whom a pose was sent
        for pose in (tool.pose, tool.target):
            pose.sequence = pose.client_time_ns = pose.client_id = 0
    return hashlib.sha256(state.SerializeToString(deterministic=True)).hexdigest()


def rows(server: tm.Server) -> Iterator[tuple[str, str, str, str, str, str]]:
    """Yields a row of COLUMNS for each state; a scene that stops has the guard's word in place of the hash."""
    for name, (precision, setting) in itertools.product(tm.builtin_scenes(), PRECISIONS.items()):
        scene = tm.Scene.from_file(name).message
        scene.stepping.lockstep = True
        scene.solver.precision = setting
        with server.load(scene) as handle:
            try:
                _press(handle, scene, BUILTIN_STEPS)
                digest = _digest(handle)
            except tm.FailedPreconditionError as error:
                digest = f"stopped: {error}".split("\n")[0]
        yield name, "", "", precision, str(BUILTIN_STEPS), digest
    blocks = itertools.product(meshes.MESHES, LAWS, PRECISIONS)
    for number, (shape, law, precision) in enumerate(blocks):
        with server.load(_block(shape, law, precision, number)) as handle:
            try:
                handle.step(BLOCK_STEPS)
                digest = _digest(handle)
            except tm.FailedPreconditionError as error:
                digest = f"stopped: {error}".split("\n")[0]
        yield "block", shape, law, precision, str(BLOCK_STEPS), digest


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--against", type=Path, metavar="CSV", help="compare with a file; exit status 1 if one differs")
    args = parser.parse_args()
    expected: dict[tuple[str, ...], str] = {}
    if args.against is not None:
        with args.against.open(newline="") as file:
            reader = csv.reader(file)
            if tuple(next(reader, ())) != COLUMNS:
                parser.error(f"{args.against}: not a file of this command; its first line must be {','.join(COLUMNS)}")
            expected = {tuple(row[:-1]): row[-1] for row in reader}
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(COLUMNS)
    differ = count = 0
    with tm.launch(backend=args.backend, zenoh=False) as server:
        for row in rows(server):
            writer.writerow(row)
            sys.stdout.flush()
            count += 1
            if args.against is not None and expected.pop(row[:-1], None) != row[-1]:
                differ += 1
                print(f"differs: {' '.join(row[:-1])}", file=sys.stderr)
    if args.against is not None:
        print(f"{count} states, {differ} differ, {len(expected)} of {args.against} missing", file=sys.stderr)
    return 1 if differ or expected else 0


if __name__ == "__main__":
    sys.exit(main())
