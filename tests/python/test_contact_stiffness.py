"""How stiff contact is: what a tool touches decides, and nothing else in the scene."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from service_parts import block

import tensormass as tm
from tensormass.v1 import control_pb2
from tensormass_tools.output import report_text

SOFT_PA = 4e3
HELD_M = 0.0101  # the lowest layer is held, so that what it is made of cannot matter
TOOLS: dict[str, dict[str, Any]] = {
    "spherical_probe": {"radius_m": 0.012},
    "capsule": {"radius_m": 0.012, "length_m": 0.1},
    "box": {"size_x_m": 0.03, "size_y_m": 0.03, "size_z_m": 0.024},
}


@dataclasses.dataclass
class Felt:
    force_n: np.ndarray
    stiffness_n_per_m: float


def tissue(where: str = "", young_modulus_pa: float = 0.0) -> tm.Scene:
    """Soft tissue of 9 x 9 x 4 cm, with a bone that no tool comes near."""
    mesh = tm.grid([6, 6, 4], [0.09, 0.09, 0.04])
    low = mesh.nodes[:, 2] < HELD_M
    if where == "element_fields":
        below = mesh.nodes[mesh.elements("tetrahedron")].mean(axis=1)[:, 2] < HELD_M
        fields = {"young_modulus_pa": np.where(below, young_modulus_pa, SOFT_PA)}
        elements = [("tetrahedron", mesh.elements("tetrahedron"))]
        mesh = tm.VolumeMesh.from_arrays(mesh.nodes, elements, element_fields=fields)
    scene = tm.Scene("bone")
    law: dict[str, Any] = {"law": "stable_neo_hookean", "poisson_ratio": 0.45}
    body = scene.add_body("soft", mesh, **law, young_modulus_pa=SOFT_PA, density_kg_per_m3=1000, fixed_nodes=low)
    body.rayleigh_stiffness_s = 0.01
    if where == "law_region":
        region = body.law_regions.add()
        for corner, value in ((region.region.box.min_m, -1.0), (region.region.box.max_m, 1.0)):
            corner.x = corner.y = corner.z = value
        region.region.box.max_m.z = HELD_M
        region.law.stable_neo_hookean.young_modulus_pa = young_modulus_pa
        region.law.stable_neo_hookean.poisson_ratio = 0.3
    if where == "another body":
        bone = tm.grid([2, 2, 2], [0.04, 0.04, 0.02], origin_m=(0.3, 0, 0))
        bottom = bone.nodes[:, 2] < 1e-9
        scene.add_body(
            "bone", bone, **law, young_modulus_pa=young_modulus_pa, density_kg_per_m3=1800, fixed_nodes=bottom
        )
    return scene


def press(server: tm.Server, scene: tm.Scene, tool: str) -> Felt:
    """Holds a tool 4 mm deep. Returns what it feels in the second half of two seconds."""
    start = (0.046, 0.044, 0.07)
    scene.add_tool("tool", tool, position_m=start, **TOOLS[tool])
    with server.load(scene, lockstep=True) as handle:
        handle.move_tool("tool", (*start[:2], 0.04 + 0.012 - 0.004))
        handle.step(60)
        force = []
        for _ in range(60):
            handle.step()
            feedback = handle.feedback("tool")
            force.append(feedback.force_n[2])
        return Felt(np.array(force), float(feedback.stiffness_n_per_m[2, 2]))


@pytest.mark.parametrize("tool", TOOLS)
def test_a_bone_that_no_tool_touches_changes_no_force(server: tm.Server, tool: str) -> None:
    alone = press(server, tissue(), tool)
    mean_n = alone.force_n.mean()
    assert mean_n > 0.05
    for where in ("another body", "law_region", "element_fields"):
        for young_modulus_pa in (1e5, 1e8, 1.7e10):
            felt = press(server, tissue(where, young_modulus_pa), tool)
            what = f"{where} of {young_modulus_pa:g} Pa"
            assert felt.force_n.mean() == pytest.approx(mean_n, rel=2e-3), what
            assert np.ptp(felt.force_n) < max(2 * np.ptp(alone.force_n), 2e-3 * mean_n), what
            assert felt.stiffness_n_per_m == pytest.approx(alone.stiffness_n_per_m, rel=1e-2), what


def test_inspect_says_how_stiff_contact_is(server: tm.Server) -> None:
    scene = tissue("another body", 1e6)
    scene.add_tool("probe", "spherical_probe", position_m=(0, 0, 1), radius_m=0.01)
    scene.add_tool("given", "spherical_probe", position_m=(0, 0, 1), radius_m=0.01, penalty_stiffness_pa_per_m=3e6)
    scene.add_body_contact("soft", "bone")
    report = server.inspect(scene)
    probe, given, bodies = report.contacts
    assert (probe.tool, probe.is_default) == ("probe", True)
    assert probe.least_penalty_pa_per_m == pytest.approx(20 * SOFT_PA / 0.01)
    assert probe.most_penalty_pa_per_m == pytest.approx(20 * 1e6 / 0.01)
    assert (given.tool, given.is_default) == ("given", False)
    assert given.least_penalty_pa_per_m == given.most_penalty_pa_per_m == 3e6
    assert (bodies.body, bodies.other, bodies.is_default) == ("soft", "bone", True)
    assert bodies.least_penalty_pa_per_m == bodies.most_penalty_pa_per_m > 0, "the softer element decides"
    lines = [line.split() for line in report_text(report, scene.message).splitlines()]
    assert ["probe", "8e+06", "to", "2e+09", "what", "is", "touched"] in lines
    assert ["given", "3e+06", "the", "scene"] in lines


def test_a_report_without_contacts_has_no_table() -> None:
    assert "pressure per depth" not in report_text(control_pb2.SceneReport(), block().message)


@pytest.mark.parametrize("law", [None, "st_venant_kirchhoff"])
def test_the_default_law_stands_a_press_of_8_mm(server: tm.Server, law: str | None) -> None:
    block = tm.grid([8, 8, 4], [0.1, 0.1, 0.05])
    options: dict[str, Any] = {} if law is None else {"law": law}
    scene = tm.Scene.from_mesh(block, **options, fixed_nodes=block.nodes[:, 2] < 1e-9)
    scene.add_tool("probe", "spherical_probe", radius_m=0.01, position_m=(0.05, 0.05, 0.07))
    with server.load(scene, lockstep=True) as handle:
        for step in range(240):
            handle.move_tool("probe", (0.05, 0.05, 0.06 - 0.008 * min(1.0, step / 120)))
            handle.step()
        status = handle.status()
        force_n = handle.feedback("probe").force_n
    softens = any("gets softer where it is pressed" in warning for warning in status.warnings)
    assert softens == (law is not None)
    if law is None:
        assert list(status.warnings) == []
        assert status.min_det_f > 0.5
        assert np.linalg.norm(force_n) > 0.5
