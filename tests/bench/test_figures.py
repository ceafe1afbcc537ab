"""Figures in documents name their field, and the field has their number."""

from __future__ import annotations

import json
from pathlib import Path

import figures
import leading
import pytest

PAGES = [leading.README, *sorted((leading.REPOSITORY / "docs").rglob("*.md"))]


def test_every_figure_is_the_one_of_its_field() -> None:
    named = 0
    for page in PAGES:
        text = page.read_text()
        assert figures.problems(page, text) == []
        named += len(figures._LINK.findall(text))
    assert named > 15, "README alone has more"


def test_every_number_of_the_first_results_names_its_field() -> None:
    summary = leading.README.read_text().split("<!-- summary: begin -->")[1].split("<!-- summary: end -->")[0]
    rows = [line for line in summary.splitlines() if line.startswith("|")][2:]
    assert rows
    for row in rows:
        assert figures.unnamed_numbers(row.split(" | ")[-1]) == [], row


@pytest.fixture
def page(tmp_path: Path) -> Path:
    old, new = ({"case": "a; b", "steps": 1000, "of": {"p99_ms": 0.77}, "missed": missed} for missed in (9, 4))
    (tmp_path / "rows.jsonl").write_text(f"{json.dumps(old)}\n{json.dumps(new)}\n")
    (tmp_path / "whole.json").write_text(json.dumps({"of": {"p50_s": 0.02202}, "name": "x", "good": True}))
    return tmp_path / "page.md"


@pytest.mark.parametrize(
    ("shown", "file", "title"),
    [
        ("0.77 ms", "rows.jsonl", "of.p99_ms where steps=1000"),
        ("0.8 ms", "rows.jsonl", "of.p99_ms where steps=1000"),
        ("770 µs", "rows.jsonl", "of.p99_ms where steps=1000"),
        ("1,000", "rows.jsonl", "steps where missed=9"),
        ("4", "rows.jsonl", "missed where steps=1000"),  # the last row counts
        ("0.4 %", "rows.jsonl", "missed / steps where steps=1000"),
        ("22 ms", "whole.json", "of.p50_s"),
    ],
)
def test_a_right_figure(page: Path, shown: str, file: str, title: str) -> None:
    assert figures.problems(page, f'step [{shown}]({file} "{title}") long') == []


@pytest.mark.parametrize(
    ("shown", "file", "title", "said"),
    [
        ("0.78 ms", "rows.jsonl", "of.p99_ms where steps=1000", "has 0.00077"),
        ("0.77 s", "rows.jsonl", "of.p99_ms where steps=1000", "has 0.00077"),
        ("0.770 µs", "rows.jsonl", "of.p99_ms where steps=1000", "has 0.00077"),
        ("1,001", "rows.jsonl", "steps where missed=9", "has 1000"),
        ("4", "rows.jsonl", "missed where steps=2000", "no such row"),
        ("4", "rows.jsonl", "mist where steps=1000", "mist"),
        ("1", "whole.json", "good", "not a number"),
        ("some", "whole.json", "of.p50_s", "has 0.02202"),
        ("4", "gone.jsonl", "missed where steps=1000", "No such file"),
    ],
)
def test_a_wrong_figure_is_found(page: Path, shown: str, file: str, title: str, said: str) -> None:
    (problem,) = figures.problems(page, f'[{shown}]({file} "{title}")')
    assert said in problem


def test_a_figure_is_linked_from_its_page(tmp_path: Path) -> None:
    page, file = tmp_path / "docs" / "page.md", tmp_path / "results" / "rows.jsonl"
    link = figures.figure("0.77 ms", page, file, "step_ms_p99", case="demo", scenes=2)
    assert link == '[0.77 ms](../results/rows.jsonl "step_ms_p99 where case=demo; scenes=2")'


def test_numbers_without_a_field_are_found() -> None:
    assert figures.unnamed_numbers('[0.7 ms](r.jsonl "p50_ms") (p99 [0.8 ms](r.jsonl "p99_ms")) on an H200') == []
    assert figures.unnamed_numbers('[0.7 ms](r.jsonl "p50_ms") (p99 0.8 ms), [2](r.jsonl)') == ["0.8", "2"]
