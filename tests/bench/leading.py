"""Tables of whole runs, which lead README.md and docs/performance.md, and their sources.

A row that was not measured yet is left out of README. docs/performance.md names the command that makes it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from figures import figure

REPOSITORY = Path(__file__).parents[2]
Row = dict[str, Any]

README = REPOSITORY / "README.md"
PERFORMANCE = REPOSITORY / "docs" / "performance.md"
WHOLE_RUN = "whole-run.jsonl"
#: Share of its deadlines that each of several scenes must keep.
KEPT = 0.999
ROAM = REPOSITORY / "tests" / "accuracy" / "results" / "roam.jsonl"
#: The case of the meshes that `tensormass run demo` has, by backend.
ROAM_DEFAULTS = {
    "cpu": "roam: graded at the demo's probe, resolution 1, 60 Hz",
    "cuda": "roam: graded at the demo's probe, resolution 2.1, 960 Hz",
}


def where(device: str) -> str:
    """How README calls a device."""
    return "two cores" if device.endswith(" 2 threads") else device.replace("NVIDIA ", "")


def whole_runs(results: Path) -> list[Row]:
    return _rows(results / WHOLE_RUN)


def _rows(file: Path) -> list[Row]:
    return [json.loads(line) for line in file.read_text().splitlines() if line] if file.exists() else []


def roam_rows() -> dict[tuple[str, str], Row]:
    """The last row of each case and device."""
    return {(row["case"], row["device"]): row for row in _rows(ROAM)}


def long_runs(results: Path, last: int) -> list[Row]:
    """Runs of one scene: of each device and step, the last ones that are about as long as the longest."""
    found: dict[tuple[str, float], list[Row]] = {}
    for row in whole_runs(results):
        if row["scenes"] == 1 and not row["errors"]:
            found.setdefault((row["device"], row["dt_ms"]), []).append(row)
    chosen = []
    for rows in found.values():
        longest = max(row["target_rate_hz"] * row["seconds"] for row in rows)
        chosen += [row for row in rows if row["target_rate_hz"] * row["seconds"] > 0.9 * longest][-last:]
    return chosen


def most_scenes(results: Path) -> list[Row]:
    """For each device and step, the run of the most scenes that all kept KEPT of their deadlines."""
    found: dict[tuple[str, float, int], Row] = {}
    for row in whole_runs(results):
        key = row["device"], row["dt_ms"], row["elements"]
        most = found[key]["scenes"] if key in found else 0
        if row["kept_least"] >= KEPT and not row["errors"] and row["scenes"] >= most:
            found[key] = row
    several = {(row["device"], row["dt_ms"], row["elements"]) for row in whole_runs(results) if row["scenes"] > 1}
    return [row for key, row in found.items() if key in several]


# --- README -----------------------------------------------------------------------------------------------------------


class Figures:
    """Makes the figures of one row, for a page."""

    def __init__(self, page: Path, file: Path, row: Row, *names: str) -> None:
        self._page, self._file, self._row = page, file, row
        self._where = {name: row[name] for name in names}

    def value(self, field: str) -> Any:  # noqa: ANN401
        value: Any = self._row
        for part in field.split("."):
            value = value[part]
        return value

    def of(self, field: str, text: str) -> str:
        return figure(text, self._page, self._file, field, **self._where)

    def count(self, field: str) -> str:
        return self.of(field, f"{self.value(field):,}")

    def ms(self, field: str) -> str:
        return self.of(field, ms(self.value(field)))

    def percent(self, field: str, *, floor: bool = False) -> str:
        return self.of(field, percent(self.value(field), floor=floor))


def _of_run(page: Path, results: Path, row: Row) -> Figures:
    return Figures(page, results / WHOLE_RUN, row, "case", "device", "dt_ms", "scenes", "commit", "steps")


def readme_rows(results: Path) -> Iterator[str]:
    """The first rows of README's summary: an organ under a probe, as a trainer runs it."""
    for row in roam_defaults():
        of = Figures(README, ROAM, row, "case", "device")
        yield (
            f"| a probe of 5 mm roams over the demo organ, {of.count('elements')} tetrahedra | {where(row['device'])} "
            f"| force {of.percent('force_error_rms')} of its peak off, at most {of.percent('force_error_max')}; "
            f"step p99 {of.ms('step_ms_p99')} |"
        )
    runs = long_runs(results, 1)
    for row in runs:
        of = _of_run(README, results, row)
        yield (
            f"| the demo under a haptic client, {of.count('steps')} steps in real time | {where(row['device'])} "
            f"| pose to force {of.ms('pose_to_force.p50_ms')} (p99 {of.ms('pose_to_force.p99_ms')}); "
            f"{of.count('missed_per_million')} deadlines missed in a million |"
        )
    if not any(row["backend"] == "cuda" for row in runs):
        yield _short_run(results)
    for row in most_scenes(results):
        of = _of_run(README, results, row)
        yield (
            f"| such scenes of {of.count('elements')} tetrahedra at once, each with a haptic client "
            f"| {where(row['device'])} | {of.count('scenes')} keep at least {of.percent('kept_least', floor=True)} of "
            "their deadlines |"
        )
    yield from set_up_rows(README)


def _short_run(results: Path) -> str:
    """The demo for 25 s, until a longer run was measured. Its histogram is of all answered poses."""
    file = results / "nvidia-h200-demo-default.jsonl"
    of = Figures(README, file, json.loads(file.read_text().splitlines()[-1]), "case")
    return (
        f"| the demo under a haptic client, {of.count('elements')} tetrahedra | H200 "
        f"| step {of.ms('step_time.p50_ms')} (p99 {of.ms('step_time.p99_ms')}); "
        f"pose to force {of.ms('pose_to_force.p50_ms')} (p99 {of.ms('pose_to_force.p99_ms')}); "
        f"{of.count('missed_deadlines')} of {of.count('steps')} deadlines missed |"
    )


def set_up_rows(page: Path) -> Iterator[str]:
    """Times from nothing to a picture, from tests/setup/results/first-picture.jsonl: rows with `case`, `device` and
    `seconds`."""
    file = REPOSITORY / "tests" / "setup" / "results" / "first-picture.jsonl"
    rows = {row["case"]: row for row in _rows(file)}
    for row in rows.values():
        seconds = row["seconds"]
        text = f"{seconds / 60:.1f} min" if seconds > 100 else f"{seconds:.0f} s"
        of = Figures(page, file, row, "case")
        yield f"| {row['case']} | {where(row['device'])} | {of.of('seconds', text)} |"


# --- docs/performance.md ----------------------------------------------------------------------------------------------


def _roam_words(case: str) -> str:
    """How the table calls a case; its meshes are graded unless it says otherwise."""
    return case.removeprefix("roam: ").replace("graded at the demo's probe, ", "").replace("resolution ", "")


#: Parts of the cases that the page leaves to roam.jsonl.
ROAM_LEFT_OUT = ("resolution 0.7", "resolution 1.8", "resolution 1.4", "resolution 1.7", "Newton")


def roam_table() -> Iterator[str]:
    """Error of the force against the time of a step, under a probe that roams."""
    found = roam_rows()
    if not found:
        yield "Not measured yet: `python -m accuracy.roam --backend cpu`, and `cuda`, in tests."
        return
    yield "| mesh: resolution; rate | device | tetrahedra | force error: rms | largest | step: median | p99 |"
    yield "|---|---|---|---|---|---|---|"
    for (case, device), row in found.items():
        if any(part in case for part in ROAM_LEFT_OUT):
            continue
        times = (f"{row[f'step_ms_{of}']:.3g} ms" for of in ("median", "p99"))
        yield (
            f"| {_roam_words(case)} | {where(device)} | {row['elements']:,} "
            f"| {percent(row['force_error_rms'])} | {percent(row['force_error_max'])} | {' | '.join(times)} |"
        )
    if bar := roam_bar():
        yield ""
        yield (
            f"The reference is known to {percent(bar[0])} (rms) and {percent(bar[1])} (largest): so far off is a "
            "coarser one."
        )


def roam_bar() -> tuple[float, float] | None:
    """Distance of the coarse reference from the fine one, rms and largest, as shares of the largest force."""
    files = [REPOSITORY / "tests" / "accuracy" / "references" / f"roam-{name}.json" for name in ("coarse", "fine")]
    if not all(file.exists() for file in files):
        return None
    coarse, fine = ([row["force_n"] for row in json.loads(file.read_text())["rows"]] for file in files)
    off = [math.dist(a, b) for a, b in zip(coarse, fine, strict=True)]
    peak = max(math.hypot(*force) for force in fine)
    return math.sqrt(sum(of**2 for of in off) / len(off)) / peak, max(off) / peak


def runs_table(results: Path) -> Iterator[str]:
    """Pose to force, steps and deadlines of whole runs."""
    rows = long_runs(results, 2) + most_scenes(results)
    if not rows:
        yield "Not measured yet: `python tests/bench/whole_run.py --seconds 3600`, and `--backend cuda --steps 500000`."
        return
    yield (
        "| device | tetrahedra | scenes | rate | steps | pose to force: p50 / p99 / p99.9 | step: p50 / p99 / p99.9 "
        "| missed in a million |"
    )
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        force = " / ".join(f"{row['pose_to_force'][f'{of}_ms']:.3g}" for of in ("p50", "p99", "p999"))
        step = " / ".join(f"{row[f'step_ms_{of}']:.3g}" for of in ("median", "p99", "p999"))
        yield (
            f"| {where(row['device'])} | {row['elements']:,} | {row['scenes']} | {row['target_rate_hz']:g} Hz "
            f"| {row['steps']:,} | {force} ms | {step} ms | {row['missed_per_million']:,g} |"
        )


def roam_defaults() -> list[Row]:
    """The rows of the settings that `tensormass run demo` has, if they were measured."""
    return [row for (case, _), row in roam_rows().items() if case == ROAM_DEFAULTS[row["backend"]]]


def percent(share: float, *, floor: bool = False) -> str:
    """Formats a share with three digits, or with so many that it is not 100 % unless it is 1.

    floor: with so many digits that it is not rounded up, for a share that is at least so large.
    """
    if floor and share > 0.99:
        decimals = 2 if share < 0.9999 else 3
        while float(f"{100 * share:.{decimals}f}") > 100 * share:
            decimals += 1
        return f"{100 * share:.{decimals}f} %"
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.1f} %"


def ms(value: float) -> str:
    return f"{value:.3g} ms" if value < 100 else f"{value:.0f} ms"
