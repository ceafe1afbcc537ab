"""The quick cases against a real daemon; `make stability` runs all. Without build/bin/tensormassd these are skipped."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import tensormass as tm
from accuracy.engine import Engine
from tensormass import processes
from tensormass.v1 import scene_pb2

from .case import HOLDS, SHORT, Case, Check, Found, Group, judge
from .cases import all_cases
from .cases_input import places, real_fields, whole_scene
from .promises import PROMISES
from .tissue import LAWS, tissue

QUICK = [(case, precision) for case in all_cases() if case.quick for precision in case.precisions]


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    with tm.launch(backend="cpu", zenoh=False) as server:
        yield server


@pytest.mark.parametrize(("case", "precision"), QUICK, ids=[f"{case.key}-{precision}" for case, precision in QUICK])
def test_does_as_promised(server: tm.Server, case: Case, precision: str) -> None:
    verdict = judge(case, Engine(server, precision))
    assert case.explains(verdict.outcome, precision), verdict


def test_no_number_of_a_scene_is_left_out() -> None:
    visited = {place.kind for place in places(whole_scene(Engine(None, "float")))}  # type: ignore[arg-type]
    assert real_fields(scene_pb2.Scene.DESCRIPTOR) - visited == set()


def test_every_law_has_a_promise_and_a_tissue() -> None:
    names = {field.name for field in scene_pb2.Law.DESCRIPTOR.oneofs_by_name["kind"].fields}
    assert set(PROMISES) == names == set(LAWS)
    for name in names:
        assert tissue(name).message.WhichOneof("kind") == name


def test_keys_are_unique() -> None:
    keys = [case.key for case in all_cases()]
    assert len(keys) == len(set(keys))


def test_a_number_that_is_none_does_not_hold() -> None:
    group = Group("g", "G", "")

    def outcome(value: float, **reasons: str) -> tuple[str, bool]:
        case = Case(group, "n", "law", "shape", lambda engine: Found([Check("c", value, 1.0)]), short=reasons)
        verdict = judge(case, Engine(None, "float"))  # type: ignore[arg-type]
        return verdict.outcome, case.explains(verdict.outcome, "float")

    assert outcome(1.0) == (HOLDS, True)
    assert outcome(1.1) == (SHORT, False)
    assert outcome(float("nan")) == (SHORT, False)
    assert outcome(1.1, float="because") == (SHORT, True)
    assert outcome(1.1, double="because") == (SHORT, False)
