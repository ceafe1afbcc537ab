"""Some rows of `python -m stability.contact_kinds`: each scheme, method and situation at 60 Hz, with shapes in turn."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

import tensormass as tm
from tensormass._shared import processes

from . import contact_kinds
from .contact_kinds import Case


def chosen() -> Iterator[Case]:
    """One shape for each situation, scheme and method."""
    own = [case for case in contact_kinds.cases() if case.rate_hz == 60]
    order = lambda case: (case.situation, case.scheme, case.method)  # noqa: E731
    for turn, (_, group) in enumerate(itertools.groupby(sorted(own, key=order), order)):
        shapes = list(group)
        yield shapes[turn % len(shapes)]


def test_every_situation_holds_with_every_scheme() -> None:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    cases = list(chosen())
    assert {case.scheme for case in cases} == set(contact_kinds.SCHEMES)
    assert {case.situation for case in cases} == {case.situation for case in contact_kinds.cases()}
    off = [row for row in contact_kinds.run_cases("cpu", cases) if row.verdict != "holds"]
    assert not off, "\n".join(map(str, off))


def test_every_row_is_made_once() -> None:
    cases = list(contact_kinds.cases())
    assert len(set(cases)) == len(cases) == 22 * 2 * 6 * 2
