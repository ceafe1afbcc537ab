"""Tools that sever springs, through the whole daemon: the built-in scene under its hand, events, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of

#: A second of the scene `dissect`, in steps.
SECOND = 60


def test_the_hand_frees_the_organ_step_by_step(server: tm.Server) -> None:
    path = script_of("dissect")
    assert path is not None
    hand = HandScript.read(path)
    poses = [hand.at(step / SECOND) for step in range(int(SECOND * hand.times_s[-1]))]
    with server.load("dissect", lockstep=True) as scene, scene.events(timeout_s=30) as events:
        (ligament,) = scene.topology().attachments
        count = len(ligament.springs) // 8  # two numbers of 4 bytes each
        assert count > 100
        tip = scene.positions("liver")[:, 0].argmax()
        broken: list[int] = []
        tip_m: list[float] = []
        told, last = 0.0, 0
        for begin in range(0, 17 * SECOND, SECOND):
            broken.append(scene.follow(hand.tool, poses[begin : begin + SECOND]).broken_springs)
            tip_m.append(float(scene.positions("liver")[tip, 2]))
            while told < broken[-1]:
                event = next(events)
                assert (event.kind, event.attachment, event.tool) == ("severed", "ligament", "hook")
                assert event.text.endswith("of attachment 'ligament' severed by 'hook'")
                assert event.position_m is not None
                assert event.step > last
                told, last = told + event.value, event.step
            assert told == broken[-1]
        assert broken[0] == 0, "the hook waits"
        assert broken == sorted(broken)
        assert len({0, broken[5], broken[11], broken[16]}) == 4, "each pass severs some"
        assert broken[16] == count, "the lobe is free"
        assert tip_m[16] < tip_m[0] - 0.01, "it sinks"
        assert events.missed_count == 0

        scene.reset()
        assert scene.status().broken_springs == 0
        assert next(events).kind == "reset"


def strung(reach_m: float | None = None, length_m: float | None = None) -> tm.Scene:
    """Two blocks that one attachment joins, and a probe before the gap."""
    mesh = tm.grid([4, 4, 4], [0.02, 0.02, 0.02], shape="hexahedron")
    scene = tm.Scene("strung")
    for name in ("lower", "upper"):
        scene.add_body(
            name, mesh, law="hooke", young_modulus_pa=1e5, poisson_ratio=0.3, density_kg_per_m3=1000,
            fixed_nodes=np.arange(len(mesh.nodes)),
        )  # fmt: skip
    scene.body("upper").mesh.translation_m.z = 0.04
    scene.attach("strands", "lower", mesh.nodes[:, 2] > 0.019, "upper", mesh.nodes[:, 2] < 0.001, stiffness_n_per_m=10)
    scene.add_tool(
        "tip",
        "spherical_probe",
        position_m=(0.01, -0.02, 0.03),
        radius_m=0.008,
        dissection_reach_m=reach_m,
        dissection_length_m=length_m,
    )
    return scene


def test_a_call_and_a_tip_sever(server: tm.Server) -> None:
    with server.load(strung(reach_m=0.001), lockstep=True) as scene:
        scene.step(3)
        assert scene.status().broken_springs == 0
        scene.move_tool("tip", (0.01, 0, 0.03))
        scene.step(60)
        # Strands are 5 mm apart. Within 9 mm of the tip are three at the front, and three behind them.
        assert scene.status().broken_springs == 6
        scene.edit(sever={"strands": None})
        scene.step()
        assert scene.status().broken_springs == 25


@pytest.mark.parametrize("name", ["reach_m", "length_m"])
@pytest.mark.parametrize("wrong", [-0.001, 5.0, float("nan")])
def test_refuses_distances_out_of_range(server: tm.Server, name: str, wrong: float) -> None:
    field = f"dissection.{name}"
    with pytest.raises(tm.InvalidArgumentError, match=rf"{field}: .*scene's size"):
        server.load(strung(**{"reach_m": 0.001, name: wrong}))


def test_refuses_what_severs_nothing(server: tm.Server) -> None:
    with pytest.raises(tm.InvalidArgumentError, match="dissection_length_m needs dissection_reach_m"):
        strung(length_m=0.01)
    scene = strung(reach_m=0.001)
    del scene.message.attachments[:]
    with pytest.raises(tm.InvalidArgumentError, match="no springs to sever"):
        server.load(scene)
