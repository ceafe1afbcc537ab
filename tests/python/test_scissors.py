"""Scissors that take a piece off, through the whole daemon: built-in scenes under their hands, and their events."""

from __future__ import annotations

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of, scripts_of

#: A second of the scenes, in steps.
SECOND = 60
#: When the scissors have closed twice and left [s].
SNIPPED_S = 12.5
#: Height of the floor of the scenes [m].
FLOOR_M = -0.12
#: When the grasper of `resect` carries the piece, and when it has put it down and left [s].
CARRIED_S, PUT_DOWN_S = 10.5, 15


def test_the_hand_takes_a_piece_off_which_falls(server: tm.Server) -> None:
    path = script_of("snip")
    assert path is not None
    hand = HandScript.read(path)
    with server.load("snip", lockstep=True) as scene, scene.events(timeout_s=30) as events:
        rest = scene.positions("liver")
        tip = int(np.argmax(rest[:, 0]))
        largest_n_m = 0.0
        for step in range(int(SNIPPED_S * SECOND)):
            pose = hand.at(step / SECOND)
            scene.move_tool(hand.tool, pose.position_m, pose.orientation, joint_values=pose.joint_values)
            status = scene.step(1)
            largest_n_m = max(largest_n_m, scene.feedback(hand.tool).joint_loads[0])
        # Toughness times the largest area that both edges could sweep by an angle: L² / 2.
        assert 0.01 < largest_n_m < 10 * 0.085**2 / 2
        # The section of the lobe; tissue sags and is pushed while the blades close.
        assert 1.4e-3 < status.cut_area_m2 < 2.5e-3
        assert status.guard_events == 0
        kinds: set[str] = set()
        largest_m3 = 0.0
        while largest_m3 < 5e-6 or "cut_ended" not in kinds:
            event = next(events)
            kinds.add(event.kind)
            if event.kind == "piece_free":
                largest_m3 = max(largest_m3, event.value)
            if event.kind in ("cut_begun", "cut_ended"):
                assert event.tool == hand.tool
            if event.kind == "cut_ended":
                assert event.work_j > 0.01
        assert "cut_begun" in kinds
        now = scene.positions("liver")
        assert FLOOR_M - 0.005 < now[tip, 2] < FLOOR_M + 0.03, "the piece lies on the floor"
        assert scene.frame().vertices("liver")[:, 2].min() > FLOOR_M - 0.005, "so do crumbs of the cut"
        lobe = rest[:, 0] < 0.088
        assert np.linalg.norm(now[lobe] - rest[lobe], axis=1).max() < 0.02, "the lobe stays"


def test_the_hands_take_a_piece_off_and_carry_it_to_a_tray(server: tm.Server) -> None:
    hands = {tool: HandScript.read(path) for tool, path in scripts_of("resect").items()}
    assert set(hands) == {"scissors", "grasper"}
    with server.load("resect", lockstep=True) as scene, scene.events(timeout_s=30) as events:
        rest = scene.positions("liver")
        tip = int(np.argmax(rest[:, 0]))

        def move_until(time_s: float) -> None:
            for step in range(scene.status().step, round(time_s * SECOND)):
                for tool, hand in hands.items():
                    pose = hand.at(step / SECOND)
                    scene.move_tool(tool, pose.position_m, pose.orientation, joint_values=pose.joint_values)
                scene.step(1)

        move_until(CARRIED_S)
        carried_m = scene.positions("liver")[tip] - rest[tip]
        grasper_m = hands["grasper"].at(CARRIED_S).position_m - hands["grasper"].at(7.5).position_m
        assert np.linalg.norm(carried_m - grasper_m) < 0.01, "the piece goes where the jaws go"
        piece_n = -scene.feedback("grasper").force_n[2]
        move_until(PUT_DOWN_S)
        volume_m3 = 0.0
        while volume_m3 < 5e-6:
            event = next(events)
            volume_m3 = max(volume_m3, event.value) if event.kind == "piece_free" else volume_m3
        assert piece_n == pytest.approx(9.81 * 1060 * volume_m3, rel=0.1), "its weight, while it is lowered"
        now = scene.positions("liver")
        assert FLOOR_M - 0.005 < now[tip, 2] < FLOOR_M + 0.03, "the piece lies on the tray"
        assert np.linalg.norm(scene.feedback("grasper").force_n) < 1e-3, "the jaws have let it go"
        lobe = rest[:, 0] < 0.088
        assert np.linalg.norm(now[lobe] - rest[lobe], axis=1).max() < 0.02, "the lobe stays"
        assert scene.status().guard_events == 0
