"""Scissors that take a piece off, through the whole daemon: the built-in scene under its hands, and its events."""

from __future__ import annotations

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, scripts_of

#: A second of the scene `resect`, in steps.
SECOND = 60
#: When the scissors have gone, and the grasper holds the piece [s].
HELD_S = 8


def hands_of_resect() -> dict[str, HandScript]:
    return {tool: HandScript.read(path) for tool, path in scripts_of("resect").items()}


def move(scene: tm.SceneHandle, hands: dict[str, HandScript], step: int) -> None:
    """Moves the tools to where they are in a step, and makes it."""
    for tool, hand in hands.items():
        pose = hand.at(step / SECOND)
        scene.move_tool(tool, pose.position_m, pose.orientation, joint_values=pose.joint_values)
    scene.step(1)


def test_the_hands_take_a_piece_off_and_hold_it(server: tm.Server) -> None:
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
        assert status.guard_events == 0, "no crumb flies"
