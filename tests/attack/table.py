"""`make attack`: every attack, one after the other, and a table of what each one did before and does now.

    python tests/attack/table.py [arguments of pytest]

The marker `attack(fault, before)` of a test says what a stranger does, and what that did to the server that was first
attacked so. A test may measure what it does now, by `record_property("now", "+3 MiB")`.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest


class Table:
    """Gathers the rows while pytest runs. Tests of the same fault share a row: one that fails fails it."""

    def __init__(self) -> None:
        self._said: dict[str, tuple[str, str]] = {}
        self._now: dict[tuple[str, str], list[tuple[str, str]]] = {}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        for item in items:
            marker = item.get_closest_marker("attack")
            fault = item.name.split("[")[0].removeprefix("test_").replace("_", " ")
            self._said[item.nodeid] = (marker.args[0], marker.args[1]) if marker is not None else (fault, "")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        # A fixture measures after the call.
        if report.when == "teardown" or not report.passed:
            measured = str(dict(report.user_properties).get("now", ""))
            self._now.setdefault(self._said[report.nodeid], []).append((report.outcome, measured))

    def text(self) -> str:
        rows = [("fault", "before", "now")]
        for (fault, before), outcomes in self._now.items():
            worst = next(word for word in ("failed", "skipped", "passed") if word in dict(outcomes))
            held = {"passed": "held", "skipped": "skipped", "failed": "FAILED"}[worst]
            rows.append((fault, before, "; ".join([held, *(measured for _, measured in outcomes if measured)])))
        widths = [max(len(row[i]) for row in rows) for i in range(3)]
        lines = [
            "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
        ]
        lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
        return "\n".join(lines)


def main(arguments: list[str]) -> int:
    table = Table()
    os.environ["TENSORMASS_ATTACK"] = "all"  # tests that otherwise take samples
    status = pytest.main(["-q", "-rfEs", str(Path(__file__).parent), *arguments], plugins=[table])
    print(table.text())
    return int(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
