"""The force of every instrument of the built-in scenes against that of a rigid one: results/rigid-<backend>.json.

python -m accuracy.rigid [--backend cpu|cuda] [--only PART]

Each instrument is pressed from above on the demo organ, where its mesh is finest, by half its radius, and held there
until nothing moves. Gravity and friction are left out: the force is then a function of the depth alone. The reference
is the same press without penetration (augmented Lagrangian method) on graded quadratic tetrahedra, which are finer on a
GPU. An error is that of mesh and contact together; `contact` is the part of the contact, against the augmented
Lagrangian method on the same mesh.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import tensormass as tm
from tensormass._src.launching import launch
from tensormass._src.meshes import FloatArray
from tensormass._src.organ import ORGANS, liver
from tensormass._src.scene_file import SceneFile
from tensormass._src.server import Server
from tensormass.v1 import edit_pb2, scene_pb2
from tensormass_tools.presets import FOR_BACKEND
from tensormass_tools.tool_sizes import movable_tools, radius_m, shape_of
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.knobs import Setting as Values

from . import record
from .tables import markdown

FOLDER = Path(__file__).parent / "results"
#: Depth of a press, in radii of the tool. A box has half its thickness for a radius.
DEPTH_RADII = 0.5
RATE_HZ = 60
#: Before the press the tool is this far from the tissue.
_ABOVE_M = 0.002
_PRESSES_S, _HOLDS_S = 0.25, 0.6
#: A force that still changes by more than this share within the last steps is not at rest.
_RESTS = 0.002
_LAST_STEPS = 6
CONTACTS = {
    "penalty": edit_pb2.CONTACT_METHOD_PENALTY,
    "augmented Lagrangian": edit_pb2.CONTACT_METHOD_AUGMENTED_LAGRANGIAN,
}
#: Turns the z axis of a tool along x: w, x, y, z.
_ALONG_X = (float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)), 0.0)


@dataclass(frozen=True)
class Instrument:
    """A tool of a built-in scene, and how it lies on the organ.

    turn: orientation w, x, y, z. core: points of its shape in the scene's axes, [n, 3] m from its position; its surface
    is `round_m` away from them. middle_m: the point of it that is above the place of the press.
    """

    tool: scene_pb2.Tool
    turn: tuple[float, float, float, float] | None
    core: FloatArray
    round_m: float
    middle_m: FloatArray

    @property
    def name(self) -> str:
        return str(self.tool.WhichOneof("kind")).replace("_", " ")

    @property
    def depth_m(self) -> float:
        return DEPTH_RADII * radius_m(self.tool)

    def touch_m(self) -> FloatArray:
        """Returns its position when it touches the organ from above, [3] m."""
        focus = ORGANS["liver"].focus
        assert focus is not None
        steps = np.linspace(-1, 1, 15)
        x, y = np.meshgrid(steps, steps)
        cap = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[x**2 + y**2 <= 1]
        surface = (self.core[:, None, :] + self.round_m * cap[None, :, :]).reshape(-1, 3)
        at = np.array([*focus.center_m[:2], 0]) - self.middle_m
        low, high = 0.0, 0.15
        for _ in range(24):
            middle = (low + high) / 2
            inside = bool((liver(surface + at + [0, 0, middle]) > 0).any())
            low, high = (middle, high) if inside else (low, middle)
        touch: FloatArray = at + np.array([0, 0, high])
        return touch


def instruments() -> list[Instrument]:
    """The tools that hands move in the built-in scenes, each kind once, except those that burn or cut."""

    def line(*ends: tuple[float, float, float]) -> FloatArray:
        return np.array(ends[0]) + np.linspace(0, 1, 17)[:, None] * (np.array(ends[-1]) - np.array(ends[0]))

    def box(shape: scene_pb2.BoxSolid) -> FloatArray:
        half = np.array([shape.size_x_m, shape.size_y_m, shape.size_z_m]) / 2 - shape.edge_radius_m
        sides = [np.linspace(-h, h, 9) for h in half[:2]]
        return np.array([(x, y, -half[2]) for x, y in itertools.product(*sides)])

    cores: dict[str, Callable[[Any], tuple[FloatArray, tuple[float, float, float, float] | None]]] = {
        "spherical_probe": lambda shape: (np.zeros((1, 3)), None),
        "grasper": lambda shape: (line((0, 0, 0), (shape.jaw_length_m, 0, 0)), _ALONG_X),
        "retractor": lambda shape: (line((0, 0, 0), (shape.blade_length_m, 0, 0)), None),
        "box": lambda shape: (box(shape), None),
    }
    found: dict[str, Instrument] = {}
    for scene in tm.builtin_scenes():
        for tool in movable_tools(SceneFile.read(scene).message()):
            kind = str(tool.WhichOneof("kind"))
            if kind in found or kind in ("scalpel", "scissors") or tool.HasField("cautery"):
                continue
            shape = shape_of(tool)
            core, turn = cores[kind](shape)
            round_m = tool.box.edge_radius_m if kind == "box" else radius_m(tool)
            found[kind] = Instrument(tool, turn, core, round_m, core.mean(axis=0) * [1, 1, 0])
    return list(found.values())


@dataclass(frozen=True)
class Mesh:
    """A mesh of the demo organ."""

    name: str
    values: Values


DEMO = Mesh("demo's mesh", {})
FINER = Mesh("GPU's finer mesh", {"resolution": FOR_BACKEND["cuda"]["demo"]["resolution"]})
_QUADRATIC: Values = {"element_order": "quadratic", "quadrature": "full"}
#: Meshes to measure and that of the reference, by backend.
MESHES = {
    "cpu": ((DEMO,), Mesh("reference", {**_QUADRATIC, "resolution": 0.8})),
    "cuda": ((DEMO, FINER), Mesh("reference", {**_QUADRATIC, "resolution": 2.0})),
}


@dataclass(frozen=True)
class Pressed:
    """A press at rest. change: of the force within the last steps, as a share of it."""

    elements: int
    force_n: float
    change: float


def press(server: Server, knobs: Knobs, mesh: Mesh, instrument: Instrument, contact: str) -> Pressed:
    """Presses an instrument on the organ and holds it."""
    scene = knobs.apply(mesh.values).message()
    scene.ClearField("gravity_m_per_s2")
    del scene.tools[:]
    tool = scene.tools.add()
    tool.CopyFrom(instrument.tool)
    tool.contact_method = CONTACTS[contact]
    tool.friction_coefficient = 0
    tool.max_speed_m_per_s = 1
    touch = instrument.touch_m()
    up = np.array([0, 0, 1])
    above, below = touch + _ABOVE_M * up, touch - instrument.depth_m * up
    tool.position_m.x, tool.position_m.y, tool.position_m.z = above
    tool.ClearField("orientation")
    if instrument.turn is not None:
        q = tool.orientation
        q.w, q.x, q.y, q.z = instrument.turn
    joints = [0.0] * len(tool.joint_values)
    tool.joint_values[:] = joints
    scene.stepping.dt_s = 1 / RATE_HZ
    scene.solver.Clear()
    scene.solver.precision = scene_pb2.Solver.PRECISION_DOUBLE
    scene.solver.cg_tolerance, scene.solver.cg_max_iterations = 1e-4, 5000
    shares = np.minimum(np.arange(1, round((_PRESSES_S + _HOLDS_S) * RATE_HZ) + 1) / (_PRESSES_S * RATE_HZ), 1)
    poses = [(above + share * (below - above), instrument.turn, tuple(joints)) for share in shares]
    forces = []
    with server.load(tm.Scene(message=scene), lockstep=True) as handle:
        assert handle.report is not None
        elements = sum(body.element_count for body in handle.report.bodies)
        handle.follow(tool.name, poses[:-_LAST_STEPS])
        for pose in poses[-_LAST_STEPS:]:
            force = handle.follow(tool.name, [pose]).tools[0].force_n
            forces.append(float(np.linalg.norm([force.x, force.y, force.z])))
    return Pressed(elements, forces[-1], float(np.ptp(forces)) / forces[-1])


def measure(server: Server, knobs: Knobs, backend: str, instrument: Instrument) -> list[dict[str, Any]]:
    """Makes the rows of an instrument."""
    meshes, of_reference = MESHES[backend]
    rigid = "augmented Lagrangian"
    reference = press(server, knobs, of_reference, instrument, rigid)
    rows = []
    for mesh in meshes:
        found = {contact: press(server, knobs, mesh, instrument, contact) for contact in CONTACTS}
        for contact, pressed in found.items():
            rows.append(
                {
                    "instrument": instrument.name,
                    "depth_mm": 1e3 * instrument.depth_m,
                    "mesh": mesh.name,
                    "elements": pressed.elements,
                    "contact_method": contact,
                    "force_n": pressed.force_n,
                    "reference_n": reference.force_n,
                    "reference_elements": reference.elements,
                    "error": pressed.force_n / reference.force_n - 1,
                    "contact": pressed.force_n / found[rigid].force_n - 1,
                    "change": max(pressed.change, reference.change),
                }
            )
    return rows


def tables() -> dict[str, list[str]]:
    """Tables of docs/decisions/contact.md, by name: the committed results of each backend."""
    found = {}
    for backend in MESHES:
        file = FOLDER / f"rigid-{backend}.json"
        if not file.exists():
            continue
        content = json.loads(file.read_text())
        source = f"{content['device']}, `{content['commit']}`: `{content['command']}`."
        found[f"rigid_{backend}"] = [*table_of(content["rows"]), "", source]
    return found


def table_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A row for each instrument and mesh, with the error of each contact."""
    lines = []
    for (name, depth_mm, mesh), group in itertools.groupby(
        rows, lambda row: (row["instrument"], row["depth_mm"], row["mesh"])
    ):
        own = {row["contact_method"]: row for row in group}
        force = f"{own['penalty']['reference_n']:.3g} N"
        errors = [f"{100 * own[contact]['error']:+.1f} %" for contact in CONTACTS]
        lines.append([name, f"{depth_mm:g} mm", mesh, force, *errors, f"{100 * own['penalty']['contact']:+.1f} %"])
    heads = ["instrument", "depth", "mesh", "rigid, refined", *CONTACTS, "penalty, the contact alone"]
    return markdown(heads, lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--only", default="", metavar="PART", help="instruments whose names contain this; no file")
    args = parser.parse_args()
    began = time.monotonic()
    rows = []
    with tempfile.TemporaryDirectory() as folder, launch(backend=args.backend, zenoh=False) as server:
        knobs = Knobs(SceneFile.read("demo"), Path(folder))
        for instrument in instruments():
            if args.only not in instrument.name:
                continue
            own = measure(server, copy.copy(knobs), args.backend, instrument)
            rows += own
            print("\n".join(table_of(own)), file=sys.stderr, flush=True)
        head = record.Head.of_run(server.version(), "accuracy.rigid", began).head()
    if not args.only:
        record.write(FOLDER / f"rigid-{args.backend}.json", head, rows)
    print("\n".join(table_of(rows)))
    unsettled = [row for row in rows if row["change"] > _RESTS]
    for row in unsettled:
        print(f"{row['instrument']}, {row['mesh']}, {row['contact_method']}: not at rest, {row['change']:.2g}")
    return int(bool(unsettled))


if __name__ == "__main__":
    sys.exit(main())
