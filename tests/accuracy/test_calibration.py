"""Error bars of references hold: in the committed results, and in two of the cases against a daemon."""

from __future__ import annotations

import csv
import io
import statistics
from dataclasses import replace
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes

from . import calibration
from .calibration import CASES, Run


def is_built() -> bool:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError:
        return False
    return True


def test_every_committed_error_bar_contains_the_distance() -> None:
    rows = list(csv.DictReader(io.StringIO((calibration.FOLDER / "calibration.csv").read_text())))
    assert {row["case"] for row in rows} == {case.name for case in CASES}
    assert {row["case"] for row in rows if row["quantity"] == "force"} == {case.name for case in CASES if case.press}
    for row in rows:
        assert 0 < float(row["distance"]) <= float(row["bar"]), row
    assert statistics.median(float(row["ratio"]) for row in rows) <= calibration.MOST_PESSIMISTIC


def test_an_error_bar_that_is_too_small_is_marked() -> None:
    run = Run.read()
    small = replace(run.rows[0], bar=0.5 * run.rows[0].distance)
    assert calibration.rows(replace(run, rows=[small]))[0]["holds"] is False
    assert calibration.table(replace(run, rows=[small]))[2].endswith("| **0.5** |")


def test_the_cases_differ_in_what_matters() -> None:
    assert len(CASES) == 10
    assert {case.discretization for case in CASES} == {calibration.HEXAHEDRA, calibration.QUADRATIC}
    solvers = [case.scene.get("solver", {}).get("integrator") for case in CASES]
    assert {"quasi_static", None} == set(solvers)
    laws = [case.scene["bodies"][0]["law"] for case in CASES]
    assert len({kind for law in laws for kind in law}) >= 4
    assert {of["poisson_ratio"] for law in laws for of in law.values()} == {0.3, 0.45, 0.49}


@pytest.mark.skipif(not is_built(), reason="tensormassd is not built")
@pytest.mark.parametrize("case", [case for case in CASES if case.quick], ids=lambda case: case.name)
def test_an_error_bar_contains_the_distance(case: calibration.Case, tmp_path: Path) -> None:
    with calibration.server() as server:
        rows = calibration.run(case, server, tmp_path)
    committed = {row.quantity: row for row in Run.read().rows if row.case == case.name}
    for row in rows:
        assert row.distance <= row.bar <= calibration.MOST_PESSIMISTIC * row.distance
        assert row.bar == pytest.approx(committed[row.quantity].bar, rel=0.01)
        assert row.distance == pytest.approx(committed[row.quantity].distance, rel=0.01)
