"""Error bars of references against much finer answers: results/calibration.json, .csv and docs/decisions/trade.md.

python -m accuracy.calibration [--only PART]     runs the cases in minutes; with --only it writes no results

`tensormass trade` claims an error bar for its reference. Each case finds the reference of a small scene, stopped after
three levels, and compares it with a much finer answer in another discretization. The distance must not exceed the bar.

    case's reference          levels         finer answer             its level    nodes along an edge
    hexahedra, selective      -1, 0, 1       quadratic tetrahedra     2            3 times as many
    quadratic tetrahedra      -2, -1, 0      hexahedra, selective     4            2.5 times as many

A level multiplies the elements along an edge by 1.5. A scene with inertia also has a step two levels finer.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import tensormass as tm
from tensormass._src.scene_file import SceneFile
from tensormass_tools.trade import reference, report
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.measures import compare
from tensormass_tools.trade.recorder import Recorder
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine, Store

from . import record
from .tables import Cell, csv_text, filled, markdown

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[2] / "docs" / "decisions" / "trade.md"
HEXAHEDRA, QUADRATIC = "hexahedra", "quadratic tetrahedra"
#: Levels of every reference: as few as `find` needs for an order.
LEVELS = 3
#: The median of bar / distance. Larger bars would call good references useless.
MOST_PESSIMISTIC = 10.0
_RATIO = 1.5
# Finer answer: its discretization, and the levels by which its mesh is finer than the last one of the reference.
_FINER = {HEXAHEDRA: (QUADRATIC, 1), QUADRATIC: (HEXAHEDRA, 4)}
_FINER_STEP_LEVELS = 2
_SETTINGS: dict[str, dict[str, Any]] = {
    HEXAHEDRA: {"shape": "hexahedron", "quadrature": "selective"},
    QUADRATIC: {"shape": "quadratic_tetrahedron", "quadrature": "selective"},
}


@dataclass(frozen=True)
class Case:
    """A small scene of one grid. discretization: of its reference. seconds, press: as in `tensormass trade`."""

    name: str
    what: str
    discretization: str
    scene: dict[str, Any]
    seconds: float | None = None
    press: tuple[float, ...] = ()
    #: True if the test suite runs it.
    quick: bool = False


@dataclass(frozen=True)
class Row:
    """One quantity of a case. bar, distance: shares of the quantity itself."""

    case: str
    what: str
    reference: str
    reference_elements: int
    finer: str
    finer_elements: int
    quantity: str
    bar: float
    distance: float
    seconds: float

    @property
    def ratio(self) -> float:
        return self.bar / self.distance

    @property
    def holds(self) -> bool:
        return self.distance <= self.bar


@dataclass(frozen=True)
class Run(record.Head):
    """All rows of one command."""

    rows: list[Row] = field(default_factory=list)

    @staticmethod
    def read() -> Run:
        content = json.loads((FOLDER / "calibration.json").read_text())
        return Run(**{**content, "rows": [Row(**row) for row in content["rows"]]})


def _law(kind: str, poisson_ratio: float, young_modulus_pa: float = 5000.0) -> dict[str, Any]:
    return {kind: {"young_modulus_pa": young_modulus_pa, "poisson_ratio": poisson_ratio}}


def _box(**limits: float) -> dict[str, Any]:
    """Region beyond or up to a coordinate: `x_min`, `x_max`, `z_max` [m]."""
    of = {"min_m": {axis: limits.get(f"{axis}_min", -1.0) for axis in "xyz"}}
    return {"box": of | {"max_m": {axis: limits.get(f"{axis}_max", 1.0) for axis in "xyz"}}}


def _scene(
    law: dict[str, Any], shape: str, size_m: Sequence[float], cells: Sequence[int], fixed: dict[str, Any]
) -> dict[str, Any]:
    grid: dict[str, Any] = {"size_m": dict(zip("xyz", size_m, strict=True)), "shape": shape}
    grid |= {f"cells_{axis}": count for axis, count in zip("xyz", cells, strict=True)}
    body = {"name": "body", "mesh": {"grid": grid}, "law": law, "density_kg_per_m3": 1000.0, "fixed": [fixed]}
    return {"name": "calibration", "bodies": [body]}


_STILL = {"solver": {"integrator": "quasi_static", "precision": "double", "newton_tolerance": 1e-6}}
_GRID_SHAPES = {HEXAHEDRA: "hexahedron", QUADRATIC: "tetrahedron"}


def _bar(discretization: str, law: dict[str, Any], cells: Sequence[int], gravity: float = 0.0) -> dict[str, Any]:
    """A bar along x, clamped at one end, under gravity [m/s²] or pulled at the other end by 1500 Pa."""
    scene = _scene(law, _GRID_SHAPES[discretization], (0.1, 0.03, 0.03), cells, _box(x_max=1e-4))
    if gravity:
        return scene | {"gravity_m_per_s2": {"z": -gravity}}
    scene["bodies"][0]["loads"] = [{"region": _box(x_min=0.0999), "traction_pa": {"x": 1500.0}}]
    return scene


def _block(discretization: str, law: dict[str, Any], cells: Sequence[int], dt_s: float) -> dict[str, Any]:
    """A block on a floor, under a probe."""
    scene = _scene(law, _GRID_SHAPES[discretization], (0.08, 0.08, 0.04), cells, _box(z_max=1e-4))
    position = {"x": 0.04, "y": 0.04, "z": 0.105}
    probe = {"name": "probe", "spherical_probe": {"radius_m": 0.06}, "position_m": position}
    return scene | {"tools": [probe], "stepping": {"dt_s": dt_s}}


_BAR, _SLIM_BAR, _BLOCK_CELLS, _SMALL_BLOCK = (10, 3, 3), (8, 2, 2), (6, 6, 4), (5, 5, 3)
_SWING = {"stepping": {"dt_s": 0.02}}
CASES = (
    Case(
        "sag 0.3",
        "sags, neo-Hookean, ν 0.3",
        HEXAHEDRA,
        _bar(HEXAHEDRA, _law("neo_hookean", 0.3), _BAR, gravity=1.0) | _STILL,
    ),
    Case(
        "sag 0.49",
        "sags, stable neo-Hookean, ν 0.49",
        HEXAHEDRA,
        _bar(HEXAHEDRA, _law("stable_neo_hookean", 0.49), _BAR, gravity=1.0) | _STILL,
    ),
    Case(
        "sag 0.45",
        "sags, corotational, ν 0.45",
        QUADRATIC,
        _bar(QUADRATIC, _law("corotational", 0.45), _BAR, gravity=1.0) | _STILL,
        quick=True,
    ),
    Case(
        "pull 0.45",
        "is pulled, Hencky, ν 0.45",
        HEXAHEDRA,
        _bar(HEXAHEDRA, _law("hencky", 0.45), (8, 3, 3)) | _STILL,
        quick=True,
    ),
    Case(
        "pull 0.49",
        "is pulled, neo-Hookean, ν 0.49",
        QUADRATIC,
        _bar(QUADRATIC, _law("neo_hookean", 0.49), (8, 3, 3)) | _STILL,
    ),
    Case(
        "press 0.3",
        "is pressed, stable neo-Hookean, ν 0.3",
        HEXAHEDRA,
        _block(HEXAHEDRA, _law("stable_neo_hookean", 0.3), _BLOCK_CELLS, 0.25) | _STILL,
        seconds=1.5,
        press=(0.1,),
    ),
    Case(
        "press 0.45",
        "is pressed at two depths, stable neo-Hookean, ν 0.45",
        HEXAHEDRA,
        _block(HEXAHEDRA, _law("stable_neo_hookean", 0.45), _BLOCK_CELLS, 0.25) | _STILL,
        seconds=2.0,
        press=(0.1, 0.2),
    ),
    Case(
        "press 0.49",
        "is pressed and swings, neo-Hookean, ν 0.49",
        QUADRATIC,
        _block(QUADRATIC, _law("neo_hookean", 0.49), _SMALL_BLOCK, 0.04),
        seconds=0.48,
        press=(0.1,),
    ),
    Case(
        "swing 0.3",
        "swings, neo-Hookean, ν 0.3",
        HEXAHEDRA,
        _bar(HEXAHEDRA, _law("neo_hookean", 0.3, 20_000.0), _SLIM_BAR, gravity=2.0) | _SWING,
        seconds=0.4,
    ),
    Case(
        "swing 0.45",
        "swings, stable neo-Hookean, ν 0.45",
        QUADRATIC,
        _bar(QUADRATIC, _law("stable_neo_hookean", 0.45, 20_000.0), _SLIM_BAR, gravity=3.0) | _SWING,
        seconds=0.4,
    ),
)


def run(case: Case, server: tm.Server, folder: Path) -> list[Row]:
    """Finds the reference of a case and the finer answer, and compares them.

    Args:
        folder: of their recordings, which are taken from it if they are there.
    """
    began = time.monotonic()
    knobs = Knobs(SceneFile.parse(json.dumps(case.scene), folder, f"{case.name}.yaml"), folder / "meshes")
    if case.discretization == QUADRATIC:  # as in a mesh that is not a grid
        knobs.refinable = {"resolution", "element_order"}
    script = Script.of(knobs.message, case.seconds, *case.press)
    recorder, store = Recorder(server, knobs.message, script), Store(folder)
    found = reference.find(
        knobs,
        script,
        recorder,
        store,
        Machine.of(server, 1),
        tolerance=1e-9,
        limit_s=1e9,
        say=lambda _: None,
        most_levels=LEVELS,
    )
    finest = found.levels[-1].setting
    finer_discretization, levels = _FINER[case.discretization]
    finer = {name: value for name, value in finest.items() if name != "element_order"}
    finer |= _SETTINGS[finer_discretization] | {"resolution": float(finest["resolution"]) * _RATIO**levels}
    if not knobs.quasi_static:
        steps = script.sample_s / float(finest["dt_s"]) * _RATIO**_FINER_STEP_LEVELS
        finer["dt_s"] = script.sample_s / round(steps)
    answer = recorder.record(knobs.apply(finer).message())
    if answer.min_det_f <= 0 or (script.one_step and answer.unconverged_steps):
        raise RuntimeError(f"{case.name}: no finer answer: {'; '.join(answer.warnings)}")
    errors = compare(found.recording, answer, recorder.weights)
    bars = {"displacement": (found.displacement_error, errors.displacement)}
    if found.force_error is not None and errors.force is not None:
        bars["force"] = found.force_error, errors.force
    names = (case.name, case.what, case.discretization, found.levels[-1].element_count)
    answer_names = (finer_discretization, answer.element_count)
    seconds = round(time.monotonic() - began, 1)
    return [Row(*names, *answer_names, quantity, bar, distance, seconds) for quantity, (bar, distance) in bars.items()]


@contextmanager
def server() -> Iterator[tm.Server]:
    """A daemon on one thread, so that numbers do not depend on the machine."""
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as launched:
        yield launched


def table(run: Run) -> list[str]:
    """Lines of docs/decisions/trade.md."""
    rows = [
        [
            f"{row.what}, {row.quantity}",
            row.reference,
            report.percent(row.bar),
            report.percent(row.distance),
            f"{row.ratio:.2g}" if row.holds else f"**{row.ratio:.2g}**",
        ]
        for row in run.rows
    ]
    median = statistics.median(row.ratio for row in run.rows)
    return [
        *markdown(["scene", "reference", "bar", "distance", "bar / distance"], rows),
        "",
        f"Commit `{run.commit}`, {run.date}, {run.machine}, {run.seconds} s: `{run.command}`. Median of the ratio: "
        f"{median:.2g}.",
    ]


def rows(run: Run) -> list[dict[str, Cell]]:
    """Rows of calibration.csv."""
    return [{**asdict(row), "ratio": row.ratio, "holds": row.holds} for row in run.rows]


def readme() -> list[str]:
    """Lines of results/README.md."""
    run = Run.read()
    return [
        "## Calibration",
        "",
        "`calibration.csv` has the error bars that references claim, and their distance from much finer answers in "
        "another discretization. Both are shares: 0.01 is one per cent.",
        "",
        f"* Run: `{run.command}`, commit `{run.commit}`, {run.date}, {run.seconds} s on {run.machine}.",
    ]


def outputs() -> dict[Path, str]:
    """The text of every file that is made of these results alone."""
    run = Run.read()
    page = filled(PAGE.read_text(), {"calibration": table(run)})
    return {FOLDER / "calibration.csv": csv_text(rows(run)), PAGE: page}


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m accuracy.calibration", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--only", default="", metavar="PART", help="cases whose name contains it; writes no results")
    arguments = parser.parse_args()
    began = time.monotonic()

    def one(case: Case) -> list[Row]:
        with server() as own, tempfile.TemporaryDirectory() as folder:
            found = run(case, own, Path(folder))
        for row in found:
            said = f"bar {row.bar:.2%}, distance {row.distance:.2%}, ratio {row.ratio:.2f}, {row.seconds:.0f} s"
            print(f"{'ok    ' if row.holds else 'FAILED'} {row.case}, {row.quantity}: {said}", flush=True)
        return found

    with ThreadPoolExecutor(2) as pool:
        found = [row for of in pool.map(one, [case for case in CASES if arguments.only in case.name]) for row in of]
    if not arguments.only:
        head = record.Head(
            backend="cpu",
            device=record.machine(),
            machine=record.machine(),
            commit=record.commit(),
            command="python -m accuracy.calibration",
            date=time.strftime("%Y-%m-%d", time.gmtime()),
            seconds=round(time.monotonic() - began),
        )
        record.write(FOLDER / "calibration.json", head.head(), [asdict(row) for row in found])
        for path, text in outputs().items():
            path.write_text(text)
        print("now run python -m accuracy.report, which names this run in the README")
    return int(not all(row.holds for row in found))


if __name__ == "__main__":
    sys.exit(main())
