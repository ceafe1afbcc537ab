"""Contact against closed forms: every situation with every shape of tool, method of contact, time scheme and rate.

python -m stability.contact_kinds [--backend cpu|cuda] [--only TEXT] [--write FILE] [--document] [--jobs N]

Each row compares one number with what mechanics says, whatever the law and the mesh:

    rests      a block laid on a table: its load is its weight, and steady
    drops      a block falls flat by 5 cm on a smooth table: nothing moves it sideways
    rebounds   a block falls by 1 cm: it does not rise higher than it fell
    slides     a block drawn by 1.67 times Coulomb's limit for a second: the way of a rigid block
    held       a tool pressed 1 mm into a block on a held base: nothing moves, and the base carries what it reports
    tray       a cube falls by 10 cm on a box of 5 or 20 mm: it stays on it
    lowered    a block on a table that sinks by 10 cm in two seconds: its load is m (g + a), a that of the table
    carried    jaws hold a block by friction and take it along, the way they close and across: it does not slip

A row that is not within its bound is printed as `off`; a table of the worst row of each situation and shape follows.
--document writes that table into docs/decisions/contact.md.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import tensormass as tm
from accuracy import record
from accuracy.tables import filled

from . import csv_rows

G_M_PER_S2 = 9.81
METHODS = ("penalty", "augmented_lagrangian")
PAGE = Path(__file__).parents[2] / "docs" / "decisions" / "contact.md"
#: Integrator and largest number of Newton iterations.
SCHEMES: dict[str, tuple[Literal["implicit_euler", "bdf2", "implicit_midpoint"], int]] = {
    "implicit Euler": ("implicit_euler", 1),
    "BDF2": ("bdf2", 1),
    "midpoint": ("implicit_midpoint", 1),
    "implicit Euler with Newton": ("implicit_euler", 20),
    "BDF2 with Newton": ("bdf2", 20),
    "midpoint with Newton": ("implicit_midpoint", 20),
}
RATES_HZ = (60, 1000)
TABLES = ("plane", "box", "mesh")
FRICTION, PULL = 0.3, 1.67
#: Turns the z axis of a tool along x.
ALONG_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
#: Kind, shape, orientation, and how far the tool's position is above its lowest point.
TOOLS: dict[str, tuple[dict[str, Any], tuple[float, ...] | None, float]] = {
    "spherical_probe": ({"radius_m": 0.005}, None, 0.005),
    "capsule": ({"radius_m": 0.005, "length_m": 0.02}, ALONG_X, 0.005),
    "retractor": ({"radius_m": 0.005, "blade_length_m": 0.02, "shaft_length_m": 0.1}, None, 0.005),
    "grasper": ({"radius_m": 0.005, "jaw_length_m": 0.02}, ALONG_X, 0.005),
    "box": ({"size_x_m": 0.015, "size_y_m": 0.01, "size_z_m": 0.01, "edge_radius_m": 0.001}, None, 0.005),
}


@dataclass(frozen=True)
class Row:
    """One number. `bound` is what it may be at most."""

    backend: str
    situation: str
    shape: str
    method: str
    scheme: str
    rate_hz: int
    what: str
    value: float
    bound: float
    verdict: str


@dataclass(frozen=True)
class Case:
    """One run."""

    situation: str
    shape: str
    method: str
    scheme: str
    rate_hz: int


def cases() -> Iterator[Case]:
    """All runs, each once."""
    ways = list(itertools.product(METHODS, SCHEMES, RATES_HZ))
    for situation in ("rests", "drops", "rebounds", "slides"):
        for table, way in itertools.product(TABLES if situation != "slides" else ("plane",), ways):
            yield Case(situation, table, *way)
    for tool, way in itertools.product(TOOLS, ways):
        yield Case("held", tool, *way)
    for thickness_mm, way in itertools.product((5, 20), ways):
        yield Case("tray", f"box of {thickness_mm} mm", *way)
    for table, way in itertools.product(TABLES, ways):
        yield Case("lowered", table, *way)
    for along, way in itertools.product(("x", "y"), ways):
        yield Case("carried", f"grasper along {along}", *way)


def _stepped(scene: tm.Scene, case: Case) -> tm.Scene:
    integrator, iterations = SCHEMES[case.scheme]
    scene.set_solver(precision="double", integrator=integrator, newton_max_iterations=iterations)
    scene.set_stepping(dt_s=1 / case.rate_hz)
    return scene


def _block(
    gap_m: float, *, cells: tuple[int, int, int] = (4, 4, 2), size_m: tuple[float, ...] = (0.04, 0.04, 0.02)
) -> tuple[tm.Scene, float]:
    mesh = tm.grid(list(cells), list(size_m), origin_m=(-size_m[0] / 2, -size_m[1] / 2, gap_m), shape="hexahedron")
    scene = tm.Scene.from_mesh(
        mesh,
        law="stable_neo_hookean",
        young_modulus_pa=2e4,
        poisson_ratio=0.4,
        density_kg_per_m3=1000,
        gravity_m_per_s2=(0, 0, -G_M_PER_S2),
    )
    scene.body("body").rayleigh_stiffness_s = 0.005
    return scene, 1000 * float(np.prod(size_m))


def _add_table(scene: tm.Scene, case: Case, friction: float) -> None:
    shape: dict[str, Any] = {}
    place = (0.0, 0.0, 0.0)
    if case.shape == "box":
        shape, place = {"size_x_m": 4.0, "size_y_m": 4.0, "size_z_m": 0.4}, (0.0, 0.0, -0.2)
    if case.shape == "mesh":
        corners = np.array(list(itertools.product((-2.0, 2.0), (-2.0, 2.0), (-0.4, 0.0))))
        faces = [[0, 2, 6, 4], [1, 5, 7, 3], [0, 4, 5, 1], [2, 3, 7, 6], [0, 1, 3, 2], [4, 6, 7, 5]]
        triangles = np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
        shape = {"surface": tm.TriangleSurface.from_arrays(corners, triangles)}
    scene.add_tool(
        "table", case.shape, position_m=place, fixed=True, friction_coefficient=friction,
        contact_method=case.method, **shape,
    )  # fmt: skip


def _rests(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    scene, mass_kg = _block(0.0)
    _add_table(scene, case, FRICTION)
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        handle.step(4 * case.rate_hz)
        load = []
        for _ in range(60):
            handle.step()
            load.append(-handle.feedback("table").force_n[2])
    weight_n = mass_kg * G_M_PER_S2
    yield "load off its weight", abs(np.mean(load) / weight_n - 1), 0.01
    yield "range of the load in weights", float(np.ptp(load)) / weight_n, 0.01


def _drops(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    scene, _ = _block(0.05)
    _add_table(scene, case, 0.0)
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        start = handle.positions("body")[:, :2].mean(axis=0)
        handle.step(case.rate_hz)
        aside = handle.positions("body")[:, :2].mean(axis=0) - start
    yield "m sideways in a second", float(np.linalg.norm(aside)), 1e-3


def _rebounds(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    fall_m = 0.01
    scene, _ = _block(fall_m)
    _add_table(scene, case, 0.0)
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        height = []
        for _ in range(case.rate_hz):
            handle.step()
            height.append(handle.positions("body")[:, 2].mean() - 0.01)
    lowest = int(np.argmin(height))
    yield "height of the rebound in falls", max(max(height[lowest:]), 0.0) / fall_m, 1.0


def _slides(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    scene, mass_kg = _block(0.0)
    load = scene.body("body").loads.add()
    for corner, value in ((load.region.box.min_m, -1.0), (load.region.box.max_m, 1.0)):
        corner.x = corner.y = corner.z = value
    load.force_n.x = PULL * FRICTION * mass_kg * G_M_PER_S2
    load.schedule.CopyFrom(tm.schedule_message([(1, 0), (1 + 1e-6, 1)]))
    _add_table(scene, case, FRICTION)
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        handle.step(case.rate_hz)
        start = handle.positions("body")[:, 0].mean()
        handle.step(case.rate_hz)
        way_m = handle.positions("body")[:, 0].mean() - start
    yield "way off a rigid block's", abs(way_m / _rigid_way_m(case) - 1), 0.02


def _rigid_way_m(case: Case) -> float:
    """The way of a rigid block in a second, by the same steps. BDF2 makes one step and starts anew, because friction
    begins in that step. The midpoint rule, and BDF2 with kept forces, make steps of implicit Euler in contact."""
    dt_s, a = 1 / case.rate_hz, (PULL - 1) * FRICTION * G_M_PER_S2
    x = v = x_before = v_before = 0.0
    for step in range(case.rate_hz):
        if case.scheme.startswith("BDF2") and case.method == "penalty" and step != 1:
            v_next = (4 * v - v_before + 2 * dt_s * a) / 3
            x_next = (4 * x - x_before + 2 * dt_s * v_next) / 3
        else:
            v_next = v + dt_s * a
            x_next = x + dt_s * v_next
        x, v, x_before, v_before = x_next, v_next, x, v
    return x


def _held(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    size, cells = (0.04, 0.02, 0.02), (8, 4, 4)
    mesh = tm.grid(list(cells), list(size), shape="hexahedron")
    base = mesh.nodes[:, 2] < 1e-9
    scene = tm.Scene("held")
    body = scene.add_body(
        "block", mesh, law="hooke", young_modulus_pa=1e4, poisson_ratio=0.3, density_kg_per_m3=1000, fixed_nodes=base
    )
    body.rayleigh_mass_per_s = 20
    shape, turn, above_m = TOOLS[case.shape]
    start = (0.0105, 0.0102, size[2] + above_m)
    scene.add_tool(
        "tool", case.shape, position_m=start, orientation=turn, contact_method=case.method, max_speed_m_per_s=1, **shape
    )
    _stepped(scene, case)
    scene.set_solver(cg_tolerance=1e-8, cg_max_iterations=2000)
    with server.load(scene, lockstep=True) as handle:
        handle.move_tool("tool", (*start[:2], start[2] - 1e-3), turn)
        handle.step(2 * case.rate_hz)
        reported, carried, places = [], [], []
        for _ in range(8):
            handle.step()
            reported.append(handle.feedback("tool").force_n[2])
            carried.append(handle.fields("block", ["reaction_force"])["reaction_force"][base, 2].sum())
            places.append(handle.positions("block"))
    yield "report off what the base carries", abs(np.mean(reported) / np.mean(carried) - 1), 0.01
    yield "m that a node moves a step", max(float(np.abs(b - a).max()) for a, b in itertools.pairwise(places)), 1e-6


def _tray(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    scene, _ = _block(0.1, cells=(4, 4, 4), size_m=(0.05, 0.05, 0.05))
    thickness_m = 1e-3 * float(case.shape.split()[2])
    scene.add_tool(
        "tray", "box", position_m=(0, 0, -thickness_m / 2), fixed=True, friction_coefficient=FRICTION,
        contact_method=case.method, size_x_m=0.4, size_y_m=0.4, size_z_m=thickness_m,
    )  # fmt: skip
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        handle.step(case.rate_hz)
        lowest_m = float(handle.positions("body")[:, 2].min())
    yield "m below the tray's surface", max(-lowest_m, 0.0), 0.005


def _eased(t: float) -> float:
    """From 0 to 1 without a jump of the acceleration (least jerk: Flash, Hogan 1985)."""
    t = min(max(t, 0.0), 1.0)
    return t**3 * (10 - 15 * t + 6 * t * t)


def _lowered(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    way_m, takes_s, waits_s = 0.1, 2.0, 1.0
    scene, mass_kg = _block(0.0)
    _add_table(scene, case, 0.0)
    scene.message.tools[0].fixed = False
    start = scene.message.tools[0].position_m.z
    off = []
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        for step in range(round((waits_s + takes_s) * case.rate_hz)):
            s = ((step + 1) / case.rate_hz - waits_s) / takes_s
            handle.move_tool("table", (0, 0, start - way_m * _eased(s)))
            handle.step()
            if s > 0.01:
                # The second derivative of _eased.
                a = -way_m / takes_s**2 * (60 * s - 180 * s**2 + 120 * s**3)
                weight_n = mass_kg * (G_M_PER_S2 + a)
                off.append(abs(-handle.feedback("table").force_n[2] / weight_n - 1))
    yield "load off m (g + a), at most", max(off), 0.1


def _carried(server: tm.Server, case: Case) -> Iterator[tuple[str, float, float]]:
    size_m, squeezed_m, radius_m, jaw_m, tips_m = 0.02, 0.003, 0.008, 0.08, 0.005
    scene, mass_kg = _block(0.0, cells=(4, 4, 4), size_m=(size_m,) * 3)
    _add_table(scene, Case(case.situation, "plane", *_fields(case)[2:]), FRICTION)
    place = np.array((0.0, 0.0, tips_m))
    scene.add_tool(
        "grasper", "grasper", position_m=place, joint_values=[0.8], friction_coefficient=1.0,
        contact_method=case.method, radius_m=radius_m, jaw_length_m=jaw_m,
    )  # fmt: skip
    closed = 2 * np.arcsin((size_m / 2 - squeezed_m + radius_m) / (jaw_m - tips_m))
    along = np.array((1.0, 0.0, 0.0) if case.shape.endswith("x") else (0.0, 1.0, 0.0))
    slip = []
    with server.load(_stepped(scene, case), lockstep=True) as handle:
        for step in range(5 * case.rate_hz):
            t = (step + 1) / case.rate_hz
            at = place + 0.03 * _eased(t - 1.5) * np.array((0, 0, 1)) + 0.06 * _eased((t - 3) / 1.5) * along
            handle.move_tool("grasper", at, joint_values=[0.8 + (closed - 0.8) * _eased(t)])
            handle.step()
            if t > 2.9:
                slip.append(handle.positions("body").mean(axis=0) - at)
        load_n = -handle.feedback("grasper").force_n[2]
    yield "m that the block slips", float(np.abs(np.array(slip) - slip[0]).max()), size_m / 10
    yield "load off its weight", abs(load_n / (mass_kg * G_M_PER_S2) - 1), 0.01


_RUNS = {
    "rests": _rests,
    "drops": _drops,
    "rebounds": _rebounds,
    "slides": _slides,
    "held": _held,
    "tray": _tray,
    "lowered": _lowered,
    "carried": _carried,
}


def run_cases(backend: str, own: list[Case]) -> list[Row]:
    """Makes some runs on a daemon of their own."""
    rows = []
    with tm.launch(backend=backend, zenoh=False) as server:
        for case in own:
            try:
                found = list(_RUNS[case.situation](server, case))
            except tm.TensormassError as stop:
                found = [(f"stopped: {stop}"[:120], float("inf"), 0.0)]
            for what, value, bound in found:
                verdict = "holds" if value <= bound else "off"
                rows.append(Row(backend, *_fields(case), what, float(f"{value:.3g}"), bound, verdict))
    return rows


def _fields(case: Case) -> tuple[str, str, str, str, int]:
    return case.situation, case.shape, case.method, case.scheme, case.rate_hz


def worst_table(rows: list[Row]) -> str:
    """The worst row of each situation, shape and number, as a table in Markdown."""
    lines = [
        "| situation | shape | number | bound | within | worst | where |",
        "|---|---|---|---|---|---|---|",
    ]
    key = lambda row: (row.situation, row.shape, "stopped" if row.what.startswith("stopped") else row.what)  # noqa: E731
    for (situation, shape, what), group in itertools.groupby(sorted(rows, key=key), key):
        own = list(group)
        worst = max(own, key=lambda row: row.value)
        holds = sum(row.verdict == "holds" for row in own)
        where = f"{worst.method.replace('_', ' ')}, {worst.scheme}, {worst.rate_hz} Hz"
        cells = (situation, shape, what, f"{worst.bound:g}", f"{holds} of {len(own)}", f"{worst.value:.3g}", where)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    """Makes the runs, prints the rows that are off and the table of the worst."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m stability.contact_kinds", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--only", default="", help="runs whose words contain this")
    parser.add_argument("--write", type=Path, help="CSV file for the rows")
    parser.add_argument("--document", action="store_true", help="write the table into docs/decisions/contact.md")
    parser.add_argument("--jobs", type=int, default=2, help="daemons at once")
    arguments = parser.parse_args()
    wanted = [case for case in cases() if arguments.only in " ".join(map(str, _fields(case)))]
    if not wanted:
        parser.error(f"no run has the words {arguments.only!r}")
    parts = [(arguments.backend, wanted[job :: arguments.jobs]) for job in range(arguments.jobs)]
    with multiprocessing.get_context("spawn").Pool(arguments.jobs) as pool:
        rows = [row for part in pool.starmap(run_cases, parts) for row in part]
    for row in rows:
        if row.verdict != "holds":
            print(row, flush=True)
    table = worst_table(rows)
    print(table)
    if arguments.document:
        holds = sum(row.verdict == "holds" for row in rows)
        source = f"{holds} of {len(rows)} rows hold: {record.machine()}, `{record.commit()}`, `python -m "
        source += f"stability.contact_kinds --backend {arguments.backend} --document`."
        PAGE.write_text(filled(PAGE.read_text(), {"contact_situations": [*table.splitlines(), "", source]}))
    if arguments.write:
        csv_rows.write(arguments.write, rows)
    return int(any(row.verdict != "holds" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
