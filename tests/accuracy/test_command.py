"""How the command runs its cases, without a daemon."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from . import __main__ as command
from .case import Case, Group, Outcome
from .engine import Engine


@contextmanager
def launch(**_: object) -> Iterator[SimpleNamespace]:
    yield SimpleNamespace(version=lambda: SimpleNamespace(device="a device"))


@pytest.mark.parametrize("together", [True, False])
def test_precisions_run_at_the_same_time_only_if_asked(monkeypatch: pytest.MonkeyPatch, together: bool) -> None:
    monkeypatch.setattr("tensormass.launch", launch)
    meeting = threading.Barrier(2)

    def wait(engine: Engine) -> Outcome:
        meeting.wait(timeout=5 if together else 0.1)
        return Outcome(1, 1, 0)

    case = Case(Group("g", "G", ""), "shape", "law", "case", "", "", {"double": 1.0, "float": 1.0}, wait)
    device, rows = command.measure([case], ["double", "float"], "cuda", together=together)
    assert device == "a device"
    assert [row.precision for row in rows] == ["double", "float"]
    assert [row.passed for row in rows] == [together] * 2


def test_a_case_that_raises_is_a_failed_row() -> None:
    def fall(_: Engine) -> Outcome:
        raise RuntimeError("gone")

    case = Case(Group("g", "G", ""), "shape", "law", "case", "", "", {"double": 1.0}, fall)
    row = command.run(case, SimpleNamespace(precision="double"))  # type: ignore[arg-type]
    assert (row.failure, row.passed) == ("RuntimeError: gone", False)
