"""Tools that burn tissue away, through the whole daemon: SDK, hands, viewers that join late, and refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of

FloatArray = npt.NDArray[np.float64]

POWER_W, EFFICIENCY, ABLATION_J_PER_M3 = 40.0, 0.25, 2e6
#: Volume of the largest tetrahedron of a cell of 10 mm.
ELEMENT_M3 = 0.01**3 / 3
PRESSED_M = (0.031, 0.029, 0.0345)
DEADLINE_S = 30.0
#: `Frame.faces`
OUTER, BURNT = 0, 2


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


def test_little_power_coagulates_and_burns_nothing_away(server: tm.Server) -> None:
    scene_message = block()
    scene_message.body("block").coagulated_stiffness_factor = 5
    with server.load(scene_message, lockstep=True) as scene, scene.frames(timeout_s=DEADLINE_S) as frames:
        scene.move_tool("hook", PRESSED_M)
        scene.step(60)
        raw = scene.frame()
        assert not raw.coagulation("block").any()
        whole = raw.triangles("block")
        press_n = scene.feedback("hook").force_n[2]
        # A fifth of the energy that removes the element at the tip.
        joules = 0.2 * ABLATION_J_PER_M3 * ELEMENT_M3
        level = joules / (POWER_W * EFFICIENCY * 30 / 60)
        for _ in range(30):
            scene.move_tool("hook", PRESSED_M, level=level)
            scene.step()
        scene.move_tool("hook", PRESSED_M)
        scene.step(60)
        heated = scene.frame()
        pale = heated.coagulation("block")
        assert set(np.unique(pale * 3).round().tolist()) <= {0, 1, 2, 3}
        assert pale.max() == 1
        near = np.linalg.norm(raw.vertices("block") - [0.031, 0.029, 0.03], axis=1) < 0.02
        assert not pale[~near].any()
        assert (heated.triangles("block") == whole).all()
        assert scene.status().removed_volume_m3 == pytest.approx(joules / ABLATION_J_PER_M3, rel=1e-6)
        assert scene.feedback("hook").force_n[2] > 1.02 * press_n, "it is stiffer"
        # Readers of the stream see it, too: those that were there, and those that come late.
        with scene.frames(timeout_s=DEADLINE_S) as late:
            for stream in (frames, late):
                scene.step()
                seen = next(frame for frame in stream if frame.step >= heated.step)
                assert (seen.coagulation("block") == pale).all()
        scene.reset()
        assert not scene.frame().coagulation("block").any()


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


def front_and_back(
    triangles: FloatArray, start: FloatArray, along: FloatArray
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Returns the triangles [n, 3, 3] m that a ray meets, nearest first, and where their normals point along it."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normals = np.cross(b - a, c - a)
    facing = normals @ along
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = ((a - start) * normals).sum(axis=1) / facing
        points = start + distance[:, None] * along
        sides = [(np.cross(to - of, points - of) * normals).sum(axis=1) >= 0 for of, to in ((a, b), (b, c), (c, a))]
    met = np.flatnonzero(np.logical_and.reduce(sides) & (distance > 0))
    order = met[np.argsort(distance[met])]
    return order, facing[order]


def test_the_organ_of_the_demo_burns_below_its_skin(server: tm.Server) -> None:
    """The built-in scene under its scripted hand: a groove that nobody can look through, and that a reset heals."""
    script = script_of("burn")
    assert script is not None
    hand = HandScript.read(script)
    with server.load("burn", lockstep=True) as scene:
        whole = len(scene.frame().triangles("liver"))
        status = scene.follow("hook", [hand.at(step / 60) for step in range(240)])
        assert status.removed_volume_m3 > 1e-7
        with scene.events(timeout_s=DEADLINE_S) as events:
            assert next(events).kind == "ablated"
        frame = scene.frame()
        faces = frame.faces("liver")
        assert set(faces.tolist()) == {OUTER, BURNT}
        assert frame.revision > 0
        assert (faces == BURNT).sum() > 15
        vertices, indices = frame.vertices("liver").astype(float), frame.triangles("liver")
        assert indices.max() < len(vertices)
        triangles = vertices[indices]
        assert np.linalg.norm(triangles - triangles.mean(axis=1, keepdims=True), axis=2).max() < 0.015, "no spikes"
        # Rays into the groove and its rim, from above and from the sides.
        burnt = triangles[faces == BURNT].mean(axis=1)
        random = np.random.default_rng(3)
        cracks = hits = 0
        for _ in range(400):
            to = burnt[random.integers(len(burnt))] + random.normal(0, 0.004, 3)
            along = random.normal(0, 1, 3) - [0, 0, 0.8]
            along /= np.linalg.norm(along)
            met, facing = front_and_back(triangles, to - 0.3 * along, along)
            hits += len(met) > 0
            cracks += len(met) > 0 and facing[0] > 0
        assert hits > 300
        assert cracks == 0
        scene.reset()
        assert len(scene.frame().triangles("liver")) == whole
