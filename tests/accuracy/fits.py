"""The meshes among which `tensormass run` chooses, with cost and error: fits.yaml, made of committed results.

python -m accuracy.fits

On the CPU they are the resolutions of the demo that `tensormass trade` measured without another change, on a GPU its
meshes in press-cuda.json. The error is that of a probe that stays 12 mm deep, its radius. `make trade` makes the file
too.
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import yaml

from tensormass_tools import fits, presets

FOLDER = Path(__file__).parent / "results"
_PRESS = re.compile(r"graded linear selective ([\d.]+), (\d+) Hz, CG ([\d.]+)")


def made() -> dict[str, list[dict[str, Any]]]:
    """Returns the content of the file: meshes by backend, from fine to coarse."""
    return {"cpu": _on_cpu(), "cuda": _on_gpu()}


def write() -> None:
    """Writes the file."""
    head = (
        "# Made by `python -m accuracy.fits` of tests/accuracy/results; do not edit.\n"
        "# cost: 99th percentile of a step, relative to the first line.\n"
        "# error: of the force on a held probe, relative.\n"
    )
    fits.FILE.write_text(head + yaml.safe_dump(made(), sort_keys=False))
    print(f"wrote {fits.FILE}")


def _on_cpu() -> list[dict[str, Any]]:
    lines = (FOLDER / "trade-demo-cpu.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines[1:]]
    found = [
        (of["setting"].get("resolution", 1.0), of)
        for of in rows
        if of["setting"].keys() <= {"resolution"} and of["errors"]
    ]
    coarser = sorted(((r, of) for r, of in found if r <= 1), key=lambda pair: -pair[0])
    return _rungs([(of["setting"], _slow_s(of), of["errors"]["force_held"]) for _, of in coarser])


def _slow_s(row: dict[str, Any]) -> float:
    """The 99th percentile of a step [s], scaled by the machine's speed at that moment like `cost_s`."""
    costs = row["costs"]
    return float(row["cost_s"] * costs["step_p99_s"] / costs["step_p50_s"])


def _on_gpu() -> list[dict[str, Any]]:
    """Meshes up to the demo's own at its rate, the tightest tolerance of each; then the scene file as it is."""
    own = presets.FOR_BACKEND["cuda"]["demo"]
    rate_hz = round(1 / float(own["dt_s"]))
    rows = json.loads((FOLDER / "press-cuda.json").read_text())["rows"]
    found: dict[float, tuple[float, dict[str, Any]]] = {}
    whole_file = None
    for row in rows:
        if not (match := _PRESS.fullmatch(row["setting"])):
            continue
        resolution, rate, tolerance = map(float, match.groups())
        if rate == rate_hz and resolution <= float(own["resolution"]):
            found[resolution] = min(found.get(resolution, (tolerance, row)), (tolerance, row), key=lambda pair: pair[0])
        elif resolution == 1 and rate == 60:
            whole_file = row
    assert whole_file is not None
    own_tolerance = found[float(own["resolution"])][0]
    measured = []
    for resolution, (tolerance, row) in sorted(found.items(), reverse=True):
        setting = {**own, "resolution": resolution}
        if resolution == 1:
            del setting["resolution"]  # the scene file's own
        if tolerance != own_tolerance:
            setting["cg_tolerance"] = tolerance
        measured.append((setting, row["step_p99_ms"], row["held_deep"]))
    return _rungs([*measured, ({}, whole_file["step_p99_ms"], whole_file["held_deep"])])


def _rungs(measured: list[tuple[dict[str, Any], float, float]]) -> list[dict[str, Any]]:
    first = measured[0][1]
    return [
        {"setting": setting, "cost": float(f"{slow / first:.3g}"), "error": float(f"{error:.3g}")}
        for setting, slow, error in measured
    ]


if __name__ == "__main__":
    write()
    sys.exit(0)
