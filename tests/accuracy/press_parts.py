"""What the error of the force in the hand is made of: results/press-parts.json, docs/decisions/force.md.

python -m accuracy.press_parts [--group meshes|contacts|steps]    one group leaves the rows of the others as they are

*meshes*: equilibria of the demo organ under the probe at the two depths of press.py, against a graded mesh of quadratic
tetrahedra. Each row changes one thing. *contacts*: the same on the demo's mesh, against its equilibria without
penetration. *steps*: the script of press.py on the demo's mesh, against steps of 1/1920 s.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import tensormass as tm
from tensormass._shared.errors import TensormassError
from tensormass._src import mesh_files
from tensormass._src.launching import launch
from tensormass._src.meshes import FloatArray
from tensormass._src.organ import ORGANS, Organ
from tensormass._src.packing import body_mesh
from tensormass._src.scene_file import SceneFile
from tensormass._src.server import Server
from tensormass.v1 import edit_pb2, scene_pb2
from tensormass_tools.trade.interpolation import Interpolation
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.knobs import Setting as Values
from tensormass_tools.trade.measures import compare
from tensormass_tools.trade.recorder import Recorder, node_volumes
from tensormass_tools.trade.script import Script

from . import press, record
from .tables import markdown

FILE = press.FOLDER / "press-parts.json"
#: `penalty_stiffness_pa_per_m` of the demo's probe unless a scene gives another, 20 E / radius.
PENALTY_PA_PER_M = 20 * 5000 / 0.012
#: Poses on the way to each depth, so that Newton's method converges.
LOAD_STEPS = 4
#: Further steps at each depth, in which kept forces take over the load.
HELD_STEPS = 12
#: Of the step that serves as the limit in time.
SHORTEST_S = 1 / 1920
QUADRATIC: Values = {"element_order": "quadratic", "quadrature": "full"}


@dataclass(frozen=True)
class Part:
    """A mesh and a contact. penalty: times the default. rigid: by the augmented Lagrangian method."""

    name: str
    values: Values = field(default_factory=dict)
    fitted: bool = True
    penalty: float = 1
    rigid: bool = False


REFERENCE = Part("limit", {**QUADRATIC, "resolution": 1.5})
_OLD: Values = {"grading": "uniform", "quadrature": "full"}
DEMO = Part("graded towards the probe: the demo's mesh")
MESHES = (
    Part("linear tetrahedra of one size, full quadrature, not fitted to the held part", _OLD, fitted=False),
    Part("fitted to the held part", _OLD),
    Part("in selective quadrature", {"grading": "uniform"}),
    DEMO,
    Part("the demo's mesh, quadratic tetrahedra", QUADRATIC),
)
RIGID = Part("augmented Lagrangian", rigid=True)
CONTACTS = (
    Part("penalty divided by 10", penalty=0.1),
    Part("penalty, the default"),
    Part("penalty times 10", penalty=10),
    Part("augmented Lagrangian, penalty divided by 10", penalty=0.1, rigid=True),
)
#: Steps of time, by name.
STEPS: dict[str, Values] = {
    "1/960 s": {"dt_s": 1 / 960},
    "1/120 s": {"dt_s": 1 / 120},
    "1/60 s": {"dt_s": 1 / 60},
    "1/60 s, two Newton iterations": {"dt_s": 1 / 60, "newton_max_iterations": 2},
    "1/60 s, BDF2": {"dt_s": 1 / 60, "integrator": "bdf2"},
    "1/60 s, BDF2, two Newton iterations": {"dt_s": 1 / 60, "integrator": "bdf2", "newton_max_iterations": 2},
    "1/60 s, implicit midpoint": {"dt_s": 1 / 60, "integrator": "implicit_midpoint"},
}


@dataclass(frozen=True)
class Pressed:
    """An equilibrium at each depth. force_n: size of the force. displacement_m: at common points, [points, 3]."""

    element_count: int
    force_n: tuple[float, float]
    displacement_m: tuple[FloatArray, FloatArray]


Rows = list[dict[str, float | str]]


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, prog="accuracy.press_parts", description=__doc__)
    parser.add_argument("--group", choices=("meshes", "contacts", "steps"))
    group = parser.parse_args().group
    began = time.monotonic()
    old: Rows = json.loads(FILE.read_text())["rows"] if FILE.exists() else []
    rows = [row for row in old if row["group"] != group] if group else []
    with tempfile.TemporaryDirectory() as folder, launch(backend="cpu", zenoh=False) as server:
        knobs = Knobs(SceneFile.read("demo"), Path(folder))
        if group in (None, "meshes"):
            rows += _equilibria("meshes", server, knobs, MESHES, REFERENCE)
        if group in (None, "contacts"):
            rows += _equilibria("contacts", server, knobs, CONTACTS, RIGID)
        if group in (None, "steps"):
            rows += _of_time(server, knobs)
        head = record.Head.of_run(server.version(), "accuracy.press_parts", began)
    record.write(FILE, head.head(), rows)
    return 0


def tables() -> dict[str, list[str]]:
    """Tables of docs/decisions/force.md, by name."""
    content = json.loads(FILE.read_text())
    groups = {
        name: [row for row in content["rows"] if row["group"] == name] for name in ("meshes", "contacts", "steps")
    }
    source = f"{content['device']}, commit `{content['commit']}`, {content['date']}: `python -m accuracy.press_parts`."
    held = {"force held, 6 mm": "held_shallow", "12 mm": "held_deep"}
    everywhere = {"displacement": "displacement"}
    return {
        "parts": _table("mesh", groups["meshes"], held | everywhere),
        "contacts": _table("contact", groups["contacts"], held | everywhere),
        "steps": [*_table("step", groups["steps"], held | {"force, whole script": "force"} | everywhere), "", source],
    }


def _table(first: str, rows: list[Mapping[str, Any]], columns: Mapping[str, str]) -> list[str]:
    return markdown(
        [first, *columns], [[row["part"], *(_percent(row, key) for key in columns.values())] for row in rows]
    )


def _percent(row: Mapping[str, Any], key: str) -> str:
    return f"{100 * row[key]:.1f} %" if key in row else "stopped by a guard"


def _equilibria(group: str, server: Server, knobs: Knobs, parts: Sequence[Part], against: Part) -> Rows:
    limit = _press(server, knobs, against)
    rows: Rows = []
    for part in parts:
        found = _press(server, knobs, part)
        rows.append(
            {"group": group, "part": part.name, "elements": found.element_count, **_errors(knobs, found, limit)}
        )
        print(rows[-1], file=sys.stderr, flush=True)
    return rows


def _press(server: Server, knobs: Knobs, part: Part) -> Pressed:
    scene = _scene(knobs, part)
    script = Script.of(knobs.message, None, *press.DEPTHS)
    start, travel = np.array(script.start_m), np.array(script.travel_m)
    touches = 1 - script.depths_m[-1] / float(np.linalg.norm(travel))
    shares = [
        np.linspace(first, last, LOAD_STEPS + 1)[1:]
        for first, last in zip((touches, script.stays[0]), script.stays, strict=True)
    ]
    forces, displacements = [], []
    body = knobs.message.bodies[0]
    with server.load(tm.Scene(message=scene), lockstep=True) as run:
        rest = run.positions(body.name)
        mesh = replace(body_mesh(scene.bodies[0]), nodes=rest)
        at_points = Interpolation(mesh, body_mesh(body).nodes)
        for way in shares:
            for share in way:
                run.move_tool(script.tool or "", start + share * travel)
                run.step(1)
            run.step(HELD_STEPS)
            force = run.feedback(script.tool or "").force_n
            forces.append(float(np.linalg.norm(force)))
            displacements.append(at_points(run.positions(body.name) - rest))
    return Pressed(mesh.element_count, (forces[0], forces[1]), (displacements[0], displacements[1]))


def _scene(knobs: Knobs, part: Part) -> scene_pb2.Scene:
    file = knobs.apply(part.values)
    fields = copy.deepcopy(file.fields)
    if not part.fitted:
        organ = ORGANS["liver"]
        mesh = organ.unfitted(graded=False)
        held = np.flatnonzero(organ.held(mesh.nodes) >= 0).astype(np.uint32)
        path = knobs.mesh_folder / "not-fitted.msh"
        mesh_files.write_mesh(path, replace(mesh, sets={Organ.HELD: held}))
        fields["bodies"][0]["mesh"]["file"] = str(path)
    scene = replace(file, fields=fields).message()
    scene.tools[0].spherical_probe.penalty_stiffness_pa_per_m = part.penalty * PENALTY_PA_PER_M
    if part.rigid:
        scene.tools[0].contact_method = edit_pb2.CONTACT_METHOD_AUGMENTED_LAGRANGIAN
    scene.solver.Clear()
    scene.solver.integrator = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
    scene.solver.precision = scene_pb2.Solver.PRECISION_DOUBLE
    scene.solver.newton_tolerance = 1e-4
    return scene


def _errors(knobs: Knobs, found: Pressed, limit: Pressed) -> dict[str, float]:
    weights = node_volumes(body_mesh(knobs.message.bodies[0]))
    differences, sizes = (
        sum(float(weights @ (u**2).sum(axis=1)) for u in fields)
        for fields in (
            [ours - theirs for ours, theirs in zip(found.displacement_m, limit.displacement_m, strict=True)],
            limit.displacement_m,
        )
    )
    held = [abs(ours / theirs - 1) for ours, theirs in zip(found.force_n, limit.force_n, strict=True)]
    return {"held_shallow": held[0], "held_deep": held[1], "displacement": float(np.sqrt(differences / sizes))}


def _of_time(server: Server, knobs: Knobs) -> Rows:
    script = Script.of(knobs.message, None, *press.DEPTHS)
    recorder = Recorder(server, knobs.message, script)
    limit = recorder.record(knobs.apply({"dt_s": SHORTEST_S, "cg_tolerance": 1e-3}).message())
    rows: Rows = []
    for name, values in STEPS.items():
        row: dict[str, float | str] = {"group": "steps", "part": name}
        try:
            found = recorder.record(knobs.apply(values).message())
        except TensormassError as error:
            print(f"{name}: {error}", file=sys.stderr)
        else:
            row |= press.errors_of(compare(found, limit, recorder.weights, script.held()))
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    sys.exit(main())
