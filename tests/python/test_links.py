"""Contact between bodies and attachments, from Python and from scene files."""

from __future__ import annotations

import numpy as np
import pytest
from service_parts import block

import tensormass as tm


def two_blocks(gap_m: float = 0.01) -> tm.Scene:
    """A block that is fixed at its bottom, and a copy above it that falls."""
    scene = block()
    below = scene.message.bodies[0]
    above = scene.message.bodies.add()
    above.CopyFrom(below)
    above.name = "above"
    above.ClearField("fixed")
    above.mesh.translation_m.z += 0.05 + gap_m
    del scene.message.tools[:]
    scene.message.gravity_m_per_s2.z = -9.81
    return scene


def test_bodies_touch_only_where_the_scene_says_so(server: tm.Server) -> None:
    for touches in (False, True):
        scene = two_blocks()
        body = scene.message.bodies[0].name
        if touches:
            scene.add_body_contact("above", body, friction_coefficient=0.5)
        report = server.inspect(scene)
        assert touches == any(stage.name == "find links" for stage in report.stages)
        assert touches == (not any(text.startswith("contact between bodies") for text in report.not_modelled))
        with server.load(scene, name="touch", lockstep=True) as handle:
            status = handle.step(60)
            lowest_m = handle.positions("above")[:, 2].min()
            assert (status.touching_nodes > 0) == touches
            assert (lowest_m > 0.04) == touches
            assert (status.deepest_contact_m > 0) == touches


def test_a_body_hangs_from_an_attachment_until_it_tears(server: tm.Server) -> None:
    scene = two_blocks(gap_m=-0.2)  # below
    body = scene.message.bodies[0]
    mesh_nodes = 6 * 6 * 4
    scene.attach(
        "ligament", "above", np.arange(mesh_nodes), body.name, [0, 1, 2], stiffness_n_per_m=500, breaking_force_n=1e3
    )
    with server.load(scene, name="hangs", lockstep=True) as handle:
        assert handle.step(30).broken_springs == 0
        hangs_m = handle.positions("above")[:, 2].min()
    scene.message.attachments[0].breaking_force_n = 1e-3
    with server.load(scene, name="tears", lockstep=True) as handle:
        assert handle.step(60).broken_springs == mesh_nodes, "each is taut at some time of the fall"
        assert handle.positions("above")[:, 2].min() < hangs_m - 0.1
        assert handle.reset().broken_springs == 0
        assert handle.step(1).broken_springs < mesh_nodes, "some are whole again"


def test_frames_have_the_springs_of_attachments(server: tm.Server) -> None:
    scene = two_blocks(gap_m=-0.2)
    body = scene.message.bodies[0].name
    nodes = np.arange(0, 30, 3)
    scene.attach("strong", "above", nodes, body, [0], stiffness_n_per_m=500)
    scene.attach("weak", "above", nodes + 1, body, [0, 1, 2], stiffness_n_per_m=500, breaking_force_n=1e-3)
    with server.load(scene, name="sprung", lockstep=True) as handle:
        rest = handle.frame()
        assert not rest.broken_springs.any()
        np.testing.assert_allclose(rest.springs("strong").tensions_n, 0, atol=1e-4)
        handle.step(40)
        frame = handle.frame()
        strong, weak = frame.springs("strong"), frame.springs("weak")
        assert not strong.broken.any()
        assert weak.broken.all()
        assert strong.tensions_n.max() > 0.1
        assert weak.tensions_n.max() == 0
        np.testing.assert_allclose(strong.ends_m[:, 0], handle.positions("above")[nodes], atol=1e-6)
        np.testing.assert_allclose(strong.ends_m[:, 1], handle.positions(body)[[0] * 10], atol=1e-6)
        assert (strong.stiffness_n_per_m, strong.breaking_force_n) == (50, None)
        assert weak.breaking_force_n == pytest.approx(1e-4)

        with tm.connect(server.address) as late:
            assert late.scene("sprung").frame().springs("weak").broken.all()
        handle.reset()
        assert not handle.frame().broken_springs.any()


def test_wrong_names_and_nodes_are_refused() -> None:
    scene = two_blocks()
    body = scene.message.bodies[0].name
    with pytest.raises(tm.InvalidArgumentError, match="no body 'lung'"):
        scene.add_body_contact("lung")
    with pytest.raises(tm.InvalidArgumentError, match=r"attach\.nodes: no nodes of body 'above'"):
        scene.attach("a", "above", [], body, [0], stiffness_n_per_m=1)
    with pytest.raises(tm.InvalidArgumentError, match=r"attach\.other_nodes: index 100000"):
        scene.attach("a", "above", [0], body, [100_000], stiffness_n_per_m=1)
    assert not scene.message.body_contacts
    assert not scene.message.attachments
