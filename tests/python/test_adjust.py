"""Values of a scene of a real daemon that change while it steps."""

from __future__ import annotations

import numpy as np
import pytest
from service_parts import block

import tensormass as tm


def test_a_scene_goes_on_with_other_values(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        scene.move_tool("probe", (0.05, 0.05, 0.055))
        scene.step(40)
        before = scene.positions("tissue")
        force_n = np.linalg.norm(scene.feedback("probe").force_n)
        assert force_n > 0
        values = scene.adjust(
            stiffness_factor={"tissue": 4}, rayleigh_mass_per_s={"tissue": 3}, gravity_m_per_s2=(0, 0, -2)
        )
        assert values.bodies[0].stiffness_factor == 4
        assert values.bodies[0].rayleigh_mass_per_s == 3
        assert values.gravity_m_per_s2.z == -2
        np.testing.assert_array_equal(scene.positions("tissue"), before)
        assert scene.step(200).step == 240
        assert np.linalg.norm(scene.feedback("probe").force_n) > 2 * force_n
        assert scene.adjust() == values


def test_wrong_values_are_refused_and_change_nothing(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        present = scene.adjust()
        with pytest.raises(tm.NotFoundError, match=r"no body 'liver'; it has: tissue$"):
            scene.adjust(stiffness_factor={"liver": 2})
        with pytest.raises(tm.NotFoundError, match=r"no body 'liver'; it has: tissue$"):
            scene.positions("liver")
        with pytest.raises(tm.NotFoundError, match=r"no tool 'knife'; it has: probe$"):
            scene.move_tool("knife", (0, 0, 0))
        with pytest.raises(tm.InvalidArgumentError, match="stiffness_factor"):
            scene.adjust(stiffness_factor={"tissue": 1e9})
        with pytest.raises(tm.InvalidArgumentError, match="rayleigh_stiffness_s"):
            scene.adjust(rayleigh_stiffness_s={"tissue": -1})
        with pytest.raises(tm.InvalidArgumentError, match="gravity_m_per_s2"):
            scene.adjust(gravity_m_per_s2=(0, float("nan"), 0))
        assert scene.adjust() == present


def test_a_snapshot_from_before_an_adjustment_is_refused_with_the_reason(server: tm.Server) -> None:
    with server.load(block(), lockstep=True) as scene:
        before = scene.snapshot()
        scene.adjust(stiffness_factor={"tissue": 2})
        with pytest.raises(tm.FailedPreconditionError, match="or of other values; load that scene first, or adjust it"):
            scene.restore(before)
