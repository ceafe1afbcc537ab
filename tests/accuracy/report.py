"""Results as data (results/<backend>.json), and docs/accuracy.md with its pictures made of them.

python -m accuracy.report
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

from . import record, trade, trade_calculix, trade_plot
from .case import Case, Group, Outcome
from .cases import all_cases

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[2] / "docs" / "accuracy.md"
BACKENDS = ("cpu", "cuda")
PRECISIONS = ("double", "float")


@dataclass(frozen=True)
class Row:
    """A case in one precision on one backend. failure: why there are no numbers."""

    key: str
    precision: str
    value: float
    reference: float
    error: float
    bound: float | None
    details: list[tuple[str, float, float]] = field(default_factory=list)
    failure: str = ""

    @property
    def passed(self) -> bool:
        return not self.failure and (self.bound is None or self.error <= self.bound)

    @staticmethod
    def of(case: Case, precision: str, outcome: Outcome) -> Row:
        error = outcome.error if math.isfinite(outcome.error) else math.inf
        bound = case.bounds[precision]
        return Row(case.key, precision, outcome.value, outcome.reference, error, bound, list(outcome.details))

    @staticmethod
    def broken(case: Case, precision: str, failure: str) -> Row:
        return Row(case.key, precision, math.nan, math.nan, math.inf, case.bounds[precision], failure=failure)


@dataclass(frozen=True)
class Run(record.Head):
    """Everything that one command found."""

    rows: list[Row]

    def write(self) -> Path:
        path = FOLDER / f"{self.backend}.json"
        record.write(path, self.head(), [asdict(row) for row in self.rows])
        return path

    @staticmethod
    def read(backend: str) -> Run | None:
        path = FOLDER / f"{backend}.json"
        if not path.exists():
            return None
        content = json.loads(path.read_text())
        return Run(**{**content, "rows": [Row(**row) for row in content["rows"]]})


def page(runs: list[Run]) -> str:
    """docs/accuracy.md."""
    cases = all_cases()
    found = {(run.backend, row.precision, row.key): row for run in runs for row in run.rows}
    groups = list(dict.fromkeys(case.group for case in cases))
    lines = [
        "# Accuracy",
        "",
        "Made by `make accuracy` from `tests/accuracy/results`; do not edit. Every shape and law against solvers and "
        "formulas that share no code with the server. A row whose error is above its bound fails the command.",
        "",
        "| backend | device | machine | date | commit | command | rows | failed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        failed = sum(not row.passed for row in run.rows)
        lines.append(
            f"| {run.backend} | {run.device} | {run.machine} | {run.date} | `{run.commit}` | `{run.command}` "
            f"| {len(run.rows)} | {failed} |"
        )
    lines += [
        f"\nNo results of the {backend} backend yet."
        for backend in BACKENDS
        if backend not in {r.backend for r in runs}
    ]
    lines += ["", "The error of each section that is nearest to its bound; in brackets its share of the bound.", ""]
    columns = [(backend, precision) for backend in (run.backend for run in runs) for precision in PRECISIONS]
    heads = [" ".join(column) for column in columns]
    both = len(runs) == len(BACKENDS)
    if both:
        heads += [f"cuda − cpu, {precision}" for precision in PRECISIONS]
    lines.append("| section | cases | " + " | ".join(heads) + " |")
    lines.append("|---|---|" + "---|" * len(heads))
    for group in groups:
        members = [case for case in cases if case.group is group]
        cells = [_worst([found.get((*column, case.key)) for case in members]) for column in columns]
        if both:
            cells += [_disagreement(found, precision, members) for precision in PRECISIONS]
        anchor = group.title.lower().replace(" ", "-").replace("'", "")
        lines.append(f"| [{group.title}](#{anchor}) | {len(members)} | " + " | ".join(cells) + " |")
    for group in groups:
        lines += _section(group, [case for case in cases if case.group is group], found, columns)
    lines += trade.section(BACKENDS)
    lines += trade_calculix.section()
    return "\n".join(lines) + "\n"


Found = dict[tuple[str, str, str], Row]


def _worst(rows: list[Row | None]) -> str:
    run = [row for row in rows if row is not None and (row.failure or row.bound is not None)]
    if not run:
        return "–"
    if any(row.failure for row in run):
        return "FAILED"
    worst = max(run, key=lambda row: row.error / row.bound)
    return f"{worst.error:.1e} ({worst.error / worst.bound:.0%})" + ("" if worst.passed else " FAILED")


def _disagreement(found: Found, precision: str, cases: list[Case]) -> str:
    """The largest relative difference of a value between the backends; values that should be zero are left out."""
    differences = []
    for case in cases:
        pair = [found.get((backend, precision, case.key)) for backend in BACKENDS]
        if all(row and not row.failure and row.reference for row in pair):
            differences.append(abs(pair[1].value - pair[0].value) / abs(pair[0].value))
    return f"{max(differences):.1e}" if differences else "–"


def _section(group: Group, cases: list[Case], found: Found, columns: list[tuple[str, str]]) -> list[str]:
    lines = ["", f"## {group.title}", "", group.text, ""]
    heads = ["shape", "law", "case", "quantity", "reference", "source"]
    backends = list(dict.fromkeys(backend for backend, _ in columns))
    for backend in backends:
        heads += [f"{backend} value", *(f"{precision}: error" for precision in PRECISIONS)]
    heads.append("bounds")
    lines += ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for case in cases:
        any_row = next((row for column in columns if (row := found.get((*column, case.key)))), None)
        reference = _number(any_row.reference) if any_row else "–"
        cells = [case.shape, case.law, case.name, case.quantity, reference, case.source]
        for backend in backends:
            by_precision = [found.get((backend, precision, case.key)) for precision in PRECISIONS]
            best = next((row for row in by_precision if row), None)
            cells += [_number(best.value) if best else "–", *map(_error, by_precision)]
        cells.append(", ".join("none" if bound is None else f"{bound:g}" for bound in case.bounds.values()))
        lines.append("| " + " | ".join(cell.replace("_", " ") for cell in cells) + " |")
    detailed = [
        (case, column, row)
        for case in cases
        for column in columns
        if (row := found.get((*column, case.key))) and row.details
    ]
    if detailed:
        lines += ["", "Refinement: value (error).", ""]
        lines += ["| shape | law | case | backend | | | |", "|---|---|---|---|---|---|---|"]
    for case, column, row in detailed:
        steps = [f"{label}: {_number(value)} ({error:.1e})" for label, value, error in row.details]
        lines.append(
            "| " + " | ".join([case.shape, case.law, case.name, " ".join(column), *steps]).replace("_", " ") + " |"
        )
    return lines


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.6g}"


def _error(row: Row | None) -> str:
    if row is None:
        return "–"
    if row.failure:
        return "**FAILED**"
    return f"{row.error:.1e}" if row.passed else f"**{row.error:.1e} FAILED**"


def main() -> int:
    runs = [run for backend in BACKENDS if (run := Run.read(backend))]
    PAGE.write_text(page(runs))
    for path in (PAGE, *trade_plot.write(BACKENDS)):
        print(f"wrote {path.relative_to(PAGE.parents[1])}")
    return int(any(not row.passed for run in runs for row in run.rows))


if __name__ == "__main__":
    sys.exit(main())
