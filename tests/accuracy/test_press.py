"""The figures of docs/decisions/trade.md on the force in the hand are those of the committed results."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from . import press

PAGE = Path(__file__).parents[2] / "docs" / "decisions" / "trade.md"


def test_the_page_has_measured_rows() -> None:
    section = PAGE.read_text().split("## The force in the hand")[1].split("\n## ")[0]
    clusters = _rows("press-cuda-selective.json")
    measured = (press.FOLDER / "press-cuda.txt").read_text() + press.table(list(clusters.values()))
    rows = [line for line in section.splitlines() if line.startswith(("| uniform", "| graded"))]
    assert len(rows) > 10
    assert all(row in measured for row in rows)
    on_cpu = _rows("press-cpu.json")
    for name, p50, p99 in (
        ("graded quadratic 1, 60 Hz, CG 0.01", "6.7 ms", "p99 12.5"),
        ("graded quadratic 1.15, 60 Hz, CG 0.01", "", "p99 16.1 ms"),
    ):
        assert p50 in section
        assert p99 in section
        assert f"p99 {on_cpu[name]['step_p99_ms']:.3g}" in p99
        assert name in press.SETTINGS
    clusters_on_cpu = _rows("press-cpu-selective.json")
    for kind, times in ((" selective", "8.7 ms a step (p99 11.8)"), ("", "5.6 (9.1)")):
        row = clusters_on_cpu[f"uniform linear{kind} 1, 60 Hz, CG 0.01"]
        assert times in section
        assert f"{row['step_p50_ms']:.1f}" in times
        assert f"{row['step_p99_ms']:.1f})" in times


def _rows(file: str) -> dict[str, Any]:
    return {row["setting"]: row for row in json.loads((press.FOLDER / file).read_text())["rows"]}


def test_a_table_shows_what_was_not_measured_as_a_dash() -> None:
    row = {"setting": "x", "elements": 1000, "step_p50_ms": 1.0, "step_p99_ms": 2.0}
    assert press.table([row]).splitlines()[-1] == "| x | 1,000 | – / – | – | – | 1 / 2 ms |"
