"""Instruments against a rigid tool: where each one touches the organ, and how the table is made."""

from __future__ import annotations

import pytest

from tensormass._src.organ import ORGANS, liver

from . import rigid


def test_every_movable_tool_of_the_built_in_scenes_is_pressed() -> None:
    assert {of.name for of in rigid.instruments()} == {"spherical probe", "grasper", "retractor", "box"}


def test_a_tool_touches_the_organ_where_the_press_starts() -> None:
    focus = ORGANS["liver"].focus
    assert focus is not None
    for of in rigid.instruments():
        touch = of.touch_m()
        assert touch[:2] + of.middle_m[:2] == pytest.approx(focus.center_m[:2])
        core = of.core + touch
        below = core - [0, 0, of.round_m]
        assert liver(below).max() < 1e-3, f"{of.name} is above it"
        assert (liver(below - [0, 0, of.depth_m]) > 0).any(), f"{of.name} would not press"
        assert of.depth_m == pytest.approx({"spherical probe": 0.006, "box": 0.003}.get(of.name, 0.004))


def test_the_table_has_a_row_for_each_instrument_and_mesh() -> None:
    common = {"instrument": "box", "depth_mm": 3.0, "elements": 1, "reference_n": 0.5, "contact": -0.05}
    rows = [
        {**common, "mesh": mesh, "contact_method": contact, "error": error}
        for mesh in ("a", "b")
        for contact, error in zip(rigid.CONTACTS, (-0.04, 0.01), strict=True)
    ]
    lines = rigid.table_of(rows)
    assert lines[2:] == [f"| box | 3 mm | {mesh} | 0.5 N | -4.0 % | +1.0 % | -5.0 % |" for mesh in ("a", "b")]
