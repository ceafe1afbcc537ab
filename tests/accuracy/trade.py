"""What the demo scenes' settings cost and reach: results/trade-<scene>-<backend>.jsonl, and the presets made of them.

python -m accuracy.trade [--backend cpu|cuda] [--quick] [--scene NAME]   measures; goes on where it was stopped
python -m accuracy.trade --presets                                       only makes the presets of the results anew
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

from tensormass import presets
from tensormass.cli import main as tensormass
from tensormass.processes import BUILD_BIN
from tensormass.trade import report, sweep
from tensormass.trade.knobs import Knob
from tensormass.trade.store import Measurement

from . import record

FOLDER = Path(__file__).parent / "results"
SCENES = ("demo", "cantilever")
#: The machine whose front the presets are points of.
PRESETS_BACKEND = "cpu"
TOLERANCE = "2%"


@dataclass(frozen=True)
class Trade:
    """One file of results. `head`: everything but the measurements."""

    head: dict
    measurements: list[Measurement]

    @staticmethod
    def read(scene: str, backend: str) -> Trade | None:
        path = _path(scene, backend)
        if not path.exists():
            return None
        head, *rows = (json.loads(line) for line in path.read_text().splitlines())
        return Trade(head, [Measurement.from_plain({**row, "machine": head["machine"]}) for row in rows])

    def chosen(self) -> dict[str, Measurement]:
        """What keeps the promises of the presets' names, in median and in 99th percentile; the first measurement, the
        scene as it is, does."""
        own = self.measurements[0]
        no_slower = self._within(1.0)
        return {
            "fast": min((of for of in no_slower if _error(of) <= _error(own)), key=lambda of: of.cost_s),
            "balanced": min(no_slower, key=_error),
            "accurate": min(self._within(2.0), key=_error),
        }

    def _within(self, factor: float) -> list[Measurement]:
        """Those that take at most so many times as long as the scene as it is, their slow steps too."""
        own = self.measurements[0]
        return [
            of
            for of in self.measurements
            if of.errors and of.cost_s <= factor * own.cost_s and _slow_s(of) <= factor * _slow_s(own)
        ]


def _error(of: Measurement) -> float:
    assert of.errors
    return of.errors.judged


def _slow_s(of: Measurement) -> float:
    """As `cost_s`, of the 99th percentile."""
    assert of.costs
    return of.cost_s * of.costs.step_p99_s / of.costs.step_p50_s


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m accuracy.trade", description=__doc__.splitlines()[0])
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--scene", choices=SCENES, help="one of them")
    parser.add_argument("--quick", action="store_true", help="as `tensormass trade --quick`")
    parser.add_argument("--reference-seconds", default="1200", help="as of `tensormass trade`")
    parser.add_argument("--presets", action="store_true", help="measure nothing")
    arguments = parser.parse_args()
    if not arguments.presets:
        for scene in [arguments.scene] if arguments.scene else SCENES:
            _measure(scene, arguments)
    _write_presets()
    return 0


def _measure(scene: str, arguments: argparse.Namespace) -> None:
    folder = BUILD_BIN.parent / "trade" / f"{scene}-{arguments.backend}"
    result = folder / "trade.json"
    result.unlink(missing_ok=True)
    options = ["--tolerance", TOLERANCE, *(["--quick"] if arguments.quick else [])]
    options += ["--reference-seconds", arguments.reference_seconds]
    tensormass(["trade", scene, "--backend", arguments.backend, "--out", str(folder), *options])
    if not result.exists():  # what was wrong has been said; that no setting is good enough is no error here
        sys.exit(1)
    content = json.loads(result.read_text())
    rows = content.pop("measurements")
    for unused in ("fastest", "most_accurate", "front"):
        del content[unused]
    head = {
        "scene": content.pop("scene"),
        "command": f"tensormass trade {scene} --backend {arguments.backend} {' '.join(options)}",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "commit": record.commit(),
        "host": record.machine(),
        **content,
    }
    lines = [head, *({name: of for name, of in row.items() if name != "machine"} for row in rows)]
    path = _path(scene, arguments.backend)
    path.write_text("".join(json.dumps(_rounded(line), ensure_ascii=False) + "\n" for line in lines))
    print(f"wrote {path}")


def _write_presets() -> None:
    chosen = {
        scene: {name: dict(of.setting) for name, of in trade.chosen().items()}
        for scene in SCENES
        if (trade := Trade.read(scene, PRESETS_BACKEND))
    }
    comment = (
        f"# Made by `make trade` of tests/accuracy/results/trade-*-{PRESETS_BACKEND}.jsonl; do not edit.\n"
        "# docs/accuracy.md says what each costs and reaches.\n"
    )
    presets.FILE.write_text(comment + yaml.safe_dump(chosen, sort_keys=False))
    print(f"wrote {presets.FILE}")


def section(backends: tuple[str, ...]) -> list[str]:
    """Of docs/accuracy.md."""
    trades = [trade for scene in SCENES for backend in backends if (trade := Trade.read(scene, backend))]
    if not trades:
        return []
    promises = "; ".join(f"`{name}` is {promise}" for name, promise in presets.PROMISES.items())
    lines = [
        "",
        "## Accuracy against time",
        "",
        "Made by `make trade`, which runs `tensormass trade` on the demo scenes: each setting against the same scene "
        f"refined until it no longer moves. Of the settings measured here on the {PRESETS_BACKEND}, {promises}; also "
        "in its slow steps (p99).",
        "",
        *(f"* {words}" for words in report.words()),
    ]
    for trade in trades:
        lines += _scene(trade)
    return lines


def _scene(trade: Trade) -> list[str]:
    head = trade.head
    reference = head["reference"]
    force = "" if reference["force_error"] is None else f", of force {report.percent(reference['force_error'])}"
    finest = reference["levels"][-1]
    by_setting = {json.dumps(of.setting, sort_keys=True): of for of in trade.measurements}
    named: dict[str, list[str]] = {}
    for name, setting in presets.all_presets().get(head["scene"], {}).items():
        if of := by_setting.get(json.dumps(setting, sort_keys=True)):  # else not measured on this machine
            named.setdefault(of.key, []).append(name)
    lines = [
        "",
        f"### {head['scene']}, {head['machine']['backend']}",
        "",
        f"{head['script']}. {head['machine']['device']}; {head['host']}; {head['date']}, commit `{head['commit']}`, "
        f"`{head['command']}`.",
        "",
        f"Reference: {finest['element_count']} elements, {finest['step_count']} steps; its own error by Richardson "
        f"extrapolation of order {reference['order']:.2f}: of displacement "
        f"{report.percent(reference['displacement_error'])}{force}; {reference['ended']}. "
        f"{len(trade.measurements)} settings, {head['combinations']['measured']} of them combinations of "
        f"{head['combinations']['possible']} that are possible.",
        "",
        "The scene as it is, the front, and the presets:",
        "",
    ]
    shown = {trade.measurements[0].key, *(of.key for of in sweep.front(trade.measurements)), *named}
    by_cost = sorted((of for of in trade.measurements if of.key in shown), key=lambda of: of.cost_s)
    rows = [[", ".join(named.get(of.key, [])), *report.cells(of)] for of in by_cost]
    lines += _table(["preset", *report.HEADS], rows)
    knobs = [Knob(name, "", of["own"], tuple(of["values"])) for name, of in head["knobs"].items()]
    rows = [cells for cells, _ in report.knob_rows(knobs, trade.measurements)]
    lines += ["", "One knob at a time (× 1.00 is the scene as it is):", "", *_table(report.KNOB_HEADS, rows)]
    lines += ["", *(f"* not varied: {name}: {why}" for name, why in head["not_varied"].items())]
    return lines


def _table(heads: list[str], rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return lines + ["| " + " | ".join(cell.replace("_", " ") for cell in row) + " |" for row in rows]


def _path(scene: str, backend: str) -> Path:
    return FOLDER / f"trade-{scene}-{backend}.jsonl"


def _rounded(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        # Settings are exact: they are written into scene files.
        return {name: of if name in ("setting", "knobs") else _rounded(of) for name, of in value.items()}
    return [_rounded(of) for of in value] if isinstance(value, list) else value


if __name__ == "__main__":
    sys.exit(main())
