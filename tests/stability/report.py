"""Results as data (results/<backend>.json), and docs/stability.md made of them.

python -m stability.report
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from accuracy import record
from accuracy.laws import LAWS
from accuracy.meshes import SHAPES

from .case import BROKEN, CAUGHT, HOLDS, REFUSED, SHORT, Case, Group, Verdict
from .cases import all_cases
from .promises import PROMISES

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[2] / "docs" / "stability.md"
BACKENDS = ("cpu", "cuda")
PRECISIONS = ("double", "float")
OUTCOMES = (HOLDS, REFUSED, CAUGHT, SHORT, BROKEN)
_MARKS = {HOLDS: "✓", REFUSED: "refused", CAUGHT: "caught", SHORT: "**short**", BROKEN: "**BROKEN**"}


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
        """For the terminal."""
        verdict = self.verdict
        share = "" if math.isnan(verdict.share) else f" {verdict.share:.0%} of the bound"
        mark = "ok " if explained else "NOT"
        return f"{mark} {self.precision:6} {self.key}: {verdict.outcome}{share} {verdict.text} [{seconds:.1f} s]"


@dataclass(frozen=True)
class Run(record.Head):
    """Everything that one command found."""

    rows: list[Row]

    def write(self) -> Path:
        """One line a case and law: of each shape and precision the outcome, the share of the bound and the text."""
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
    """The results of a backend with these rows in place of their own, and the commit of either.

    Raises:
        ValueError: there are none, or they are of another device.
    """
    run = Run.read(head["backend"])
    if run is None or run.device != head["device"]:
        raise ValueError(f"no results of {head['device']} to update: {run.device if run else 'none'}")
    of_task = {row.task: row for row in [*run.rows, *rows]}
    whole, *parts = [commit for commit in run.commit.split("; ") if not commit.startswith(f"{only}: ")]
    if head["commit"] != whole:
        parts.append(f"{only}: {head['commit']}")
    return replace(run, rows=list(of_task.values()), commit="; ".join([whole, *parts]))


def page(runs: Sequence[Run]) -> str:
    """docs/stability.md."""
    cases = all_cases()
    lines = [
        "# Stability",
        "",
        "Made by `make stability` from `tests/stability/results`; do not edit. What the daemon does at the extremes: "
        "every law in every shape, in float and in double, but for what the list below leaves out. *Finite* is no "
        "criterion here: energy, volume and distance to a reference are. An outcome that is not explained below fails "
        "the command.",
        "",
        *_left_out(cases),
        "",
        "| outcome | means |",
        "|---|---|",
        "| ✓ holds | every check of the case is within its bound |",
        "| refused | at load, with a message that names the field |",
        "| caught | while running: a guard stopped the scene with a fault, or the status had the warning that names "
        "what went wrong (any other counts for nothing) |",
        "| **short** | neither; the reason stands below the table |",
        "",
        "## What each law promises",
        "",
        "| law | stretched far | pressed flat or to a point | turned inside out | rotated |",
        "|---|---|---|---|---|",
    ]
    lines += [f"| {law.replace('_', ' ')} | " + " | ".join(said) + " |" for law, said in PROMISES.items()]
    lines += [
        "",
        "All laws: E from 1 mPa to 10 TPa and ν from −0.999 to 0.4999 are admitted, others refused at load, as is "
        "every number that is not finite. A state that is no number any more is never published: the scene stops with "
        "a fault, and a reset brings it back to its start.",
        "",
        "## Runs",
        "",
        "| backend | device | machine | date | commit | command | s | rows | "
        + " | ".join(OUTCOMES[:4])
        + " | unexplained |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        counts = [str(sum(row.verdict.outcome == outcome for row in run.rows)) for outcome in OUTCOMES[:4]]
        unexplained = len(unexplained_rows(run))
        ran = {row.key for row in run.rows}
        missing = sum(len(case.precisions) for case in cases if not case.long and case.key not in ran)
        rows = f"{len(run.rows)}" + (f", {missing} not run" if missing else "")
        lines.append(
            f"| {run.backend} | {run.device} | {run.machine} | {run.date} | `{run.commit}` | `{run.command}` "
            f"| {run.seconds} | {rows} | " + " | ".join(counts) + f" | {unexplained} |"
        )
    lines += ["", "s: of all rows together; those that ran side by side are added up."] if runs else []
    if any(";" in run.commit for run in runs):
        lines += [
            "",
            "Commits: of all rows; behind the semicolon of those whose cases hold that text, which were run again.",
        ]
    known = {run.backend for run in runs}
    lines += [f"\nNo results of the {backend} backend yet." for backend in BACKENDS if backend not in known]
    for group in dict.fromkeys(case.group for case in cases):
        members = [case for case in cases if case.group is group]
        lines += ["", f"## {group.title}", "", group.text]
        for run in runs:
            lines += _section(group, members, run, len(runs) > 1)
    return "\n".join(lines) + "\n"


def _left_out(cases: Sequence[Case]) -> list[str]:
    """A line for each section that is not made of every law in every shape and precision: what it is made of."""
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
    """Of one name."""
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


def _section(group: Group, cases: list[Case], run: Run, named: bool) -> list[str]:
    rows: dict[str, list[Row]] = {}
    for row in run.rows:
        rows.setdefault(row.key, []).append(row)
    lines = ["", f"On {run.backend}:" if named else "", ""] if named else [""]
    names = list(dict.fromkeys(case.name for case in cases))
    laws = list(dict.fromkeys(case.law for case in cases))
    heads = ["case", *(law.replace("_", " ") for law in laws)] if laws != ["any"] else ["field", "outcome", "values"]
    lines += ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for name in names:
        cells = []
        for law in laws:
            found = [row for case in cases if (case.name, case.law) == (name, law) for row in rows.get(case.key, [])]
            cells.append(_cell(found))
            if law == "any":
                cells.append(found[0].verdict.text.split(";")[0] if found else "not run")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    lines += _notes(cases, rows)
    return lines


def _cell(rows: list[Row]) -> str:
    """All shapes and precisions of a law: how many came out how, and the largest share of a bound that held."""
    if not rows:
        return "–"
    parts = []
    for outcome in OUTCOMES:
        count = sum(row.verdict.outcome == outcome for row in rows)
        if count:
            parts.append(_MARKS[outcome] + ("" if count == len(rows) else f" {count}/{len(rows)}"))
    held = [row.verdict.share for row in rows if row.verdict.outcome == HOLDS]
    return " ".join(parts) + (f" {max(0, *held):.0%}" if held else "")


def _notes(cases: list[Case], rows: dict[str, list[Row]]) -> list[str]:
    """What did not simply hold, grouped by why, or by what was said."""
    groups: dict[tuple[str, str], list[str]] = {}
    for case in cases:
        for row in rows.get(case.key, []):
            outcome, text = row.verdict.outcome, row.verdict.text
            if outcome == HOLDS:
                continue
            member = f"{case.name}, {case.law}, {case.shape}, {row.precision}"
            reason = case.reason(outcome, row.precision)
            if outcome == SHORT:
                member += f" ({text})"
            elif outcome not in case.expects:
                member += f" ({_first_sentence(text)})"
            if outcome in case.expects:
                reason = _without_numbers(_first_sentence(text))
            groups.setdefault((outcome, reason or "NOT EXPLAINED"), []).append(member)
    lines = [""] if groups else []
    for (outcome, text), members in groups.items():
        more = f"; and {len(members) - 2} more" if len(members) > 2 else ""
        lines.append(f"* {outcome}: {text} — {'; '.join(members[:2]).replace('_', ' ')}{more}".replace("|", r"\|"))
    return lines


def _kept(verdict: Verdict) -> str:
    """Of a fault or a warning what went wrong: in which scene, and what to do about it, is said thousands of times."""
    if verdict.outcome != CAUGHT:
        return verdict.text
    # What results have had once already, an update writes again: it must come out the same.
    missed = re.search(r"( \([^()]*, bound [^()]*\))+$", verdict.text)
    said = verdict.text[: missed.start()] if missed else verdict.text
    return _first_sentence(re.sub(r"^scene '[\w-]+' is stopped: ", "", said)) + (missed[1] if missed else "")


def _first_sentence(text: str) -> str:
    """What went wrong, without what to do about it."""
    return re.split(r"\. |; take |; give it more", text)[0]


def _without_numbers(text: str) -> str:
    """So that the same words about another scene, body or step are the same."""
    return re.sub(r"(?<![\w^])-?\d+(\.\d+)?(e[-+]?\d+)?", "…", re.sub(r"'[\w-]+'", "'…'", text))


def unexplained_rows(run: Run) -> list[Row]:
    """Those whose outcome is not what the page says of the case; also of cases that are no more."""
    cases = {case.key: case for case in all_cases()}
    return [
        row
        for row in run.rows
        if row.key not in cases or not cases[row.key].explains(row.verdict.outcome, row.precision)
    ]


def main() -> int:
    runs = [run for backend in BACKENDS if (run := Run.read(backend))]
    PAGE.write_text(page(runs))
    print(f"wrote {PAGE.relative_to(PAGE.parents[1])}")
    return int(any(unexplained_rows(run) for run in runs))


if __name__ == "__main__":
    sys.exit(main())
