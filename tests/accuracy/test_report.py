"""The page, the CSV files and the tables of the advice are those that the committed results make."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import pytest

from . import advice, report, trade_tables
from .cases import all_cases
from .report import BACKENDS, Row, Run
from .tables import Cell, csv_text

CASES = all_cases()


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    return [run for backend in BACKENDS if (run := Run.read(backend))]


def test_committed_files_are_those_the_results_make(runs: list[Run]) -> None:
    for path, text in report.outputs(runs, CASES).items():
        assert path.read_text() == text, f"{path.name} is out of date: run python -m accuracy.report in tests/"


def test_a_figure_changed_by_hand_is_noticed(runs: list[Run]) -> None:
    """Other results give another page and other CSV files, so the comparison above covers their figures."""
    changed = [replace(run, rows=[replace(row, error=1.1 * row.error) for row in run.rows]) for run in runs]
    before, after = (report.outputs(of, CASES) for of in (runs, changed))
    names = {path.name for path in before if before[path] != after[path]}
    assert names == {report.PAGE.name, *(f"{run.backend}.csv" for run in runs)}


def test_the_page_fits_on_two_screens() -> None:
    text = report.PAGE.read_text()
    assert len(re.findall(r"[^\s|]+", text)) <= 900
    assert text.count("\n") <= 100


def test_every_row_is_in_a_csv_file(runs: list[Run]) -> None:
    for run in runs:
        rows = list(csv.DictReader(io.StringIO((report.FOLDER / f"{run.backend}.csv").read_text())))
        assert len(rows) == len(run.rows)
        errors = {(row.precision, f"{row.error:.6g}") for row in run.rows}
        assert {(row["precision"], row["error"]) for row in rows} == errors


def test_every_setting_of_a_front_is_in_a_csv_file() -> None:
    measured = [of for trade in trade_tables.read(BACKENDS) for of in trade.measurements]
    assert len((report.FOLDER / "trade.csv").read_text().splitlines()) == 1 + len(measured)


def complete(backend: str, date: str = "2026-01-02", commit: str = "aaaaaaa") -> Run:
    rows = [Row(case.key, precision, 1, 1, 0, case.bounds[precision]) for case in CASES for precision in case.bounds]
    return Run(backend, "device", "machine", commit, "command", date, 1, rows)


def test_the_page_names_missing_rows_and_older_commits() -> None:
    cpu = complete("cpu")
    whole = report.page([cpu, complete("cuda")], CASES)
    assert "lacks" not in whole
    assert "another commit" not in whole
    old = complete("cuda", date="2026-01-01", commit="bbbbbbb")
    missing = old.rows[-1]
    page = report.page([cpu, replace(old, rows=old.rows[:-1])], CASES)
    assert "**The cuda rows are of another commit (`bbbbbbb`, 2026-01-01) than the cpu rows (`aaaaaaa`" in page
    assert f"**The cuda run lacks 1 of its rows: {missing.key} ({missing.precision}).**" in page
    assert "There are no results of the cuda backend" in report.page([cpu], CASES)


def test_the_page_shows_failures_first() -> None:
    run = complete("cpu")
    bad = replace(run.rows[0], error=3 * (run.rows[0].bound or 0))
    broken = replace(run.rows[-1], error=float("inf"), failure="RuntimeError: gone")
    page = report.page([replace(run, rows=[bad, *run.rows[1:-1], broken])], CASES)
    assert f"| {len(run.rows)} of {len(run.rows)} | 2 |" in page
    worst = page.split("nearest to their bounds")[1]
    assert worst.index("**FAILED**") < worst.index("300%")
    assert page.split("## The")[0].count("**FAILED**") == 2


def test_advice_refuses_a_setting_without_results() -> None:
    (demo, *_) = trade_tables.read(BACKENDS)
    with pytest.raises(advice.NotMeasuredError, match="demo on cpu: resolution 7 has no results"):
        advice.find(demo, {"resolution": 7.0})


def test_the_advice_is_short_and_opens_with_its_table() -> None:
    text = advice.PAGE.read_text()
    assert 0 < text.index("<!-- made: uses -->") < text.index("\n## ")
    prose = re.sub(r"<!-- made: \w+ -->.*?<!-- end -->", "", text, flags=re.DOTALL)
    assert len(prose.split()) <= 650
    assert text.count("\n") <= 80, "two screens"


def test_csv_keeps_numbers_plain() -> None:
    rows: list[dict[str, Cell]] = [
        {"name": "a, b", "value": 1 / 3, "own": True},
        {"name": "c", "value": float("nan"), "own": None},
    ]
    assert csv_text(rows) == 'name,value,own\n"a, b",0.333333,yes\nc,,\n'


def test_links_of_the_pages_lead_somewhere() -> None:
    for page in (report.PAGE, advice.PAGE, advice.DETAILS):
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / Path(target)).exists(), target
