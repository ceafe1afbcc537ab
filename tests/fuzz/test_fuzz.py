"""Mutated inputs for each decoder of what others send. `make fuzz` runs more of them."""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from fuzz.harness import DecoderError, run
from fuzz.mutations import mutated
from fuzz.targets import TARGETS, Target, kept_inputs

COUNTS = {
    "recording": 300,
    "chunk": 300,
    "message": 1000,
    "query": 2000,
    "bus": 500,
    "changes": 2000,
    "frame": 2000,
    "scene": 1000,
    "mesh": 300,
    "labels": 2000,
}
"""Mutated inputs of each target: at most a few seconds."""


@pytest.mark.parametrize("name", TARGETS)
def test_unmutated_inputs_are_taken(name: str) -> None:
    for seed in TARGETS[name].seeds():
        TARGETS[name].run(seed)


@pytest.mark.parametrize("name", TARGETS)
def test_inputs_that_failed_once_fail_no_more(name: str) -> None:
    for path in kept_inputs(name):
        run(name, TARGETS[name], path.read_bytes())


@pytest.mark.parametrize("name", TARGETS)
def test_mutated_inputs_are_taken_or_refused(name: str, tmp_path: Path) -> None:
    target, seeds = TARGETS[name], TARGETS[name].seeds()
    for seed in range(COUNTS[name]):
        run(name, target, mutated(seeds, random.Random(f"{name} {seed}")), tmp_path)


def test_a_failure_keeps_its_input(tmp_path: Path) -> None:
    def fails(data: bytes) -> None:
        raise {b"key": KeyError, b"value": ValueError}[data]("because")

    target = Target(lambda: [], fails, (ValueError,))
    run("any", target, b"value", tmp_path)
    with pytest.raises(DecoderError, match="any: KeyError: 'because'; the input is "):
        run("any", target, b"key", tmp_path)
    assert [path.read_bytes() for path in (tmp_path / "any").iterdir()] == [b"key"]


def test_the_same_seed_gives_the_same_input() -> None:
    seeds = [b"some text 12", b"another one"]
    first, second = ([mutated(seeds, random.Random(seed)) for seed in range(200)] for _ in range(2))
    assert first == second
    assert len(set(first)) > 150
