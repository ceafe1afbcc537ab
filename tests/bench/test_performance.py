"""docs/performance.md, README.md and results/steps.csv agree with the results."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path

import performance
import pytest


def test_files_are_those_of_the_results() -> None:
    for path, text in performance.files().items():
        assert path.read_text() == text, f"{path.name}: run `python tests/bench/performance.py`"


def test_every_target_of_the_results_is_in_the_table() -> None:
    lines = list(performance.targets())
    found = performance.newest("nvidia-h200-targets.jsonl").values()
    for row in found:
        (line,) = (line for line in lines if line.startswith(f"| {performance._case_words(row['case'])} |"))
        assert f"{row['step_ms_median']:.3g} ({row['step_ms_p99']:.3g}) ms" in line
        if row["target_met"] is not None:
            assert line.endswith("| **met** |" if row["target_met"] else "| missed |")


def test_a_missed_target_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in performance.RESULTS.glob("*.jsonl"):
        (tmp_path / path.name).write_text(path.read_text())
    monkeypatch.setattr(performance, "RESULTS", tmp_path)
    slow = performance.newest("nvidia-h200-targets.jsonl")["beam 307200 StVK"]
    slow |= {"step_ms_median": 0.3, "cg_iteration_us": 3.0, "bytes_per_element": 260.0, "target_met": False}
    with (tmp_path / "nvidia-h200-targets.jsonl").open("a") as file:
        file.write(json.dumps(slow) + "\n")  # a later row takes the place of an earlier one
    lines = [line for line in performance.targets() if "307,200" in line and "Hooke" not in line]
    assert len(lines) == 3
    assert all(line.endswith("| missed |") for line in lines)


def test_no_floor_is_far_below_the_step() -> None:
    for path in performance.RESULTS.glob("nvidia-h200-*.jsonl"):
        for row in performance.newest(path.name).values():
            if row.get("floor_ms") and row["elements"] > 2e6 and row["cg_iterations"] >= 30:  # streams its matrix
                assert 1 <= row["step_ms_median"] / row["floor_ms"] < 2, f"{path.name}: {row['case']}"


def test_only_a_run_without_misses_keeps_all_deadlines() -> None:
    assert performance._percent([0.9988, 0.999966]) == "99.88 to 99.997 %"
    assert performance._percent([1.0]) == "100.000 %"


def test_the_csv_has_every_row() -> None:
    lines = list(csv.DictReader(io.StringIO(performance.table())))
    assert len(lines) == sum(len(performance.rows(path.name)) for path in performance.RESULTS.glob("*.jsonl"))
    name = "nvidia-h200-targets.jsonl"
    medians = [float(line["step_ms_median"]) for line in lines if line["file"] == name]
    assert medians == [row["step_ms_median"] for row in performance.rows(name)]


def test_the_first_look_says_what_was_missed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(performance, "RESULTS", tmp_path)
    assert next(iter(performance.first_look())).startswith("Not measured yet: ")
    row = {
        "case": "first look: a page",
        "steps": 3600,
        "missed_deadlines": 90,
        "step_ms_median": 4.25,
        "step_ms_p99": 9.0,
        "drawn_hz": 16.5,
        "target_missed": 0.02,
        "target_met": False,
        "device": "two cores",
        "commit": "abc",
        "command": "c",
    }
    alone = {name: of for name, of in row.items() if name not in ("drawn_hz", "target_missed", "target_met")}
    rows = [row, alone | {"case": "first look: alone"}]
    (tmp_path / performance.FIRST_LOOK).write_text("".join(json.dumps(of) + "\n" for of in rows))
    lines = list(performance.first_look())
    assert "| a page | 90 of 3,600: 2.50 % | 2 %, missed | 4.2 / 9.0 ms | 16.5 |" in lines
    assert "| alone | 90 of 3,600: 2.50 % |  | 4.2 / 9.0 ms |  |" in lines
    assert lines[-1] == "two cores, commit `abc`: `c`."


def test_marks_must_be_there() -> None:
    assert performance.filled("a\n<!-- t: begin -->\nold\n<!-- t: end -->\nb", {"t": "new"}) == (
        "a\n<!-- t: begin -->\n\nnew\n\n<!-- t: end -->\nb"
    )
    with pytest.raises(ValueError, match="must stand once"):
        performance.filled("a", {"t": "new"})


def test_pages_fit_on_two_screens() -> None:
    for path in performance.TABLES:
        shown = re.sub(r"\]\([^)]*\)", "]", path.read_text())  # nobody reads the targets of links
        assert len(shown.replace("|", " ").split()) <= 1000, path.name
