"""Tools that burn tissue away, through the whole daemon: SDK, hands, viewers that join late, and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript

POWER_W, EFFICIENCY, ABLATION_J_PER_M3 = 40.0, 0.25, 2e6
#: Volume of the largest tetrahedron of a cell of 10 mm.
ELEMENT_M3 = 0.01**3 / 3
PRESSED_M = (0.031, 0.029, 0.0345)


def block(*, editing: bool = True) -> tm.Scene:
    """A block on a held base under a probe that burns an element in a few steps."""
    mesh = tm.grid([6, 6, 3], [0.06, 0.06, 0.03], shape="tetrahedron")
    scene = tm.Scene("block")
    scene.add_body(
        "block",
        mesh,
        law="stable_neo_hookean",
        young_modulus_pa=5e3,
        poisson_ratio=0.45,
        density_kg_per_m3=1000,
        fixed_nodes=mesh.nodes[:, 2] < 1e-9,
    )
    scene.body("block").ablation_j_per_m3 = ABLATION_J_PER_M3
    scene.body("block").rayleigh_mass_per_s = 20
    if editing:
        scene.message.editing.SetInParent()
    scene.add_tool(
        "hook",
        "spherical_probe",
        position_m=(0.031, 0.029, 0.05),
        radius_m=0.006,
        cautery_power_w=POWER_W,
        cautery_efficiency=EFFICIENCY,
    )
    return scene


def test_burns_what_the_energy_takes(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.move_tool("hook", PRESSED_M)
        scene.step(60)
        assert scene.status().removed_volume_m3 == 0
        joules = 0.0
        for i in range(120):
            scene.move_tool("hook", np.subtract(PRESSED_M, (0, 0, 1e-4 * i)), level=1)
            scene.step()
            feedback = scene.feedback("hook")
            joules += POWER_W * EFFICIENCY / 60 if feedback.touching else 0
        status = scene.status()
        assert joules > 5
        assert status.removed_volume_m3 == pytest.approx(joules / ABLATION_J_PER_M3, abs=ELEMENT_M3)
        assert status.removed_mass_kg == pytest.approx(1000 * status.removed_volume_m3, rel=1e-5)
        changed = scene.frame()
        faces = changed.triangles("block")
        assert faces.max() < len(changed.vertices("block"))
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] % 2 == 0).all(), "the surface is closed"
        scene.reset()
        assert scene.status().removed_volume_m3 == 0
        assert len(scene.frame().triangles("block")) == 2 * 2 * (6 * 6 + 2 * 6 * 3)


def test_a_hand_steps_on_the_pedal(server: tm.Server, tmp_path: Path) -> None:
    file = tmp_path / "hand.yaml"
    file.write_text(
        "tool: hook\nposes:\n"
        "  - {time_s: 0, position_m: {x: 0.031, y: 0.029, z: 0.05}}\n"
        "  - {time_s: 1, position_m: {x: 0.031, y: 0.029, z: 0.0345}, level: 1}\n"
        "  - {time_s: 2, position_m: {x: 0.031, y: 0.029, z: 0.0345}}\n"
        "  - {time_s: 3, position_m: {x: 0.031, y: 0.029, z: 0.05}}\n",
        "utf-8",
    )
    hand = HandScript.read(file)
    assert [hand.at(time_s).level for time_s in (0.5, 1, 1.99, 2.5)] == [0, 1, 1, 0]
    with server.load(block(), lockstep=True) as scene:
        status = scene.follow("hook", [hand.at(step / 60) for step in range(180)])
        assert status.removed_volume_m3 > 0


@pytest.mark.parametrize("level", [-0.1, 1.5, float("nan")])
def test_refuses_levels_out_of_range(server: tm.Server, level: float) -> None:
    with (
        server.load(block(), lockstep=True) as scene,
        pytest.raises(tm.InvalidArgumentError, match="level"),
    ):
        scene.move_tool("hook", PRESSED_M, level=level)


def test_refuses_power_without_room(server: tm.Server) -> None:
    with pytest.raises(tm.InvalidArgumentError, match=r"cautery.*editing"):
        server.load(block(editing=False))
