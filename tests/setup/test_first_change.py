"""The first change of CONTRIBUTING.md fits the sources, and the command that times it notices when it does not."""

from __future__ import annotations

import subprocess
from pathlib import Path

import first_change
import pytest
from first_change import Block, FirstChangeError, blocks, follow

ROOT = Path(__file__).resolve().parents[2]
CHANGE = "--- a/{0}\n+++ b/{0}\n@@ -1 +1 @@\n-old\n+new\n"


def page() -> list[Block]:
    return blocks((ROOT / first_change.PAGE).read_text("utf-8"))


def test_the_changes_of_the_page_fit_the_sources() -> None:
    changes = "".join(block.text for block in page() if block.kind == "diff")
    result = subprocess.run(
        ["git", "apply", "--check", "-"], cwd=ROOT, input=changes, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, f"renew the change in {first_change.PAGE}:\n{result.stderr}"


def test_the_page_runs_the_tests_of_one_folder() -> None:
    assert {block.text.strip() for block in page() if block.kind == "sh"} == {"make test-folder FOLDER=world"}


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    for name in ("wanted", "code"):
        (tmp_path / name).write_text("old\n")
    return tmp_path


def steps(command: str) -> list[Block]:
    run = Block("sh", command)
    return [run, Block("diff", CHANGE.format("wanted")), run, Block("diff", CHANGE.format("code")), run]


def test_each_step_is_timed(clone: Path) -> None:
    records = follow(steps("cmp wanted code"), clone, 60)
    assert [record["what"] for record in records][:2] == ["cmp wanted code", "change of wanted"]
    assert len(records) == 5
    assert (clone / "code").read_text() == "new\n"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("true", "step 3: `true` passed, though its test should fail"),
        ("false", "step 1: `false` failed"),
        ("sleep 1000", "the time of --seconds was up"),
    ],
)
def test_an_end_that_the_page_does_not_say_is_an_error(command: str, message: str, clone: Path) -> None:
    with pytest.raises(FirstChangeError, match=message):
        follow(steps(command), clone, 0.2 if "sleep" in command else 60)


def test_a_change_that_does_not_fit_is_an_error(clone: Path) -> None:
    (clone / "wanted").write_text("something else\n")
    with pytest.raises(FirstChangeError, match="no longer fits"):
        follow(steps("cmp wanted code || true"), clone, 60)


def test_a_page_without_the_steps_is_an_error() -> None:
    with pytest.raises(FirstChangeError, match="must have a command"):
        blocks("# Contributing\n\n## A first change\n\nNothing.\n")
