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
#: Scenes without an error of their own, which take the meshes of a scene with the same organ.
LIKE = dict.fromkeys(("retract", "grasp", "table", "two_organs", "demo-abdomen"), "demo")
#: What the error of a scene is relative to, in words.
MEASURES = {"demo": "the force of a held press", "beam": "the displacement"}


@dataclass(frozen=True)
class Rung:
    """A mesh of a built-in scene."""

    #: Edits of the scene file.
    setting: Setting
    #: 99th percentile of a step, relative to the finest mesh of the list.
    cost: float
    #: Relative error of `Ladder.measure`.
    error: float


@dataclass(frozen=True)
class Ladder:
    """Meshes of a scene, the one that runs where there is room first."""

    rungs: tuple[Rung, ...]
    #: What the errors are of.
    measure: str
    #: Scene in which they were measured.
    measured_in: str


def ladder_of(scene: str | None, backend: str) -> Ladder | None:
    """Returns the meshes of a built-in scene on a backend, "cpu" or "cuda"; None if there is nothing to choose."""
    measured_in = LIKE.get(scene or "", scene or "")
    entries: list[dict[str, Any]] = yaml.safe_load(FILE.read_text("utf-8")).get(backend, {}).get(measured_in, [])
    own = FOR_BACKEND.get(backend, {}).get(scene or "", {})
    rungs = [Rung(entry["setting"], entry["cost"], entry["error"]) for entry in entries]
    settings = [rung.setting for rung in rungs]
    if own not in settings:
        return None
    return Ladder(tuple(rungs[settings.index(own) :]), MEASURES[measured_in], measured_in)
