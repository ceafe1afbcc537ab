"""The rows of a run while it goes on: one JSON object a line, so that a run that was stopped loses nothing.

The first line says what the rows belong to: daemon, device, and the cases as they stand. A run goes on with a journal
that says the same and starts anew beside any other; journals that say the same can be put together.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from tensormass._src.processes import BUILD_BIN, find_program

from . import cases
from .case import BROKEN, Verdict
from .report import Row

FOLDER = BUILD_BIN.parent / "stability"
_OURS = (__name__.partition(".")[0], "accuracy")
# What two journals have in common whose rows go together.
_SAME = ("backend", "device", "machine", "build", "cases")


@dataclass(frozen=True)
class Entry:
    """A row, and how long it took."""

    row: Row
    seconds: float


def build() -> str:
    """The beginning of the SHA-256 of the daemon's program."""
    return hashlib.sha256(find_program("tensormassd", "TENSORMASSD").read_bytes()).hexdigest()[:12]


def cases_digest() -> str:
    """Of the modules that the cases are made of: a changed case is run anew."""
    digest = hashlib.sha256()
    seen, waiting = set[str](), [cases.__name__]
    while waiting:
        name = waiting.pop()
        if name in seen or name.partition(".")[0] not in _OURS:
            continue
        seen.add(name)
        module = sys.modules[name]
        waiting += [
            of.__name__ if inspect.ismodule(of) else getattr(of, "__module__", "") or "" for of in vars(module).values()
        ]
    for name in sorted(seen):
        digest.update(Path(sys.modules[name].__file__ or "").read_bytes())
    return digest.hexdigest()[:12]


class Journal:
    """head: what its rows belong to; what was written before under the same is in `entries`."""

    def __init__(self, path: Path, head: dict[str, Any], fresh: bool = False) -> None:
        self.head = head
        self.entries: dict[tuple[str, str], Entry] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not fresh:
            known, entries = read(path)
            if _same(known, head):
                self.head, self.entries = known, entries
                if head.get("long"):  # what goes on has more to do
                    self.head |= {"long": True, "command": head["command"]}
        self._file: TextIO = path.open("w", encoding="utf-8")
        self._line(self.head)
        for entry in self.entries.values():
            self._entry(entry)

    def add(self, entry: Entry) -> None:
        self.entries[entry.row.task] = entry
        self._entry(entry)

    def close(self) -> None:
        self._file.close()

    def _entry(self, entry: Entry) -> None:
        verdict = entry.row.verdict
        share = verdict.share if math.isfinite(verdict.share) else str(verdict.share)
        of = [entry.row.key, entry.row.precision, verdict.outcome, share, verdict.text, round(entry.seconds, 3)]
        self._line(of)

    def _line(self, value: object) -> None:
        self._file.write(json.dumps(value, ensure_ascii=False) + "\n")
        self._file.flush()


def read(path: Path) -> tuple[dict[str, Any], dict[tuple[str, str], Entry]]:
    """Head and rows; a last line that was not finished is left out."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    if not lines or not lines[0].endswith("\n"):
        return {}, {}
    entries = {}
    for line in lines[1:]:
        if not line.endswith("\n"):
            break
        key, precision, outcome, share, text, seconds = json.loads(line)
        entries[key, precision] = Entry(Row(key, precision, Verdict(outcome, float(share), text)), seconds)
    return json.loads(lines[0]), entries


def missing(wanted: Sequence[tuple[str, str]], entries: Mapping[tuple[str, str], Entry]) -> list[tuple[str, str]]:
    """What is still to be run: also what broke, as every row of a daemon that is gone does."""
    return [of for of in wanted if of not in entries or entries[of].row.verdict.outcome == BROKEN]


def merged(paths: list[Path]) -> tuple[dict[str, Any], dict[tuple[str, str], Entry]]:
    """Of several journals; of a row that two have, the later one's.

    Raises:
        ValueError: they belong to different daemons, devices or cases.
    """
    head, entries = read(paths[0])
    for path in paths[1:]:
        other, more = read(path)
        if not _same(head, other):
            differ = ", ".join(f"{name} {head.get(name)} and {other.get(name)}" for name in _differ(head, other))
            raise ValueError(f"{path} does not go with {paths[0]}: {differ}")
        entries |= more
    return head, entries


def _differ(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    return [name for name in _SAME if a.get(name) != b.get(name)]


def _same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return bool(a) and not _differ(a, b)
