"""What tests of metrics share: the text of the baseline, the names in a text, and the programs of Prometheus."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tensormass_gateway import metrics

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
GATEWAY = metrics.Counts(
    daemon_up=True,
    replaced_frames={0: 3, 1: 0},
    max_browsers=16,
    refused_connections=1,
    closed_for_errors=2,
    malformed_messages=0,
)


def baseline() -> str:
    """The text that metrics_tests holds the daemon against, and the gateway's."""
    return (ROOT / "tests/metrics/exposition.txt").read_text() + metrics.to_text(GATEWAY)


@dataclass
class Family:
    kind: str
    labels: dict[str, set[str]] = field(default_factory=dict)
    """Values by label; a histogram's `le` included."""


def families(text: str) -> dict[str, Family]:
    """Reads a text as a scraper does."""
    found: dict[str, Family] = {}
    for line in text.splitlines():
        if kind := re.match(r"# TYPE (\w+) (\w+)$", line):
            found[kind[1]] = Family(kind[2])
        elif not line.startswith("#"):
            sample = re.match(r"(\w+)(?:\{(.*)\})? (\S+)$", line)
            assert sample, line
            family = found[next(reversed(found))]
            for name, value in re.findall(r'(\w+)="((?:[^"\\]|\\.)*)"', sample[2] or ""):
                family.labels.setdefault(name, set()).add(value)
    return found


def used_names(text: str) -> Iterator[str]:
    """The families that an expression, a rule or a dashboard names."""
    for name in re.findall(r"\btensormass_\w+", text):
        yield re.sub(r"_(bucket|sum|count)$", "", name)


def program(name: str) -> str:
    """Finds a program of Prometheus, or skips the test. `make setup-test` unpacks it."""
    found = shutil.which(name) or shutil.which(name, path=ROOT / ".venv/bin")
    if found is None:
        pytest.skip(f"{name} is missing: make setup-test")
    return found
