"""The quick cases against a real daemon; `make accuracy` runs all. Skipped without build/bin/tensormassd."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import tensormass as tm
from tensormass._shared import processes

from .case import Case
from .cases import all_cases
from .engine import PRECISIONS, Engine

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)

QUICK = [
    (case, precision) for case in all_cases() if case.quick for precision in PRECISIONS if precision in case.bounds
]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=False) as server:  # others run beside it
        yield server


@pytest.mark.parametrize(("case", "precision"), QUICK, ids=[f"{case.key}-{precision}" for case, precision in QUICK])
def test_within_its_bound(server: tm.Server, case: Case, precision: str) -> None:
    outcome = case.run(Engine(server, precision))
    bound = case.bounds[precision]
    assert bound is not None
    assert outcome.error <= bound, outcome
