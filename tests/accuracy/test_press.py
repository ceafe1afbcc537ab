"""The force in the hand on the demo organ: what the page says is what was measured."""

from __future__ import annotations

import pytest

from tensormass_tools.presets import FOR_BACKEND

from . import press, press_parts


def test_the_demo_is_one_of_the_measured_settings() -> None:
    row = press.row_of_default()
    assert row["setting"] in press.SETTINGS
    assert row["elements"] > 100_000
    assert FOR_BACKEND["cuda"]["demo"].keys() == {"resolution", "dt_s"}


def test_a_target_that_is_missed_stands_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(press.TARGETS["cuda"], "displacement", 1e-4)
    monkeypatch.setitem(press.TARGETS["cuda"], "force", 0.5)
    lines = {line.split(" | ")[1]: line for line in press.targets() if line.startswith("| GPU")}
    assert "missed**" in lines["displacement"]
    assert "missed" not in lines["force, whole script"]


def test_every_part_of_the_error_was_measured() -> None:
    tables = press_parts.tables()
    for part in press_parts.MESHES:
        assert any(line.startswith(f"| {part.name} |") for line in tables["parts"])
    for step in press_parts.STEPS:
        assert any(line.startswith(f"| {step} |") for line in tables["steps"])
