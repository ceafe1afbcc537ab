"""Results as data: results/<backend>.json, the CSV files beside it, docs/accuracy.md and its pictures.

python -m accuracy.report

Each figure on the page comes from the committed results. Rows, refinements and fronts are CSV files in results/.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from . import advice, calibration, contact_parts, press, press_parts, record, rigid, trade_plot, trade_tables
from .case import Case, Outcome
from .cases import all_cases
from .tables import Cell, csv_text, filled, markdown

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[2] / "docs" / "accuracy.md"
BACKENDS = ("cpu", "cuda")
PRECISIONS = ("double", "float")
#: How many rows the page shows; the CSV files have all.
WORST = 10


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

    @property
    def share(self) -> float | None:
        """The error as a share of its bound; None without a bound."""
        return None if self.bound is None else self.error / self.bound

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
    """All rows of one command."""

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


Found = dict[tuple[str, str, str], Row]


def page(runs: Sequence[Run], cases: Sequence[Case]) -> str:
    """docs/accuracy.md."""
    return (
        "\n".join(
            [
                "# Accuracy",
                "",
                "Made by `make accuracy` and `make trade` from [results](../tests/accuracy/results/README.md). "
                "Do not edit.",
                "",
                "Every element shape with every law is compared with closed forms and with solvers that share no code "
                "with the server. `make accuracy` fails if an error exceeds its bound. `make test` runs quick cases.",
                "",
                "## Runs",
                "",
                *_run_table(runs, cases),
                *_gaps(runs, cases),
                "",
                "## Bounds",
                "",
                "*Reached* is the error nearest to its bound, with its precision and its share of the bound.",
                "",
                *_bounds(runs, cases),
                *_disagreement(runs, cases),
                *_without_bound(runs, cases),
                "",
                f"## The {WORST} cases nearest to their bounds",
                "",
                *_worst(runs, cases),
                *trade_tables.section(BACKENDS),
                "",
                "## Run it",
                "",
                "    make accuracy     # on the CPU; BACKEND=cuda for a GPU; REFERENCES=1 solves the references anew",
                "    make trade        # fronts and presets; BACKEND=cuda for a GPU",
                "    cd tests && python -m accuracy --only cook    # some cases; writes no results",
                "",
                "## Data",
                "",
                *_links(runs),
            ]
        )
        + "\n"
    )


def readme(runs: Sequence[Run], cases: Sequence[Case]) -> str:
    """results/README.md: what each section and each column means, and how each file was made."""
    lines = [
        "# Accuracy results",
        "",
        "Made by `make accuracy` and `make trade`; do not edit. `*.json` and `trade-*.jsonl` are what the commands "
        "measured. The CSV files and this page are made of them.",
        "",
        "| backend | device | machine | date | commit | s | command |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {run.backend} | {run.device} | {run.machine} | {run.date} | `{run.commit}` | {run.seconds} "
        f"| `{run.command}` |"
        for run in runs
    ]
    lines += [
        "",
        "Columns of `cpu.csv` and `cuda.csv`: `error_over_bound` is 1 at the bound. An empty bound means that no claim "
        "is made. `refinement.csv` has the values and errors of each mesh or Δt of a case.",
        "",
        "## Sections",
    ]
    for group in dict.fromkeys(case.group for case in cases):
        lines += ["", f"### {group.title} (`{group.name}`)", "", group.text]
    return "\n".join([*lines, "", *calibration.readme(), "", *trade_tables.readme(BACKENDS)]) + "\n"


def case_rows(run: Run, cases: Sequence[Case]) -> list[dict[str, Cell]]:
    """One row for each case and precision of a run, in the order of the cases."""
    found = {(row.key, row.precision): row for row in run.rows}
    return [
        {
            **_names(case),
            "quantity": case.quantity,
            "source": case.source,
            "precision": precision,
            "value": row.value,
            "reference": row.reference,
            "error": row.error,
            "bound": row.bound,
            "error_over_bound": row.share,
            "passed": row.passed,
            "failure": row.failure,
        }
        for case in cases
        for precision in PRECISIONS
        if (row := found.get((case.key, precision)))
    ]


def refinement_rows(runs: Sequence[Run], cases: Sequence[Case]) -> list[dict[str, Cell]]:
    """One row for each mesh or time step of the cases that refine."""
    found = _found(runs)
    return [
        {
            **_names(case),
            "backend": run.backend,
            "precision": precision,
            "refinement": label,
            "value": value,
            "error": error,
        }
        for case in cases
        for run in runs
        for precision in PRECISIONS
        if (row := found.get((run.backend, precision, case.key)))
        for label, value, error in row.details
    ]


def outputs(runs: Sequence[Run], cases: Sequence[Case]) -> dict[Path, str]:
    """The text of every file that is made of the results."""
    rows = {run.backend: case_rows(run, cases) for run in runs}
    rows |= {"refinement": refinement_rows(runs, cases), **trade_tables.files(BACKENDS)}
    return {
        PAGE: page(runs, cases),
        FOLDER / "README.md": readme(runs, cases),
        **{FOLDER / f"{name}.csv": csv_text(of) for name, of in rows.items()},
        **advice.outputs(BACKENDS),
        **calibration.outputs(),
        press.PAGE: filled(
            press.PAGE.read_text(), {"press": press.table(), "targets": press.targets(), **press_parts.tables()}
        ),
        contact_parts.PAGE: filled(contact_parts.PAGE.read_text(), {**contact_parts.tables(), **rigid.tables()}),
    }


def _names(case: Case) -> dict[str, Cell]:
    return {"section": case.group.name, "shape": case.shape, "law": case.law, "case": case.name}


def _found(runs: Sequence[Run]) -> Found:
    return {(run.backend, row.precision, row.key): row for run in runs for row in run.rows}


def _expected(cases: Sequence[Case]) -> list[tuple[str, Case]]:
    """Precision and case of every row that a complete run has."""
    return [(precision, case) for case in cases for precision in PRECISIONS if precision in case.bounds]


def _run_table(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    expected = len(_expected(cases))
    rows = [
        [
            run.backend,
            run.device,
            f"`{run.commit}`",
            run.date,
            f"{len(run.rows)} of {expected}",
            str(sum(not row.passed for row in run.rows)),
        ]
        for run in runs
    ]
    return markdown(["backend", "device", "commit", "date", "rows", "failed"], rows)


def _gaps(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    """Sentences that name a backend without results, an older commit, and rows that are missing or no longer exist."""
    measured = {run.backend for run in runs}
    said = [f"**There are no results of the {backend} backend.**" for backend in BACKENDS if backend not in measured]
    newest = max(runs, key=lambda run: run.date, default=None)
    for run in runs:
        assert newest is not None
        if run.commit != newest.commit:
            said.append(
                f"**The {run.backend} rows are of another commit (`{run.commit}`, {run.date}) than the "
                f"{newest.backend} rows (`{newest.commit}`, {newest.date}).**"
            )
        present = {(row.precision, row.key) for row in run.rows}
        missing = [
            f"{case.key} ({precision})" for precision, case in _expected(cases) if (precision, case.key) not in present
        ]
        if missing:
            shown = "; ".join(missing[:3]) + (f"; and {len(missing) - 3} more" if len(missing) > 3 else "")
            said.append(f"**The {run.backend} run lacks {len(missing)} of its rows: {shown}.**")
        surplus = len(present - {(precision, case.key) for precision, case in _expected(cases)})
        if surplus:
            said.append(f"**{surplus} {run.backend} rows belong to cases that no longer exist.**")
    return ["", *said] if said else []


def _bounds(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    rows = []
    for group in dict.fromkeys(case.group for case in cases):
        members = [case for case in cases if case.group is group]
        rows.append(
            [
                group.title,
                str(len(members)),
                *(_bound_range(members, precision) for precision in PRECISIONS),
                *(
                    _nearest([row for run in runs if run.backend == backend for row in _of(run, members)])
                    for backend in _measured(runs)
                ),
            ]
        )
    heads = ["section", "cases", *(f"bound, {precision}" for precision in PRECISIONS)]
    return markdown([*heads, *(f"reached, {backend}" for backend in _measured(runs))], rows)


def _measured(runs: Sequence[Run]) -> list[str]:
    return [run.backend for run in runs]


def _of(run: Run, cases: Sequence[Case]) -> list[Row]:
    keys = {case.key for case in cases}
    return [row for row in run.rows if row.key in keys]


def _bound_range(cases: Sequence[Case], precision: str) -> str:
    bounds = [bound for case in cases if (bound := case.bounds.get(precision)) is not None]
    if not bounds:
        return "–"
    return f"{min(bounds):g}" if min(bounds) == max(bounds) else f"{min(bounds):g} to {max(bounds):g}"


def _nearest(rows: Sequence[Row]) -> str:
    if any(row.failure for row in rows):
        return "**FAILED**"
    bounded = [row for row in rows if row.share is not None]
    if not bounded:
        return "–"
    worst = max(bounded, key=lambda row: row.share or 0.0)
    return f"{worst.error:.1e} ({worst.precision}, {worst.share:.0%})" + ("" if worst.passed else " **FAILED**")


def _disagreement(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    """The largest relative difference of a value between the backends; values that should be zero are left out."""
    if len(runs) < len(BACKENDS):
        return []
    found = _found(runs)
    largest: Mapping[str, float] = {
        precision: max(
            (
                abs(pair[1].value - pair[0].value) / abs(pair[0].value)
                for case in cases
                if (pair := [row for backend in BACKENDS if (row := found.get((backend, precision, case.key)))])
                and len(pair) == len(BACKENDS)
                and all(not row.failure and row.reference for row in pair)
            ),
            default=math.nan,
        )
        for precision in PRECISIONS
    }
    words = [
        f"differ by at most {value:.1e} in {precision}" if value > 0 else f"agree to all stored digits in {precision}"
        for precision, value in largest.items()
    ]
    return ["", f"Values of the two backends {' and '.join(words)} (relative)."]


def _without_bound(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    """Cases about which no claim is made, with the largest error."""
    free = [case for case in cases if None in case.bounds.values()]
    errors = [row.error for run in runs for row in _of(run, free)]
    if not errors:
        return []
    sections = ", ".join(dict.fromkeys(case.group.title for case in free))
    return [
        "",
        f"No claim is made for {len(free)} cases ({sections}), where linear shapes in full quadrature lock: errors up "
        f"to {max(errors):.0%}.",
    ]


def _worst(runs: Sequence[Run], cases: Sequence[Case]) -> list[str]:
    """The cases whose largest share of a bound, over all backends and precisions, is the highest."""
    named = {case.key: case for case in cases}
    worst: dict[str, tuple[float, str, Row]] = {}
    for run in runs:
        for row in run.rows:
            if row.key in named and row.share is not None and row.share > worst.get(row.key, (-1.0,))[0]:
                worst[row.key] = (row.share, run.backend, row)
    rows = []
    for share, backend, row in sorted(worst.values(), key=lambda of: -of[0])[:WORST]:
        case = named[row.key]
        names = [case.group.title, case.name, case.shape.replace("_", " "), case.law.replace("_", " ")]
        error = "**FAILED**" if row.failure else f"{row.error:.2g}"
        rows.append([*names, f"{backend} {row.precision}", error, f"{row.bound:g}", f"{share:.0%}"])
    return markdown(["section", "case", "shape", "law", "run", "error", "bound", "share"], rows)


def _links(runs: Sequence[Run]) -> list[str]:
    folder = "../tests/accuracy/results"

    def link(name: str) -> str:
        return f"[{name}]({folder}/{name}.csv)"

    lines = [f"* All rows: {', '.join(map(link, _measured(runs)))}; each mesh and Δt: {link('refinement')}."]
    if names := list(trade_tables.files(BACKENDS)):
        lines.append(f"* Fronts: {', '.join(map(link, names))}; error bars of references: {link('calibration')}.")
    lines.append(f"* What each section solves, and what each column means: [README]({folder}/README.md).")
    lines.append(
        "* Why it is measured so: [decisions/trade.md](decisions/trade.md). Which setting: [choosing.md](choosing.md)."
    )
    return lines


def main() -> int:
    runs = [run for backend in BACKENDS if (run := Run.read(backend))]
    made = outputs(runs, all_cases())
    for path, text in made.items():
        path.write_text(text)
    for path in (*made, *trade_plot.write(BACKENDS)):
        print(f"wrote {path.relative_to(PAGE.parents[1])}")
    return int(any(not row.passed for run in runs for row in run.rows))


if __name__ == "__main__":
    sys.exit(main())
