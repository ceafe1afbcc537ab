"""Scissors that take a piece off, through the whole daemon: the built-in scene under its hand, and its events."""

from __future__ import annotations

import numpy as np

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of

#: A second of the scene `snip`, in steps.
SECOND = 60
#: When the scissors have closed twice and left [s].
SNIPPED_S = 12.5
#: Height of the floor of the scene [m].
FLOOR_M = -0.12


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
        lobe = rest[:, 0] < 0.088
        assert np.linalg.norm(now[lobe] - rest[lobe], axis=1).max() < 0.02, "the lobe stays"
