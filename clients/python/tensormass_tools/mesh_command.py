"""`tensormass mesh`: makes a volume from a closed surface, or repairs and converts one."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from tensormass import (
    InvalidArgumentError,
    MeshFileWarning,
    VolumeMesh,
    guess_unit_m,
    mesh_quality,
    read_mesh,
    read_surface,
    repair_mesh,
    tetrahedralize,
    write_mesh,
)
from tensormass._shared.mesh_names import check_holds_volumes
from tensormass_tools.output import check_writable, print_json, quality_text

Length = Callable[[str], float]


def add_arguments(parser: argparse.ArgumentParser, length_m: Length) -> None:
    """Adds the options. `length_m` parses a length such as 8mm."""

    def unit_m(text: str) -> float:
        return length_m(text if text.strip()[:1].isdigit() or text.strip()[:1] in ".+" else f"1{text.strip()}")

    parser.add_argument("input", type=Path, help=".obj, .stl, .ply, .vtp, .msh, .vtk, .vtu, .inp ...")
    parser.add_argument("-o", "--output", type=Path, required=True, help=".msh, .vtk, .vtu, .inp")
    parser.add_argument("--edge", type=length_m, metavar="LENGTH", help="edge of the tetrahedra, such as 8mm")
    parser.add_argument(
        "--unit", type=unit_m, metavar="UNIT", help="the input's unit of length, such as mm; default: m, with a guess"
    )
    parser.add_argument("--largest", action="store_true", help="keep the largest of several separate parts alone")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    check_holds_volumes(args.output)
    check_writable("--output", args.output)
    unit_m = 1.0 if args.unit is None else args.unit
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", MeshFileWarning)
        mesh = _made(args, unit_m)
        mesh = replace(mesh, nodes=mesh.nodes * unit_m)
        write_mesh(args.output, mesh)
    notes = [f"{args.input}: {note}" for note in mesh.notes]
    for warning in caught:
        said = str(warning.message)
        if not issubclass(warning.category, MeshFileWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        # The notes of a volume are those of its mesh; surfaces and outputs have none.
        elif said.startswith(str(args.output)) or (args.edge is not None and said.startswith(str(args.input))):
            notes.append(said)
    notes = list(dict.fromkeys(notes))
    quality = mesh_quality(mesh)
    if args.json:
        print_json({"output": str(args.output), **asdict(quality), "notes": notes})
    else:
        print(f"{args.output}: {quality_text(quality)}")
    for note in notes:
        print(f"tensormass: {note}", file=sys.stderr)
    size_m = np.ptp(mesh.nodes, axis=0)
    if guess_unit_m(mesh.nodes) is not None:
        size = " × ".join(f"{length:.3g}" for length in size_m)
        print(
            f"tensormass: {args.output}: is {size} m large; if {args.input} has millimetres, give --unit 1mm",
            file=sys.stderr,
        )
    return 0


def _made(args: argparse.Namespace, unit_m: float) -> VolumeMesh:
    if args.edge is None:
        try:
            return repair_mesh(read_mesh(args.input), largest=args.largest)
        except InvalidArgumentError as error:
            if str(args.input) in str(error):
                raise
            raise InvalidArgumentError(f"{args.input}: {error}") from error
    surface = read_surface(args.input)
    return tetrahedralize(surface, args.edge / unit_m, largest=args.largest)
