"""Meshes of built-in scenes from fine to coarse, with their measured cost and error, kept in fits.yaml.

`tensormass run` chooses among them (fitting.py). `python -m accuracy.fits` makes the file of committed results.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tensormass_tools.presets import FOR_BACKEND
from tensormass_tools.trade.knobs import Setting

FILE = Path(__file__).resolve().parent / "fits.yaml"
#: The scene whose errors were measured, and those with the same organ, which take its meshes.
MEASURED = "demo"
LIKE = ("retract", "grasp", "table", "burn", "two_organs", "demo-abdomen", "dissect", "cut", "snip", "resect")


@dataclass(frozen=True)
class Rung:
    """A mesh of a built-in scene."""

    #: Edits of the scene file.
    setting: Setting
    #: 99th percentile of a step, relative to the finest mesh of the list.
    cost: float
    #: Relative error of the force on a probe that is held in the scene MEASURED.
    error: float


def ladder_of(scene: str | None, backend: str) -> tuple[Rung, ...]:
    """Returns the meshes of a built-in scene on a backend, "cpu" or "cuda": first the one that runs where there is
    room. Empty if there is nothing to choose."""
    if scene is None or scene not in (MEASURED, *LIKE):
        return ()
    content: dict[str, list[dict[str, Any]]] = yaml.safe_load(FILE.read_text("utf-8"))
    rungs = [Rung(entry["setting"], entry["cost"], entry["error"]) for entry in content.get(backend, [])]
    settings = [rung.setting for rung in rungs]
    own = FOR_BACKEND.get(backend, {}).get(scene, {})
    return tuple(rungs[settings.index(own) :]) if own in settings else ()
