"""The beam's motion by CalculiX: error against time of a solver that shares no code with the server.

python -m accuracy.trade_calculix [--fresh]     after `python -m accuracy.trade --scene beam`, on the same machine

Beam, law, weight and time are the same. Displacements are compared in the same points and times with the same
reference. The reference is ours; the error of CalculiX's finest setting shows that it converges to the same motion.
Cost is the whole time of the program for what one step of the scene simulates; reading and writing are a small part.
CalculiX runs on as many threads as the machine has and with its own defaults: its tolerances, a direct solver, and
damping of high frequencies with α = −0.05.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tensormass._shared import defaults
from tensormass._src.meshes import VolumeMesh
from tensormass._src.packing import body_mesh
from tensormass._src.scene_file import SceneFile
from tensormass_tools.trade import report, sweep
from tensormass_tools.trade.interpolation import Interpolation
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.recorder import node_volumes
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Store

from . import calculix, record, trade
from .meshes import Floats, Integers, box
from .tables import Cell

SCENE, BACKEND = "beam", "cpu"
FILE = trade.FOLDER / "trade-beam-calculix.jsonl"
LIMIT_S = 300.0


@dataclass(frozen=True)
class Setting:
    """element: CalculiX's name. resolution: elements along an edge, relative to the scene's own."""

    element: str
    resolution: float
    dt_s: float = 0.01

    @property
    def key(self) -> str:
        return f"{self.element}, resolution {self.resolution:g}, dt_s {self.dt_s:g}"


#: By CalculiX's name: the shape of our meshes that it is made of, and a description.
ELEMENTS = {
    "C3D4": ("tetrahedron", "linear tetrahedra"),
    "C3D8": ("hexahedron", "hexahedra, full quadrature"),
    "C3D8I": ("hexahedron", "hexahedra with incompatible modes"),
    "C3D10": ("quadratic_tetrahedron", "quadratic tetrahedra"),
    "C3D20R": ("hexahedron", "quadratic hexahedra, reduced quadrature"),
}
SETTINGS = (
    *(Setting("C3D8I", resolution, dt_s) for resolution in (0.15, 0.25, 0.35, 0.5) for dt_s in (0.02, 0.01, 0.005)),
    *(Setting("C3D20R", resolution, dt_s) for resolution in (0.1, 0.15, 0.25) for dt_s in (0.02, 0.01, 0.005)),
    *(Setting("C3D20R", 0.35, dt_s) for dt_s in (0.02, 0.005)),
    *(Setting("C3D4", resolution) for resolution in (0.35, 0.5)),
    *(Setting("C3D8", resolution) for resolution in (0.25, 0.35)),
    *(Setting("C3D10", resolution) for resolution in (0.15, 0.25)),
)
# Edges of a hexahedron, in the order in which CalculiX numbers their midpoints.
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_CORNERS = np.array([(x, y, z) for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float)


class Beam:
    """The beam of the scene, with the points and weights in which recordings are compared."""

    def __init__(self) -> None:
        file = SceneFile.read(SCENE)
        knobs = Knobs(file, Path())
        self.message = knobs.message
        (self.body,) = self.message.bodies
        self.own_dt_s = defaults.dt_s(self.message)
        mesh = body_mesh(self.body)
        self.points, self.weights = mesh.nodes, node_volumes(mesh)
        grid = self.body.mesh.grid
        self.cells = (grid.cells_x, grid.cells_y, grid.cells_z)
        self.size_m = (grid.size_m.x, grid.size_m.y, grid.size_m.z)

    def mesh(self, setting: Setting) -> tuple[Floats, Integers]:
        """Nodes and elements of a setting."""
        x, y, z = (max(1, math.floor(count * setting.resolution + 0.5)) for count in self.cells)
        mesh = box(ELEMENTS[setting.element][0], (x, y, z), self.size_m)
        ((_, elements),) = mesh.blocks
        return quadratic(mesh.nodes, elements) if setting.element == "C3D20R" else (mesh.nodes, elements)

    def taken(self, setting: Setting, nodes: Floats, elements: Integers, u: Floats) -> Floats:
        """Interpolates displacements u [sample, node, 3] in the compared points: [sample, point, 3]."""
        if setting.element == "C3D20R":
            at, weights = serendipity(nodes, elements, self.points)
            return np.einsum("pk,spkc->spc", weights, u[:, elements[at]])
        shape = ELEMENTS[setting.element][0]
        of = Interpolation(VolumeMesh.from_arrays(nodes, [(shape, elements)]), self.points)
        return np.stack([of(sample) for sample in u])

    def error(self, ours: Floats, reference: Recording) -> tuple[float, float]:
        """Relative L2 norm over volume and time, and the worst point, defined as in `tensormass trade`."""
        (exact,) = reference.displacement
        off = (self.weights * ((ours - exact) ** 2).sum(axis=2)).sum()
        whole = (self.weights * (exact**2).sum(axis=2)).sum()
        worst = np.linalg.norm(ours - exact, axis=2).max() / np.linalg.norm(exact, axis=2).max()
        return math.sqrt(off / whole), float(worst)


def quadratic(nodes: Floats, hexahedra: Integers) -> tuple[Floats, Integers]:
    """Nodes and elements of 20-node hexahedra: adds a node at the midpoint of each edge."""
    pairs = np.sort(hexahedra[:, _EDGES], axis=2)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    middles = len(nodes) + number.reshape(len(hexahedra), len(_EDGES))
    return np.concatenate([nodes, nodes[edges].mean(axis=1)]), np.hstack([hexahedra, middles])


def serendipity(nodes: Floats, elements: Integers, points: Floats) -> tuple[Integers, Floats]:
    """For each point its element, which must be a box along the axes, and the weights of the 20 nodes."""
    low, high = nodes[elements[:, 0]], nodes[elements[:, 6]]
    local = (2 * points[:, None] - low - high) / (high - low)
    at = np.abs(local).max(axis=2).argmin(axis=1)
    x = np.take_along_axis(local, at[:, None, None], axis=1)[:, 0]
    weights = np.empty((len(points), 20))
    with_corner = x[:, None] * _CORNERS
    weights[:, :8] = np.prod(1 + with_corner, axis=2) * (with_corner.sum(axis=2) - 2) / 8
    for k, (a, b) in enumerate(_EDGES, 8):
        middle = (_CORNERS[a] + _CORNERS[b]) / 2
        factors = np.where(middle == 0, 1 - x**2, 1 + x * middle)
        weights[:, k] = np.prod(factors, axis=1) / 4
    return at, weights


def deck(beam: Beam, setting: Setting, nodes: Floats, elements: Integers, script: Script) -> str:
    """Text of CalculiX's input file."""
    law = beam.body.law.st_venant_kirchhoff
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{i}, {x:.12E}, {y:.12E}, {z:.12E}" for i, (x, y, z) in enumerate(nodes, 1)]
    lines.append(f"*ELEMENT, TYPE={setting.element}, ELSET=BODY")
    for i, element in enumerate(elements, 1):
        numbers = [i, *(node + 1 for node in element)]
        lines += [", ".join(map(str, numbers[:16])) + ("," if len(numbers) > 16 else "")]
        lines += [", ".join(map(str, numbers[16:]))] if len(numbers) > 16 else []
    fixed = np.flatnonzero(nodes[:, 0] < 1e-9) + 1
    lines += ["*NSET, NSET=WALL", *(f"{node}," for node in fixed), "*BOUNDARY", "WALL, 1, 3"]
    lines += ["*MATERIAL, NAME=TISSUE", "*ELASTIC", f"{law.young_modulus_pa:g}, {law.poisson_ratio:g}"]
    lines += ["*DENSITY", f"{beam.body.density_kg_per_m3:g}", "*SOLID SECTION, ELSET=BODY, MATERIAL=TISSUE"]
    lines += ["*AMPLITUDE, NAME=AT_ONCE", f"0., 1., {2 * script.duration_s:g}, 1."]
    lines += ["*STEP, NLGEOM, INC=100000", "*DYNAMIC, DIRECT", f"{setting.dt_s:.12E}, {script.duration_s:.12E}"]
    gravity = -beam.message.gravity_m_per_s2.z
    lines += ["*DLOAD, AMPLITUDE=AT_ONCE", f"BODY, GRAV, {gravity:g}, 0., 0., -1."]
    lines += [f"*NODE PRINT, NSET=ALL, FREQUENCY={round(script.sample_s / setting.dt_s)}", "U", "*END STEP", ""]
    return "\n".join(lines)


def solve(text: str, sample_count: int) -> tuple[Floats, float]:
    """Displacements [sample, node, 3] m, and the time that the program took [s]."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(os.cpu_count())}
    with tempfile.TemporaryDirectory(prefix="accuracy-") as folder:
        (Path(folder) / "case.inp").write_text(text)
        began = time.monotonic()
        done = subprocess.run(
            [calculix.PROGRAM, "-i", "case"],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=LIMIT_S,
        )
        took_s = time.monotonic() - began
        results = Path(folder) / "case.dat"
        if done.returncode != 0 or not results.exists():
            raise ArithmeticError(f"CalculiX gave up: {done.stdout[-300:]}")
        tables = results.read_text().split("displacements")[1:]
    if len(tables) != sample_count:
        raise ArithmeticError(f"CalculiX made {len(tables)} of {sample_count} samples")
    rows = [[line.split()[1:4] for line in table.splitlines()[1:] if line.strip()] for table in tables]
    return np.array(rows, dtype=float), took_s


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m accuracy.trade_calculix", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--fresh", action="store_true", help="run all anew")
    arguments = parser.parse_args()
    ours = trade.Trade.read(SCENE, BACKEND)
    if not calculix.available() or ours is None:
        sys.exit("it takes CalculiX (ccx) and the results of `python -m accuracy.trade --scene beam`")
    reference = Store(trade.folder_of(SCENE, BACKEND)).recording(ours.head["reference"]["key"])
    if reference is None:
        sys.exit("the reference is not in build/trade any more; run `python -m accuracy.trade --scene beam` again")
    beam = Beam()
    _, seconds = trade.SCENES[SCENE]
    script = Script.of(beam.message, float(seconds))
    head = {
        "scene": SCENE,
        "solver": calculix.source(),
        "command": "python -m accuracy.trade_calculix",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "commit": record.commit(),
        "host": record.machine(),
        "reference": ours.head["reference"]["key"],
    }
    known = {} if arguments.fresh else {row["key"]: row for row in read()[1]} if _goes_on(head) else {}
    rows = []
    for setting in SETTINGS:
        row = known.get(setting.key) or _measure(beam, setting, reference, script)
        print(f"{setting.key}: {row.get('failure') or _brief(row)}", flush=True)
        rows.append(row)
        FILE.write_text("".join(json.dumps(line, ensure_ascii=False) + "\n" for line in (head, *rows)))
    print(f"wrote {FILE}")
    return 0


def _goes_on(head: dict[str, Any]) -> bool:
    before = read()[0]
    return all(before.get(name) == head[name] for name in ("solver", "host", "reference"))


def _measure(beam: Beam, setting: Setting, reference: Recording, script: Script) -> dict[str, Any]:
    nodes, elements = beam.mesh(setting)
    row = {"key": setting.key, "element": setting.element, "elements": len(elements), "nodes": len(nodes)}
    row |= {"resolution": setting.resolution, "dt_s": setting.dt_s}
    try:
        text = deck(beam, setting, nodes, elements, script)
        displacement, took_s = solve(text, script.sample_count)
    except (ArithmeticError, subprocess.TimeoutExpired) as failure:
        return {**row, "failure": str(failure)}
    error, worst = beam.error(beam.taken(setting, nodes, elements, displacement), reference)
    numbers = {"displacement": error, "worst_node": worst, "wall_s": took_s}
    numbers["cost_s"] = took_s * beam.own_dt_s / script.duration_s
    return {**row, **{name: float(f"{value:.4g}") for name, value in numbers.items()}}


def _brief(row: dict[str, Any]) -> str:
    return f"displacement {100 * row['displacement']:.2g} %, {1e3 * row['cost_s']:.3g} ms a step of the scene"


def read() -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Head and rows of the results file; both empty without one."""
    if not FILE.exists():
        return {}, []
    head, *rows = (json.loads(line) for line in FILE.read_text().splitlines())
    return head, rows


def solved() -> list[dict[str, Any]]:
    """Rows of settings that did not fail, the cheapest first."""
    return sorted((row for row in read()[1] if "failure" not in row), key=lambda row: row["cost_s"])


def table() -> list[dict[str, Cell]]:
    """Rows for the CSV file: one for each setting, the cheapest first; failed runs come last."""
    by_cost = solved()
    front = {by_cost[i]["key"] for i in sweep.pareto([(row["cost_s"], row["displacement"]) for row in by_cost])}
    return [
        {
            "element": row["element"],
            "what": ELEMENTS[row["element"]][1],
            "resolution": row["resolution"],
            "dt_s": row["dt_s"],
            "front": row["key"] in front,
            "elements": row["elements"],
            "displacement": row.get("displacement"),
            "worst_node": row.get("worst_node"),
            "cost_ms": 1e3 * row["cost_s"] if "cost_s" in row else None,
            "failure": row.get("failure", "").split("\n")[0],
        }
        for row in [*by_cost, *(row for row in read()[1] if "failure" in row)]
    ]


def summary() -> list[str]:
    """Lines of docs/accuracy.md: what was solved, and the most accurate setting."""
    head, rows = read()
    ours = trade.Trade.read(SCENE, BACKEND)
    if not rows or ours is None:
        return []
    earlier = "" if head["reference"] == ours.head["reference"]["key"] else ", against the reference of an earlier run"
    best = min(solved(), key=lambda row: row["displacement"])
    return [
        "",
        f"{head['solver']} solved the same `{SCENE}` on {head['host']} (commit `{head['commit']}`{earlier}) with "
        f"{len(rows)} settings. The most accurate reached {report.percent(best['displacement'])} in "
        f"{report.ms(best['cost_s'])}.",
    ]


if __name__ == "__main__":
    sys.exit(main())
