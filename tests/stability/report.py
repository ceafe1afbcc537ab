"""Results as data (results/<backend>.json), and what is made of them.

    python -m stability.report

writes docs/stability.md (one page), results/rows.csv (every row) and results/README.md (how to read them).
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from accuracy import record
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES

from .case import BROKEN, CAUGHT, HOLDS, REFUSED, SHORT, Case, Verdict
from .cases import all_cases
from .promises import NOTES, PROMISES

FOLDER = Path(__file__).parent / "results"
REPOSITORY = Path(__file__).parents[2]
PAGE = REPOSITORY / "docs" / "stability.md"
BACKENDS = ("cpu", "cuda")
PRECISIONS = ("double", "float")
OUTCOMES = (HOLDS, REFUSED, CAUGHT, SHORT, BROKEN)
_SHORT_NAMES = {HOLDS: "holds", REFUSED: "refused", CAUGHT: "caught", SHORT: "short", BROKEN: "BROKEN"}
WORST = 10  # groups of rows on the page


@dataclass(frozen=True)
class Row:
    """The verdict on a case in one precision."""

    key: str
    precision: str
    verdict: Verdict

    @property
    def task(self) -> tuple[str, str]:
        return self.key, self.precision

    def line(self, explained: bool, seconds: float) -> str:
        """The row as a line for the terminal."""
        verdict = self.verdict
        share = "" if math.isnan(verdict.share) else f" {verdict.share:.0%} of the bound"
        mark = "ok " if explained else "NOT"
        return f"{mark} {self.precision:6} {self.key}: {verdict.outcome}{share} {verdict.text} [{seconds:.1f} s]"


@dataclass(frozen=True)
class Run(record.Head):
    """Everything that one command found on one backend."""

    rows: list[Row]

    def write(self) -> Path:
        """Writes one line a case and law, with outcome, share of the bound and text by shape and precision."""
        path = FOLDER / f"{self.backend}.json"
        lines: dict[str, dict[str, Any]] = {}
        for row in self.rows:
            share = None if math.isnan(row.verdict.share) else float(f"{row.verdict.share:.3g}")
            case, shape = row.key.rsplit("/", 1)
            line = lines.setdefault(case, {"case": case})
            line.setdefault(shape, {})[row.precision] = [row.verdict.outcome, share, _kept(row.verdict)]
        record.write(path, self.head(), list(lines.values()))
        return path

    @staticmethod
    def read(backend: str) -> Run | None:
        path = FOLDER / f"{backend}.json"
        if not path.exists():
            return None
        content = json.loads(path.read_text())
        rows = []
        for line in content["rows"]:
            case = line.pop("case")
            for shape, precisions in line.items():
                for precision, (outcome, share, text) in precisions.items():
                    verdict = Verdict(outcome, math.nan if share is None else share, text)
                    rows.append(Row(f"{case}/{shape}", precision, verdict))
        return Run(**{**content, "rows": sorted(rows, key=lambda row: row.precision)})


def updated(head: Mapping[str, Any], only: str, rows: Sequence[Row]) -> Run:
    """Replaces rows of a backend's results and notes the commit that ran them.

    Raises:
        ValueError: there are no results, or they are of another device.
    """
    run = Run.read(head["backend"])
    if run is None or run.device != head["device"]:
        raise ValueError(f"no results of {head['device']} to update: {run.device if run else 'none'}")
    of_task = {row.task: row for row in [*run.rows, *rows]}
    whole, *parts = [commit for commit in run.commit.split("; ") if not commit.startswith(f"{only}: ")]
    if head["commit"] != whole:
        parts.append(f"{only}: {head['commit']}")
    return replace(run, rows=list(of_task.values()), commit="; ".join([whole, *parts]))


def with_long_rows(run: Run, long: Collection[str]) -> Run:
    """Adds the rows of long cases from the backend's last results, and the commit that ran them.

    Args:
        run: a run without them; results of another device add nothing.
        long: keys of the long cases.
    """
    last = Run.read(run.backend)
    if last is None or last.device != run.device:
        return run
    rows = [row for row in last.rows if row.key in long]
    whole, *parts = last.commit.split("; ")
    commit = next((part for part in parts if part.startswith("long: ")), f"long: {whole}")
    return replace(run, rows=[*run.rows, *rows], commit=f"{run.commit}; {commit}") if rows else run


def page(runs: Sequence[Run]) -> str:
    """docs/stability.md: what is promised, the bounds, what was found, the worst rows, how to run it."""
    cases = all_cases()
    lines = [
        "# Stability",
        "",
        "The daemon at the extremes: every law in every shape, in float and double. Checks cover energy, volume and "
        "distance to a reference.",
        "",
        "## What each law promises",
        "",
        "| law | stretched far | pressed flat or to a point | inverted |",
        "|---|---|---|---|",
        *(f"| {_words(law)} | " + " | ".join(said) + " |" for law, said in PROMISES.items()),
        "",
        NOTES,
        "",
        "Refused at load: numbers that are not finite, E outside 1 mPa to 10 TPa, ν outside −0.999 to 0.4999. A state "
        "that is not finite is never published: the scene stops with a fault, and a reset restores its start.",
        "",
        "## Bounds and outcomes",
        "",
        "A row is one case in one law, shape and precision. It *holds* within all bounds, is *refused* at load by a "
        "message that names the field, or is *caught*: a guard stops the scene, or the status names the cause. "
        "Otherwise it falls *short*.",
        "",
        *_bounds(cases, runs),
        "",
        *_worst(cases, runs),
        "",
        "## Run it",
        "",
        "```sh",
        "make stability                           # on the CPU; fails if an outcome is not explained",
        "make stability BACKEND=cuda LONG=1       # on a GPU, with 10⁶ steps, an hour, millions of elements",
        "cd tests && python -m stability.report   # this page and rows.csv from committed results",
        "```",
        "",
        "| backend | device | date | commit | rows | unexplained |",
        "|---|---|---|---|---|---|",
        *_run_rows(cases, runs),
        "",
        "Commits after a semicolon ran only rows whose names contain the text.",
        "",
        "[rows.csv](../tests/stability/results/rows.csv) has every row. Its "
        "[README](../tests/stability/results/README.md) describes each section in full and what is left out; the JSON "
        "files hold every fault and warning. [guards.md](decisions/guards.md) explains what stops a scene.",
    ]
    lines += [f"\nNo results of the {backend} backend yet." for backend in _unknown(runs)]
    return "\n".join(lines) + "\n"


def _words(name: str) -> str:
    return name.replace("_", " ")


def _unknown(runs: Sequence[Run]) -> list[str]:
    return [backend for backend in BACKENDS if backend not in {run.backend for run in runs}]


def _bounds(cases: Sequence[Case], runs: Sequence[Run]) -> list[str]:
    """A table of the sections: what must hold, and how many rows of each backend had which outcome."""
    counts: dict[tuple[str, str], Counter[str]] = {}
    for run in runs:
        for row in run.rows:
            counts.setdefault((row.key.split("/", 1)[0], run.backend), Counter())[row.verdict.outcome] += 1
    lines = [
        "| section | must hold | " + " | ".join(f"{run.backend}*" for run in runs) + " |",
        "|---|---|" + "---|" * len(runs),
    ]
    for group in dict.fromkeys(case.group for case in cases):
        found = [counts.get((group.name, run.backend), Counter()) for run in runs]
        cells = ["/".join(str(count[outcome]) for outcome in OUTCOMES[:4]) for count in found]
        lines.append(f"| {group.title} | {group.must_hold} | " + " | ".join(cells) + " |")
    total = [Counter(row.verdict.outcome for row in run.rows) for run in runs]
    cells = ["/".join(str(count[outcome]) for outcome in OUTCOMES[:4]) for count in total]
    lines.append("| all | | " + " | ".join(cells) + " |")
    return [*lines, "", "\\* Rows that hold/refused/caught/short."]


@dataclass
class _Exception:
    """Rows of one case that break a law's promise, with one outcome and for one reason."""

    name: str
    outcome: str
    reason: str
    laws: dict[str, None] = field(default_factory=dict)
    shapes: dict[str, None] = field(default_factory=dict)
    count: Counter[str] = field(default_factory=Counter)  # by backend
    share: float = 0.0  # largest multiple of a bound; 0 if the scene was stopped before it was measured


def exceptions(cases: Sequence[Case], runs: Sequence[Run]) -> list[_Exception]:
    """Every row that is not what its law promises, grouped, worst first.

    A row that falls short is worse than one that is caught, because nothing warns the user.
    """
    by_key = {case.key: case for case in cases}
    found: dict[tuple[str, str, str], _Exception] = {}
    for run in runs:
        for row in run.rows:
            case, outcome = by_key.get(row.key), row.verdict.outcome
            if case is None or outcome in case.expects:
                continue
            reason = case.reason(outcome, row.precision) or "NOT EXPLAINED"
            name = f"{case.group.name}: {case.name}"
            one = found.setdefault((name, outcome, reason), _Exception(name, outcome, reason))
            one.laws[case.law] = one.shapes[case.shape] = None
            one.count[run.backend] += 1
            if not math.isnan(row.verdict.share):
                one.share = max(one.share, row.verdict.share)
    rank = (BROKEN, SHORT, CAUGHT, REFUSED, HOLDS)
    return sorted(found.values(), key=lambda one: (rank.index(one.outcome), -one.share, -one.count.total()))


def _worst(cases: Sequence[Case], runs: Sequence[Run]) -> list[str]:
    found = exceptions(cases, runs)
    shown = found[:WORST]
    letters = {reason: chr(ord("a") + place) for place, reason in enumerate(dict.fromkeys(one.reason for one in shown))}
    lines = [
        "## The ten worst",
        "",
        f"{sum(one.count.total() for one in found)} rows break a promise, each for a known reason. The worst, "
        "CPU and CUDA together:",
        "",
        "| case | law | shape | outcome | × bound | rows | why |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in shown:
        share = f"{one.share:.2g}" if one.share < 100 else f"{one.share:.0f}"
        lines.append(
            f"| {one.name} | {_all_but(one.laws, LAWS)} | {_all_but(one.shapes, SHAPES)} | {_SHORT_NAMES[one.outcome]} "
            f"| {share if one.share else '–'} | {one.count.total()} | {letters[one.reason]} |"
        )
    return [*lines, "", *(f"* {letter}: {reason}." for reason, letter in letters.items())]


def _all_but(some: Iterable[str], every: Iterable[str]) -> str:
    """Joins names; 'all' or 'all but one' if that is shorter."""
    missing = [name for name in every if name not in set(some)]
    if not missing:
        return "all"
    return f"all but {_words(missing[0])}" if len(missing) == 1 else _words(", ".join(some))


def _run_rows(cases: Sequence[Case], runs: Sequence[Run]) -> Iterator[str]:
    for run in runs:
        ran = {row.key for row in run.rows}
        missing = sum(len(case.precisions) for case in cases if not case.long and case.key not in ran)
        rows = f"{len(run.rows)}" + (f", {missing} not run" if missing else "")
        yield (
            f"| {run.backend} | {run.device} | {run.date} | `{run.commit}` | {rows} | {len(unexplained_rows(run))} |"
        )


def table(runs: Sequence[Run]) -> str:
    """results/rows.csv: one line a case, law and shape; of each backend and precision the outcome and its share."""
    cells: dict[str, dict[str, tuple[str, str]]] = {}
    for run in runs:
        for row in run.rows:
            share = "" if math.isnan(row.verdict.share) else f"{row.verdict.share:.3g}"
            found = cells.setdefault(row.key, {})
            found[f"{run.backend} {row.precision}"] = (_SHORT_NAMES[row.verdict.outcome], share)
    columns = [f"{run.backend} {precision}" for run in runs for precision in PRECISIONS]
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    heads = [head for column in columns for head in (column, f"{column} share of bound")]
    out.writerow(["section", "case", "law", "shape", *heads])
    for case in all_cases():
        if case.key in cells:
            values = [value for column in columns for value in cells[case.key].get(column, ("", ""))]
            out.writerow([case.group.name, case.name, case.law, case.shape, *values])
    return text.getvalue()


def explanation() -> str:
    """results/README.md: how to read the files, each section in full, what is left out."""
    cases = all_cases()
    lines = [
        "# Results",
        "",
        "Made by `python -m stability.report`; do not edit.",
        "",
        "* `rows.csv`: one line a case, law and shape. For each backend and precision it has the outcome and the "
        "largest share of a bound that a check takes. A share above 1 misses the bound; an empty one was not measured.",
        "* `cpu.json`, `cuda.json`: the same rows with the text of each refusal, fault or warning, and machine, commit "
        "and command at the top. An update of some rows adds its commit behind a semicolon.",
        "",
        "## Left out",
        "",
        "Every section runs every law in every shape and both precisions, except:",
        "",
        *_left_out(cases),
    ]
    for group in dict.fromkeys(case.group for case in cases):
        lines += ["", f"## {group.title} (`{group.name}`)", "", group.text]
    return "\n".join(lines) + "\n"


def _left_out(cases: Sequence[Case]) -> list[str]:
    """A line for each section without some law, shape or precision, which says what it covers."""
    lines = []
    for group in dict.fromkeys(case.group for case in cases):
        by_name: dict[str, list[Case]] = {}
        for case in cases:
            if case.group is group:
                by_name.setdefault(case.name, []).append(case)
        names: dict[str, list[str]] = {}
        for name, members in by_name.items():
            names.setdefault("; ".join(_only(members)), []).append(name)
        whole = names.pop("", [])
        for made_of, some in names.items():
            which = f", {'; '.join(some)}" if whole or len(names) > 1 else ""
            lines.append(f"* {group.title}{which}: {made_of}".replace("_", " "))
    return lines


def _only(cases: Sequence[Case]) -> list[str]:
    """Laws, shapes and precisions of cases of one name, where these are not all."""
    found = []
    for every, some in (
        (LAWS, {case.law for case in cases} - {"any"}),
        (SHAPES, {case.shape for case in cases} - {"any"}),
        (PRECISIONS, {precision for case in cases for precision in case.precisions}),
    ):
        have, without = ([of for of in every if (of in some) is wanted] for wanted in (True, False))
        if have and without:
            found.append(f"without {', '.join(without)}" if len(without) < len(have) else f"{', '.join(have)} only")
    return found


def _kept(verdict: Verdict) -> str:
    """The text without the scene's name and the advice, which are the same in thousands of rows."""
    if verdict.outcome != CAUGHT:
        return verdict.text
    # An update writes old rows again, so shortening a short text must not change it.
    missed = re.search(r"( \([^()]*, bound [^()]*\))+$", verdict.text)
    said = verdict.text[: missed.start()] if missed else verdict.text
    return _first_sentence(re.sub(r"^scene '[\w-]+' is stopped: ", "", said)) + (missed[1] if missed else "")


def _first_sentence(text: str) -> str:
    """What went wrong, without the advice that follows."""
    return re.split(r"\. |; take |; give it more", text)[0]


def unexplained_rows(run: Run) -> list[Row]:
    """Rows whose outcome the case does not explain, and rows of cases that no longer exist."""
    cases = {case.key: case for case in all_cases()}
    return [
        row
        for row in run.rows
        if row.key not in cases or not cases[row.key].explains(row.verdict.outcome, row.precision)
    ]


def files(runs: Sequence[Run]) -> dict[Path, str]:
    """Everything that is made of the results, by where it lies."""
    return {PAGE: page(runs), FOLDER / "rows.csv": table(runs), FOLDER / "README.md": explanation()}


def main() -> int:
    runs = [run for backend in BACKENDS if (run := Run.read(backend))]
    for path, text in files(runs).items():
        path.write_text(text)
        print(f"wrote {path.relative_to(REPOSITORY)}")
    return int(any(unexplained_rows(run) for run in runs))


if __name__ == "__main__":
    sys.exit(main())
