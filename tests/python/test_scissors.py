"""Scissors that take a piece off, through the whole daemon: the built-in scene under its hands, and its events."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, scripts_of

#: A second of the scene `resect`, in steps.
SECOND = 60
#: When the scissors have gone and the grasper holds the piece, and when it has carried it away [s].
HELD_S, CARRIED_S = 8, 11
#: Where the grasper carries the piece [m].
AWAY_M = (0.048, 0.0, 0.024)
#: Speed that no node reaches [m/s]: less than a piece that falls for a second.
FAST_M_PER_S = 5.0


def hands_of_resect() -> dict[str, HandScript]:
    return {tool: HandScript.read(path) for tool, path in scripts_of("resect").items()}


def move(scene: tm.SceneHandle, hands: dict[str, HandScript], step: int) -> None:
    """Moves the tools to where they are in a step, and makes it."""
    for tool, hand in hands.items():
        pose = hand.at(step / SECOND)
        scene.move_tool(tool, pose.position_m, pose.orientation, joint_values=pose.joint_values)
    scene.step(1)


def test_the_hands_take_a_piece_off_and_carry_it_away(server: tm.Server) -> None:
    hands = hands_of_resect()
    assert set(hands) == {"scissors", "grasper"}
    with server.load("resect", lockstep=True) as scene, scene.events(timeout_s=30) as events:
        rest = scene.positions("liver")
        tip = int(np.argmax(rest[:, 0]))
        largest_n_m = 0.0
        for step in range(HELD_S * SECOND):
            move(scene, hands, step)
            largest_n_m = max(largest_n_m, scene.feedback("scissors").joint_loads[0])
        # Toughness times the largest area that both edges could sweep by an angle: L² / 2.
        assert 0.01 < largest_n_m < 20 * 0.085**2 / 2
        moved_m = scene.positions("liver")[tip] - rest[tip]
        assert np.linalg.norm(moved_m) < 0.01, "the grasper holds it"
        piece_n = -scene.feedback("grasper").force_n[2]
        status = scene.status()
        # The section of the lobe; tissue sags and is pushed while the blades close.
        assert 1.4e-3 < status.cut_area_m2 < 2.5e-3
        kinds: dict[str, tm.Event] = {}
        while not {"cut_ended", "piece_free"} <= kinds.keys():
            event = next(events)
            kinds.setdefault(event.kind, event)
        assert kinds["cut_begun"].tool == kinds["cut_ended"].tool == "scissors"
        assert kinds["cut_ended"].work_j > 0.01
        assert kinds["piece_free"].value > 5e-6
        assert piece_n == pytest.approx(9.81 * 1060 * kinds["piece_free"].value, rel=0.2), "its weight"
        for step in range(HELD_S * SECOND, CARRIED_S * SECOND):
            move(scene, hands, step)
        carried_m = scene.positions("liver")[tip] - rest[tip] - moved_m
        np.testing.assert_allclose(carried_m, AWAY_M, atol=0.01)
        assert scene.status().guard_events == 0


@pytest.mark.parametrize("closed_y_m", [-0.047, -0.048, -0.04])
def test_no_crumb_flies_wherever_the_blades_close(server: tm.Server, closed_y_m: float) -> None:
    hands = hands_of_resect()
    scissors = hands["scissors"]
    positions_m = scissors.positions_m.copy()
    from_y_m, to_y_m = positions_m[:, 1].max(), positions_m[:, 1].min()
    positions_m[:, 1] = from_y_m + (positions_m[:, 1] - from_y_m) * (closed_y_m - from_y_m) / (to_y_m - from_y_m)
    hands["scissors"] = dataclasses.replace(scissors, positions_m=positions_m)
    with server.load("resect", lockstep=True) as scene:
        before = scene.positions("liver")
        for step in range(HELD_S * SECOND):
            move(scene, hands, step)
            now = scene.positions("liver")
            assert np.linalg.norm(now - before, axis=1).max() < FAST_M_PER_S / SECOND, step
            before = now
        status = scene.status()
        assert status.guard_events == 0
        assert status.cut_area_m2 > 1e-3
