"""The files that git tracks keep the rules of rules.py and writing.py. tests/lint.sh checks format and types."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

import pytest
import rules
import writing

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def tracked() -> list[PurePosixPath]:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: which files belong to the repository is not known")
    # The checkout may belong to another user, as one that is mounted into a container.
    listing = ["git", "-c", "safe.directory=*", "ls-files", "-z"]
    names = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [PurePosixPath(name) for name in names.split("\0") if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def texts(tracked: list[PurePosixPath]) -> dict[PurePosixPath, str]:
    found = {}
    for path in tracked:
        content = (ROOT / path).read_bytes()
        if b"\0" not in content and "third_party" not in path.parts:  # others write by their own rules
            found[path] = content.decode()
    return found


def check(texts: dict[PurePosixPath, str], rule: Callable[[PurePosixPath, str], list[str]]) -> None:
    own = PurePosixPath("tests/tidy")  # spells out what it refuses
    problems = [line for path, text in texts.items() if own not in path.parents for line in rule(path, text)]
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize(
    "rule",
    [
        rules.bare_marks,
        rules.full_option_names,
        rules.machine_paths,
        rules.private_imports,
        rules.source_length,
        writing.writing,
    ],
    ids=lambda rule: rule.__name__,
)
def test_every_file_keeps(rule: Callable[[PurePosixPath, str], list[str]], texts: dict[PurePosixPath, str]) -> None:
    check(texts, rule)


def test_include_direction(texts: dict[PurePosixPath, str]) -> None:
    folders = rules.server_folders(texts[PurePosixPath("server/CMakeLists.txt")])
    check(texts, partial(rules.include_direction, folders=folders))


def test_tests_mirror_the_source(texts: dict[PurePosixPath, str], tracked: list[PurePosixPath]) -> None:
    folders = rules.server_folders(texts[PurePosixPath("server/CMakeLists.txt")])
    assert not (problems := rules.untested_folders(tracked, folders)), "\n".join(problems)


def test_links_lead_somewhere(texts: dict[PurePosixPath, str], tracked: list[PurePosixPath]) -> None:
    known = set(tracked) | {parent for path in tracked for parent in path.parents}
    check(texts, partial(rules.dead_links, exists=known.__contains__))


def test_top_level(tracked: list[PurePosixPath]) -> None:
    assert not (problems := rules.top_level(tracked)), "\n".join(problems)


def test_no_dead_sources(texts: dict[PurePosixPath, str]) -> None:
    native = {
        path: text for path, text in texts.items() if path.suffix in rules.NATIVE or path.name == "CMakeLists.txt"
    }
    assert not (problems := rules.orphans(native)), "\n".join(problems)


def test_no_large_files(tracked: list[PurePosixPath]) -> None:
    large = {str(path): size for path in tracked if (size := (ROOT / path).stat().st_size) > rules.MAX_FILE_BYTES}
    assert not large, f"more than {rules.MAX_FILE_BYTES} bytes; make it when it is needed instead: {large}"
