"""Rows of whole runs: which of them lead README, and that their figures name their fields."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import figures
import leading
import pytest
import whole_run

from tensormass._src.durations import DurationHistogram, index_of
from tensormass_tools import load_report


def histogram(*durations_s: float) -> dict[str, Any]:
    of_all = DurationHistogram()
    for duration_s in durations_s:
        counts = of_all.counts.copy()
        counts[index_of(round(1e9 * duration_s))] += 1
        of_all = DurationHistogram(counts, max(of_all.max_s, duration_s))
    return load_report.with_buckets(of_all)


def report(*missed: int) -> dict[str, Any]:
    """A load test's report of scenes that made 2000 steps each."""
    summary = load_report.summary(DurationHistogram())
    scenes = [
        {
            "steps": 2000,
            "missed_deadlines": of,
            "missed_fraction": of / 2000,
            "target_rate_hz": 960.0,
            "step_times": histogram(*[1e-3] * 99, 5e-3 * (index + 1)),
        }
        for index, of in enumerate(missed)
    ]
    parts = dict.fromkeys(whole_run._KEPT, summary)
    return {
        **parts,
        "pose_to_force": {"count": 3, "p50_s": 1.376e-3, "p99_s": 2.556e-3, "p999_s": 3e-3, "max_s": 4e-3},
        "scenes": scenes,
        "haptic": [{"max_force_n": 0.9}, {"max_force_n": 1.2}],
        "seconds": 2.08,
        "errors": [],
        "cpu_count": 16,
        "server": {"backend": "cuda", "device": "NVIDIA H200"},
    }


def row(*missed: int, **other: object) -> dict[str, Any]:
    head = {"case": "whole run: demo", "elements": 126250, "dt_ms": 1.0417, "commit": "abc"}
    return {**head, **whole_run.row_of(report(*missed)), **other}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    return tmp_path


def write(results: Path, *rows: dict[str, Any]) -> None:
    (results / leading.WHOLE_RUN).write_text("".join(f"{json.dumps(of)}\n" for of in rows))


def test_a_row_has_all_steps_and_deadlines_of_all_scenes() -> None:
    of = row(3, 1)
    assert (of["scenes"], of["steps"], of["missed_deadlines"], of["missed_per_million"]) == (2, 4000, 4, 1000.0)
    assert of["kept_least"] == 1 - 3 / 2000
    assert of["step_ms_median"] == pytest.approx(1, rel=1 / 32)
    assert of["step_ms_p999"] == of["step_ms_max"] == pytest.approx(10, rel=1 / 32), "the slower scene's"
    assert of["pose_to_force"]["p99_ms"] == 2.556
    assert of["largest_force_n"] == 1.2


def test_the_scene_is_that_of_run_unless_asked() -> None:
    args = argparse.Namespace(backend="cuda", scene="demo", resolution=None, rate=None)
    assert whole_run.setting_of(args) == {"resolution": 2.1, "dt_s": 1 / 960}
    args = argparse.Namespace(backend="cpu", scene="demo", resolution=0.8, rate=50)
    assert whole_run.setting_of(args) == {"resolution": 0.8, "dt_s": 1 / 50}


def test_only_the_last_of_the_longest_runs_lead(results: Path) -> None:
    long = {"seconds": 521.0, "steps": 500_000}
    old = row(0, commit="old", **long)
    two = [row(of, **long, missed_deadlines=of) for of in (5, 9)]
    write(results, old, *two, row(0), row(0, 0, **long), row(0, **{**long, "errors": ["a client ended"]}))
    assert leading.long_runs(results, 2) == two
    assert leading.long_runs(results, 1) == two[1:]


def test_the_most_scenes_are_those_that_all_keep_their_deadlines(results: Path) -> None:
    kept, lost = row(0, 1), row(0, 0, 20)
    write(results, row(0), kept, lost)
    assert leading.most_scenes(results) == [kept]
    write(results, row(0))
    assert leading.most_scenes(results) == [], "a single scene says nothing about several"


def test_rows_of_readme_have_figures_of_the_file(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leading, "README", results / "README.md")
    write(results, row(3, **{"seconds": 521.0}), row(0, 1))
    lines = [line for line in leading.readme_rows(results) if "whole-run" in line]
    assert len(lines) == 2
    for line in lines:
        assert figures.problems(results / "README.md", line) == []
        assert figures.unnamed_numbers(line.split(" | ")[-1]) == []
    assert "[2.56 ms]" in lines[0]
    assert "[99.95 %]" in lines[1]


@pytest.mark.parametrize(
    ("share", "text"), [(0.99999, "99.999 %"), (0.9995, "99.95 %"), (0.999283, "99.928 %"), (1.0, "100.000 %")]
)
def test_a_kept_share_is_not_rounded_up(share: float, text: str) -> None:
    assert leading.percent(share, floor=True) == text
