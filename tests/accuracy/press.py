"""The force in the hand on the demo organ, by mesh and rate: results/press-<backend>.json, docs/decisions/force.md.

python -m accuracy.press [--backend cpu|cuda] [--only PART]

The probe presses to half its radius and to its whole radius, and stays at each. On a GPU errors are measured against
the last mesh of the list, at 960 Hz: graded and quadratic. The finest uniform mesh is another discretization, and its
distance says how well the limit is known. Two cores cannot compute the reference, so there only times are measured:
`--only ", 60 Hz"`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensormass._shared.errors import TensormassError
from tensormass._src.launching import launch
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import scene_pb2
from tensormass_tools.presets import FOR_BACKEND
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.knobs import Setting as Values
from tensormass_tools.trade.measures import Errors, compare
from tensormass_tools.trade.recorder import Recorder
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.script import Script

from . import record
from .tables import markdown

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[2] / "docs" / "decisions" / "force.md"
#: Depths in radii of the probe: 6 and 12 mm.
DEPTHS = (0.5, 1.0)
#: Time for the steps of a setting that are timed [s].
TIMED_S = 3.0
#: What was wanted of the demo, by backend: largest errors, and the largest 99th percentile of a step [ms].
TARGETS = {
    "cuda": {"held_shallow": 0.02, "held_deep": 0.02, "force": 0.03, "displacement": 0.015, "step_p99_ms": 0.9},
    "cpu": {"held_shallow": 0.1, "held_deep": 0.1, "force": 0.15, "displacement": 0.04, "step_p99_ms": 16.7},
}
_NAMES = {
    "held_shallow": "force held, 6 mm",
    "held_deep": "force held, 12 mm",
    "force": "force, whole script",
    "displacement": "displacement",
    "step_p99_ms": "step, 99th percentile",
}


@dataclass(frozen=True)
class Setting:
    """A mesh of the organ and how it is stepped. resolution: cells along an edge relative to the mesh of its kind."""

    graded: bool
    quadratic: bool
    resolution: float
    rate_hz: float
    cg_tolerance: float = 0.01
    selective: bool = False

    @property
    def name(self) -> str:
        kind = f"{'graded' if self.graded else 'uniform'} {'quadratic' if self.quadratic else 'linear'}"
        if self.selective:
            kind += " selective"
        return f"{kind} {self.resolution:g}, {self.rate_hz:g} Hz, CG {self.cg_tolerance:g}"


def _settings() -> list[Setting]:
    uniform = [Setting(False, False, r, 60) for r in (0.8, 1)]
    uniform += [Setting(False, False, r, 960) for r in (1, 2, 2.8)]
    uniform += [Setting(False, True, r, 960, 0.03) for r in (0.7, 1, 1.4, 2)]
    uniform += [Setting(False, False, r, 60, selective=True) for r in (0.7, 1)]
    uniform += [Setting(False, False, r, 960, 0.03, selective=True) for r in (1, 1.4, 1.7, 2)]
    graded = [Setting(True, False, 1, 60)]
    graded += [Setting(True, False, r, 60, selective=True) for r in (0.8, 1, 1.2)]
    graded += [Setting(True, False, 1.8, 960, tolerance, selective=True) for tolerance in (0.1, 0.01)]
    graded += [Setting(True, False, r, 960, 0.03, selective=True) for r in (1, 1.5, 1.8, 2, 2.5)]
    # Close steps of the resolution, because the demo on a GPU has the finest that its step leaves time for.
    fine = (2, 2.05, 2.1, 2.15, 2.2)
    graded += [Setting(True, False, r, 960, tolerance, selective=True) for r in fine for tolerance in (0.1, 0.01)]
    graded += [Setting(True, True, r, 60) for r in (0.5, 0.7)]
    graded += [Setting(True, True, r, 960, 0.03) for r in (0.7, 1, 1.2)]
    return [*uniform, *graded, Setting(True, True, 2.5, 960)]


SETTINGS = {setting.name: setting for setting in _settings()}


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, prog="accuracy.press", description=__doc__)
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--only", metavar="PART", help="settings whose names contain this, and the reference")
    args = parser.parse_args()
    *names, last = SETTINGS
    names = [name for name in names if args.only is None or args.only in name]
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, launch(backend=args.backend, zenoh=False) as server:
        knobs = Knobs(SceneFile.read("demo"), Path(folder))
        script = Script.of(knobs.message, None, *DEPTHS)
        version = server.version()
        recorder = Recorder(server, knobs.message, script)
        reference = None
        if args.backend == "cuda":
            reference = recorder.record(_scene(knobs, SETTINGS[last]))
        rows = []
        for name in names:
            (found,) = recorder.measure([_scene(knobs, SETTINGS[name])], TIMED_S)
            if isinstance(found, TensormassError):
                raise found
            errors = None
            if reference is not None:
                errors = compare(found, reference, recorder.weights, script.held())
            rows.append(_row(name, found, errors))
            print(" | ".join(_cells(rows[-1], None)), file=sys.stderr, flush=True)
            head = record.Head.of_run(version, "accuracy.press", began)
            record.write(FOLDER / f"press-{args.backend}.json", head.head(), rows)  # a time limit may end the run
    return 0


def _scene(knobs: Knobs, setting: Setting) -> scene_pb2.Scene:
    values: Values = {
        "grading": "graded" if setting.graded else "uniform",
        "element_order": "quadratic" if setting.quadratic else "as_given",
        "resolution": setting.resolution,
        "quadrature": "selective" if setting.selective else "full",
        "dt_s": 1 / setting.rate_hz,
        "cg_tolerance": setting.cg_tolerance,
    }
    return knobs.apply(values).message()


def _row(name: str, of: Recording, errors: Errors | None) -> dict[str, float | str]:
    row: dict[str, float | str] = {
        "setting": name,
        "elements": of.element_count,
        "step_p50_ms": of.costs.step_p50_s * 1e3,
        "step_p99_ms": of.costs.step_p99_s * 1e3,
    }
    return row if errors is None else {**row, **errors_of(errors)}


def errors_of(errors: Errors) -> dict[str, float]:
    """Returns the errors of a run that stayed at two depths."""
    assert errors.force is not None
    assert errors.force_held is not None
    assert errors.force_held_shallow is not None
    return {
        "held_shallow": errors.force_held_shallow,
        "held_deep": errors.force_held,
        "force": errors.force,
        "displacement": errors.displacement,
    }


def row_of_default() -> dict[str, Any]:
    """The row of the setting that `tensormass run demo` has on a GPU."""
    values = FOR_BACKEND["cuda"]["demo"]
    wanted = Setting(True, False, float(values["resolution"]), 1 / float(values["dt_s"]), selective=True)
    return next(row for row in _read("cuda")["rows"] if row["setting"] == wanted.name)


def table() -> list[str]:
    """Lines of docs/decisions/force.md: errors and times of the GPU, beside them the times of two cores."""
    on_gpu, on_cpu = _read("cuda"), _read("cpu")
    cpu_rows = {row["setting"]: row for row in on_cpu["rows"]}
    head = ["mesh, rate", "tetrahedra", "force held, 6 / 12 mm", "force, whole script", "displacement"]
    runs = "; ".join(
        f"{of['device']}, commit `{of['commit']}`, {of['date']}: `{of['command']}`" for of in (on_gpu, on_cpu)
    )
    return [
        *markdown(
            [*head, "GPU, p50 / p99", "two cores"],
            [_cells(row, cpu_rows.get(row["setting"])) for row in on_gpu["rows"]],
        ),
        "",
        f"{runs}.",
    ]


def targets() -> list[str]:
    """Lines of docs/decisions/force.md: what was wanted of the demo as it runs on each backend, and what it reaches."""
    on_gpu = row_of_default()
    name = Setting(True, False, 1, 60, selective=True).name
    errors_60_hz, on_cpu = (next(row for row in _read(of)["rows"] if row["setting"] == name) for of in ("cuda", "cpu"))
    rows = []
    for where, row, wanted in (
        ("GPU, 960 Hz", on_gpu, TARGETS["cuda"]),
        ("two cores, 60 Hz", {**errors_60_hz, **on_cpu}, TARGETS["cpu"]),
    ):
        for key, most in wanted.items():
            unit = f"{most:g} ms" if key == "step_p99_ms" else f"{100 * most:g} %"
            reached = f"{row[key]:.3g} ms" if key == "step_p99_ms" else _percent(row, key)
            rows.append([where, _NAMES[key], unit, reached if row[key] <= most else f"**{reached}, missed**"])
    return markdown(["where", "what", "target", "reached"], rows)


def _read(backend: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((FOLDER / f"press-{backend}.json").read_text())
    return content


def _cells(row: Mapping[str, Any], on_cpu: Mapping[str, Any] | None) -> list[str]:
    return [
        row["setting"],
        f"{row['elements']:,}",
        f"{_percent(row, 'held_shallow')} / {_percent(row, 'held_deep')}",
        _percent(row, "force"),
        _percent(row, "displacement"),
        _times(row),
        "" if on_cpu is None else _times(on_cpu),
    ]


def _percent(row: Mapping[str, Any], key: str) -> str:
    return f"{100 * row[key]:.1f} %" if key in row else "–"


def _times(row: Mapping[str, Any]) -> str:
    return f"{row['step_p50_ms']:.3g} / {row['step_p99_ms']:.3g} ms"


if __name__ == "__main__":
    sys.exit(main())
