"""The output of `tensormass modes`: a table, and shapes as VTU or NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass import ElementBlock, InvalidArgumentError, VolumeMesh, write_fields
from tensormass._shared.files import replacing
from tensormass_tools.modes_solver import Modes
from tensormass_tools.output import table

ENDINGS = (".vtu", ".npz")


def write(path: Path, names: Sequence[str], volumes: Sequence[VolumeMesh], modes: Sequence[Modes]) -> None:
    """Writes the shapes of all bodies.

    `.vtu`: the mesh at rest, with point data `mode_001` ... [node_count, 3] and the cell data `body`. A body with fewer
    modes has zeros. `.npz`: for each body `<body>/frequency_hz` [mode], `<body>/shapes` [mode, node_count, 3] and
    `<body>/positions` [node_count, 3] m.

    Raises:
        InvalidArgumentError: the file cannot be written.
    """
    if path.suffix == ".npz":
        _write_arrays(path, names, volumes, modes)
        return
    starts = np.cumsum([0, *(len(volume.nodes) for volume in volumes)]).tolist()
    blocks = [
        ElementBlock(shape, elements + np.uint32(start))
        for volume, start in zip(volumes, starts, strict=False)
        for shape, elements in volume.blocks
    ]
    counts = [volume.element_count for volume in volumes]
    points = np.concatenate([volume.nodes for volume in volumes])
    nodes: dict[str, npt.NDArray[np.generic]] = {}
    for index in range(max(len(of.shapes) for of in modes)):
        shape = np.zeros_like(points)
        for of, start in zip(modes, starts, strict=False):
            if index < len(of.shapes):
                shape[start : start + of.shapes.shape[1]] = of.shapes[index]
        nodes[f"mode_{index + 1:03d}"] = shape
    write_fields(path, VolumeMesh(points, tuple(blocks)), nodes, {"body": np.repeat(np.arange(len(counts)), counts)})


def _write_arrays(path: Path, names: Sequence[str], volumes: Sequence[VolumeMesh], modes: Sequence[Modes]) -> None:
    arrays: dict[str, Any] = {}
    for name, volume, of in zip(names, volumes, modes, strict=True):
        arrays |= {
            f"{name}/frequency_hz": of.frequency_hz,
            f"{name}/shapes": of.shapes,
            f"{name}/positions": volume.nodes,
        }
    try:
        with replacing(path) as aside:
            np.savez_compressed(aside, **arrays)
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error


def text(summary: dict[str, Any]) -> str:
    """Formats the summary for people."""
    sections = []
    for body in summary["bodies"]:
        rows = [["mode", "frequency", "damping", "mass along x", "y", "z"]]
        for number, mode in enumerate(body["modes"], start=1):
            shares = [f"{100 * mass / body['mass_kg']:.1f} %" for mass in mode["effective_mass_kg"]]
            damping = "-" if mode["damping_ratio"] is None else f"{100 * mode['damping_ratio']:.3g} %"
            frequency = f"{mode['frequency_hz']:.6g} Hz" if mode["frequency_hz"] > 0 else "rigid"
            rows.append([str(number), frequency, damping, *shares])
        head = (
            f"{summary['scene']}, body {body['name']}: {body['node_count']} nodes, "
            f"{body['free_direction_count']} free directions, {body['mass_kg']:.4g} kg"
        )
        sections.append(f"{head}\n{table(rows)}")
    if summary["warnings"]:
        sections.append("warnings:\n" + "\n".join(f"  {text}" for text in summary["warnings"]))
    if summary["files"]:
        sections.append("written: " + ", ".join(summary["files"]))
    return "\n\n".join(sections)
