"""A scalpel that cuts, through the whole daemon: the built-in scene under its hand, events, recordings and refusals."""

from __future__ import annotations

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of

#: A second of the scene `cut`, in steps.
SECOND = 60


def test_the_hand_cuts_the_organ(server: tm.Server) -> None:
    path = script_of("cut")
    assert path is not None
    hand = HandScript.read(path)
    poses = [hand.at(step / SECOND) for step in range(int(SECOND * hand.times_s[-1]))]
    with server.load("cut", lockstep=True) as scene, scene.events(timeout_s=30) as events:
        scene.follow(hand.tool, poses[: 2 * SECOND])
        largest = 0.0
        for begin in range(2 * SECOND, 6 * SECOND, 6):
            scene.follow(hand.tool, poses[begin : begin + 6])
            largest = max(largest, float(np.linalg.norm(scene.feedback(hand.tool).force_n)))
        # No more than tearing sideways with the whole edge could take.
        assert 0.05 < largest < 60 * 0.02 * 4.2
        scene.follow(hand.tool, poses[6 * SECOND : 8 * SECOND])
        assert float(np.linalg.norm(scene.feedback(hand.tool).force_n)) == 0, "it has left"
        area_m2 = 0.0
        while area_m2 < 2e-4:
            event = next(events)
            if event.kind == "cut":
                area_m2 += event.value
        scene.reset()


def block(kind: str = "tetrahedron") -> tm.Scene:
    """A block before a scalpel whose edge lies along y."""
    mesh = tm.grid([8, 4, 4], [0.04, 0.01, 0.02], shape=kind)
    scene = tm.Scene("block")
    scene.add_body(
        "block", mesh, law="stable_neo_hookean", young_modulus_pa=1e5, poisson_ratio=0.4, density_kg_per_m3=1000,
        fixed_nodes=np.nonzero(mesh.nodes[:, 2] < 1e-9)[0],
    )  # fmt: skip
    scene.body("block").fracture_toughness_j_per_m2 = 50
    scene.message.editing.cutting.SetInParent()
    scene.add_tool(
        "blade", "scalpel", length_m=0.012, thickness_m=4e-4, spacing_m=5e-4, position_m=(-0.002, -0.001, 0.0103),
        orientation=(0.5**0.5, -(0.5**0.5), 0, 0),
    )  # fmt: skip
    return scene


def test_a_blade_feels_toughness_times_width(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        for step in range(31):  # one more than the last cut, whose feedback has no spring
            scene.move_tool("blade", (-0.002 + 1e-3 * step, -0.001, 0.0103), (0.5**0.5, -(0.5**0.5), 0, 0))
            scene.step(1)
        feedback = scene.feedback("blade")
        assert feedback.force_n[0] == pytest.approx(-50 * 0.01, rel=0.15)
        assert feedback.yielding is not None
        assert feedback.yielding.limit_n == pytest.approx(50 * 0.01, rel=0.15)
        np.testing.assert_allclose(feedback.yielding.direction, [1, 0, 0], atol=1e-12)
        np.testing.assert_array_equal(feedback.stiffness_n_per_m, np.zeros((3, 3)))


@pytest.mark.parametrize(("change", "words"), [("shape", "linear tetrahedra"), ("editing", "editing.cutting")])
def test_refuses_what_it_cannot_cut(server: tm.Server, change: str, words: str) -> None:
    scene = block("hexahedron" if change == "shape" else "tetrahedron")
    if change == "editing":
        scene.message.ClearField("editing")
    with pytest.raises(tm.TensormassError, match=words):
        server.load(scene, lockstep=True)
