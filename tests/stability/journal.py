"""The rows of a run in progress: one JSON object a line, so that a run that is stopped loses nothing.

The first line identifies daemon, device and cases. A run continues a journal with the same first line and overwrites
any other. Journals with the same first line can be merged.
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

from tensormass._shared.processes import BUILD_BIN, find_program

from . import cases
from .case import BROKEN, Verdict
from .report import Row

FOLDER = BUILD_BIN.parent / "stability"
_OURS = (__name__.partition(".")[0], "accuracy")
# Two journals can be merged if they agree in these.
_SAME = ("backend", "device", "machine", "build", "cases")


@dataclass(frozen=True)
class Entry:
    """A row and its run time [s]."""

    row: Row
    seconds: float


def build() -> str:
    """The first 12 digits of the SHA-256 of the daemon's program."""
    return hashlib.sha256(find_program("tensormassd", "TENSORMASSD").read_bytes()).hexdigest()[:12]


def cases_digest() -> str:
    """A hash of all modules that the cases use, so that changed cases run again."""
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
    """Appends rows to a file. head: what they belong to. entries: all rows, also of an earlier run with this head."""

    def __init__(self, path: Path, head: dict[str, Any], fresh: bool = False) -> None:
        self.head = head
        self.entries: dict[tuple[str, str], Entry] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not fresh:
            known, entries = read(path)
            if _same(known, head):
                self.head, self.entries = known, entries
                if head.get("long"):  # the continued run also has the long cases
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
    """Head and rows of a file; an unfinished last line is dropped."""
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
    """Tasks without a row, and tasks whose row broke, as all rows of a daemon that died do."""
    return [of for of in wanted if of not in entries or entries[of].row.verdict.outcome == BROKEN]


def merged(paths: list[Path]) -> tuple[dict[str, Any], dict[tuple[str, str], Entry]]:
    """Merges journals. If two have the same row, the later journal wins.

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
