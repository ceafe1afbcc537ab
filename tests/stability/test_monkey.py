"""Twenty walks of the monkey's hand; `python -m stability.monkey --walks 500` makes more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import tensormass as tm

from . import monkey, presses

#: Scenes whose tissue has no other body in which it could stay caught.
SINGLE = ("demo", "retract", "grasp")


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    try:
        launched = tm.launch(backend="cpu", zenoh=False)
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    with launched:
        yield launched


@pytest.mark.parametrize("number", range(20))
def test_a_hand_never_stops_a_scene(server: tm.Server, number: int) -> None:
    row = monkey.run_walk(server, number, 0)
    assert row.stopped_at_s is None, row.verdict
    assert max(row.force_share, row.torque_share, row.joint_share) <= 1, row
    if row.scene in SINGLE:
        assert row.left_mm is not None
        assert row.left_mm <= 1e3 * monkey.LARGEST_LEFT_M, row


@pytest.mark.parametrize("number", range(monkey.FIRST_BLADE_WALK, monkey.FIRST_BLADE_WALK + 4))
def test_a_hand_with_a_blade_never_stops_a_scene(server: tm.Server, number: int) -> None:
    row = monkey.run_walk(server, number, 0)
    assert row.stopped_at_s is None, row.verdict
    assert max(row.force_share, row.torque_share, row.joint_share) <= 1, row


def test_a_fast_press_through_the_organ_does_not_jump(server: tm.Server) -> None:
    press = presses.run_press(server, "cpu", 0.5)
    assert press.verdict == "goes on", press


def test_every_scene_meets_every_instrument_and_motion() -> None:
    plans = [monkey.plan_of(number) for number in range(500)]
    pairs = {(scene, instrument) for scene, instrument, _, _ in plans}
    motions = {(scene, motion) for scene, _, motion, _ in plans}
    assert len(pairs) == len(monkey.SCENES) * len(monkey.INSTRUMENTS)
    assert len(motions) == len(monkey.SCENES) * len(set(monkey.MOTIONS))


@pytest.mark.parametrize("kind", sorted(set(monkey.MOTIONS)))
def test_the_hand_is_as_fast_as_told_and_comes_through_the_box(kind: str) -> None:
    box = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, 0.05]])
    places = monkey.motion_of(kind, np.random.default_rng(3), 3000, 1 / 60, 0.3, box)
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps_m.max() <= 0.3 / 60 * (1 + 1e-6)
    inside = np.all((places > box[0]) & (places < box[1]), axis=1)
    assert inside.any()


def test_the_verdict_names_what_is_wrong() -> None:
    row = monkey.broken_row(0, RuntimeError("no"))
    assert row.verdict == "broke: RuntimeError: no"
    good = replace(row, left_mm=0.2)
    assert monkey._verdict(good) == "goes on"
    assert monkey._verdict(replace(good, torque_share=1.1)) == "beyond the largest load"
    assert monkey._verdict(replace(good, left_mm=1.2)) == "tissue is not back"
