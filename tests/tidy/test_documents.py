"""The documents that users open first begin with what they look for. Tests beside the results bound the other pages."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCREEN = 40  # lines


def lines_of(name: str) -> list[str]:
    return (ROOT / name).read_text("utf-8").splitlines()


def table_after(lines: list[str], mark: str) -> list[str]:
    """Returns the rows of the first table after a mark, without its heading."""
    below = itertools.dropwhile(lambda line: not line.startswith("|"), lines[lines.index(mark) :])
    return list(itertools.takewhile(lambda line: line.startswith("|"), below))[2:]


def test_the_readme_opens_with_a_picture_and_a_few_rows_of_figures() -> None:
    lines = lines_of("README.md")
    picture = next(number for number, line in enumerate(lines) if line.startswith("!["))
    assert picture < SCREEN
    assert 5 <= len(table_after(lines[:SCREEN], "<!-- summary: begin -->")) <= 10


def test_choosing_opens_with_a_decision_table_by_use() -> None:
    lines = lines_of("docs/choosing.md")[:SCREEN]
    table = table_after(lines, "<!-- made: uses -->")
    assert lines.index(table[-1]) < SCREEN / 2
    uses = {row.split("|")[1].split(",")[0].strip() for row in table}
    assert uses == {"trainer", "free motion", "analysis"}
    assert {"trainer, 1 kHz", "trainer, 60 Hz"} <= {row.split("|")[1].strip() for row in table}


def test_architecture_opens_with_a_picture_of_threads_and_mailboxes() -> None:
    lines = lines_of("docs/architecture.md")[:SCREEN]
    assert any("mailboxes" in line and line.startswith("    ") for line in lines)


def test_tests_that_documents_name_exist() -> None:
    """A name may end in an ellipsis."""
    tests = "\n".join(path.read_text("utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for page in (ROOT / "docs").rglob("*.md"):
        for name, rest in re.findall(r"`(test_\w+)(…?)`", page.read_text("utf-8")):
            assert re.search(rf"def {name}{'' if rest else '[(]'}", tests), f"{page.name}: there is no {name}{rest}"


def test_documents_are_pages_decisions_and_pictures() -> None:
    """Logs and histories are data beside the tests that made them. `site` makes a site of the pages."""
    folder = ROOT / "docs"
    assert {path.name for path in folder.iterdir() if path.is_dir()} == {"decisions", "images", "site"}
    files = [path for path in folder.rglob("*") if path.is_file() and folder / "site" not in path.parents]
    assert {path.suffix for path in files} <= {".jpg", ".md", ".png", ".svg", ".webp"}
