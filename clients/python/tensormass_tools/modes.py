"""`tensormass modes`: natural frequencies and mode shapes of the bodies of a scene, at rest and for small motions.

The linear elastic limit of each law is assembled by scikit-fem and solved by SciPy (the extra `tensormass[modes]`). No
daemon is needed. Quadrature and mass matrix are those of the scene, so a free vibration that the daemon steps in small
time steps has these frequencies.

Bodies do not act on each other, so each has modes of its own. Loads, tools and gravity do not act either. Prescribed
displacements count as fixed.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from tensormass import InvalidArgumentError, Scene
from tensormass._shared.errors import naming
from tensormass._shared.extras import require
from tensormass.v1 import scene_pb2
from tensormass_tools import modes_files
from tensormass_tools.modes_matrices import SHAPES, matrices
from tensormass_tools.modes_solver import Modes, lowest_modes
from tensormass_tools.output import check_writable, print_json

# Larger numbers of modes are mistakes.
_MOST = 1000


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """Adds the options of `tensormass modes`."""
    parser.add_argument("scene", help=scene_help)
    parser.add_argument("--count", type=int, default=10, metavar="N", help="modes of each body; default: 10")
    parser.add_argument(
        "--export", type=Path, metavar="FILE", help="write the shapes: .vtu for ParaView, .npz for NumPy"
    )
    parser.description = (
        "Computes natural frequencies and mode shapes of the bodies at rest, without a daemon: undamped, without loads "
        "and tools, in the linear elastic limit of isotropic laws. Takes elements of the shapes "
        f"{', '.join(SHAPES)}. Needs scikit-fem and SciPy: pip install 'tensormass[modes]'."
    )


def run(args: argparse.Namespace) -> int:
    """Computes, writes and prints. Returns 0."""
    if not 0 < args.count <= _MOST:
        raise InvalidArgumentError(f"--count {args.count}: must be 1 to {_MOST}")
    if args.export is not None:
        if args.export.suffix not in modes_files.ENDINGS:
            raise InvalidArgumentError(f"--export {args.export}: must end in {' or '.join(modes_files.ENDINGS)}")
        check_writable("--export", args.export)
    require("modes", "modes")
    scene = Scene.from_file(args.scene).message
    if not scene.bodies:
        raise InvalidArgumentError(f"{args.scene}: has no bodies")
    volumes, found = [], []
    for body in scene.bodies:
        of = matrices(body)
        with naming(f"body {body.name!r}"):
            found.append(lowest_modes(of, args.count))
        volumes.append(of.mesh)
    if args.export is not None:
        modes_files.write(args.export, [body.name for body in scene.bodies], volumes, found)
    summary = {
        "scene": scene.name,
        "bodies": [_summary(body, modes) for body, modes in zip(scene.bodies, found, strict=True)],
        "warnings": [
            text for body, modes in zip(scene.bodies, found, strict=True) for text in _warnings(body, modes, args.count)
        ],
        "files": [str(args.export)] if args.export is not None else [],
    }
    print_json(summary) if args.json else print(modes_files.text(summary))
    return 0


def _summary(body: scene_pb2.Body, modes: Modes) -> dict[str, Any]:
    return {
        "name": body.name,
        "node_count": modes.shapes.shape[1],
        "free_direction_count": modes.free_count,
        "mass_kg": modes.mass_kg,
        "modes": [
            {
                "frequency_hz": frequency,
                "damping_ratio": _damping_ratio(body, frequency),
                "effective_mass_kg": effective,
            }
            for frequency, effective in zip(modes.frequency_hz.tolist(), modes.effective_mass_kg.tolist(), strict=True)
        ],
    }


def _damping_ratio(body: scene_pb2.Body, frequency_hz: float) -> float | None:
    """Returns the share of critical damping that the body's Rayleigh damping gives a mode; None for a rigid motion."""
    angular = 2 * math.pi * frequency_hz
    if angular == 0:
        return None
    return (body.rayleigh_mass_per_s / angular + body.rayleigh_stiffness_s * angular) / 2


def _warnings(body: scene_pb2.Body, modes: Modes, count: int) -> list[str]:
    where = f"body {body.name!r}"
    out = []
    if len(modes.shapes) < count:
        out.append(f"{where}: has no more than {len(modes.shapes)} modes, one for each free direction of a node")
    if any(law.prony for law in [body.law, *(part.law for part in body.law_regions)]):
        out.append(f"{where}: the instantaneous moduli are taken; motion slower than its Prony terms is softer")
    if body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC and body.skin.WhichOneof("source"):
        out.append(f"{where}: edges are straight here; the daemon bends those of the boundary to the skin")
    return out
