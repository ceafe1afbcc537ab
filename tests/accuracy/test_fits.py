"""The meshes among which `tensormass run` chooses are those of the results."""

from __future__ import annotations

import yaml

from tensormass_tools import fits as committed

from . import fits


def test_the_committed_meshes_are_those_of_the_results() -> None:
    assert yaml.safe_load(committed.FILE.read_text("utf-8")) == fits.made(), "run `python -m accuracy.fits` in tests/"


def test_meshes_go_from_fine_to_coarse() -> None:
    for backend, rungs in fits.made().items():
        resolutions = [rung["setting"].get("resolution", 1) for rung in rungs]
        assert resolutions == sorted(resolutions, reverse=True), backend
        assert rungs[-1]["cost"] < 1
        assert rungs[-1]["error"] > rungs[0]["error"]
