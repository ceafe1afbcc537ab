"""`tensormass organ`: makes a scene of the segments of a label map, or of a closed surface."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tensormass import LABEL_ENDINGS, InvalidArgumentError, NotFoundError, read_labels
from tensormass._shared.extras import require
from tensormass_tools import organ_bodies, organ_gaps, organ_scene, segments, tissues
from tensormass_tools.output import check_writable, print_json

Length = Callable[[str], float]
_SURFACES = (".stl", ".obj", ".ply", ".vtp", ".vtk", ".off")


def add_arguments(parser: argparse.ArgumentParser, length_m: Length) -> None:
    """Adds the options. `length_m` parses a length such as 8mm."""

    def unit_m(text: str) -> float:
        return length_m(text if text.strip()[:1].isdigit() or text.strip()[:1] in ".+" else f"1{text.strip()}")

    def positive(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not 0 < value < 1e12:
            raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of pascals such as 5000")
        return value

    parser.add_argument(
        "input", type=Path, help=".seg.nrrd, .nrrd, .nii, .nii.gz; or a surface: .stl, .obj, .ply, .vtp"
    )
    parser.add_argument(
        "--segment",
        action="append",
        default=[],
        metavar="NAME",
        help="segment that becomes a body, by its name or its label; repeat it for several; without it, lists all",
    )
    parser.add_argument("-o", "--output", type=Path, help="scene file (default: NAME.yaml); its meshes lie beside it")
    parser.add_argument("--law", choices=organ_scene.LAWS, default=organ_scene.LAWS[0], help="default: %(default)s")
    parser.add_argument(
        "--tissue",
        action="append",
        default=[],
        metavar="NAME",
        help=f"tissue whose modulus is taken ({', '.join(tissues.known())}), if the segment's name does not say it; "
        "one for all segments, or one each",
    )
    parser.add_argument("--young-modulus", type=positive, metavar="PA", help="modulus in place of the table's")
    parser.add_argument("--edge", type=length_m, metavar="LENGTH", help="edge of the tetrahedra, such as 8mm")
    parser.add_argument(
        "--support",
        action="append",
        default=[],
        metavar="NAME",
        help="segment that holds the bodies where it touches them; default: all that do and do not surround them",
    )
    parser.add_argument(
        "--unit", type=unit_m, metavar="UNIT", help="unit of the file (mm, cm, m ...) in place of its own"
    )
    parser.add_argument("--fill-holes", action="store_true", help="fill cavities of any size")
    parser.add_argument("--largest", action="store_true", help="keep the largest of several separate parts alone")


def run(args: argparse.Namespace) -> int:
    """Runs the command."""
    path: Path = args.input
    if args.segment:
        require("organs", "a scene of a segmentation")
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file")
    is_labels = path.name.lower().endswith(LABEL_ENDINGS)
    if not is_labels and path.suffix.lower() not in _SURFACES:
        known = ", ".join((*LABEL_ENDINGS, *_SURFACES))
        raise InvalidArgumentError(
            f"{path}: files of this ending are not read as segmentations; known are {known}. Save it in 3D Slicer as "
            ".seg.nrrd or .nii.gz"
        )
    if is_labels and not args.segment:
        return _list(args)
    output: Path = args.output or Path(
        f"{organ_bodies.body_name(args.segment[0] if args.segment else path.stem, [])}.yaml"
    )
    if output.suffix.lower() not in (".yaml", ".yml"):
        raise InvalidArgumentError(f"--output {output}: a scene file ends in .yaml")
    check_writable("--output", output)
    require("organs", "a scene of a segmentation")
    wish = organ_bodies.Wish(
        tuple(args.segment),
        tuple(args.tissue),
        args.young_modulus,
        args.edge,
        args.unit,
        tuple(args.support),
        args.fill_holes,
        args.largest,
    )
    start = time.perf_counter()
    bodies, notes = (organ_bodies.from_labels if is_labels else organ_bodies.from_surface)(path, wish)
    organ_gaps.separate(bodies)
    written = organ_scene.write(output, bodies, args.law, organ_scene.Source(path.name, notes))
    took_s = time.perf_counter() - start
    if args.json:
        described = [_described(body) for body in bodies]
        print_json({"output": [str(of) for of in written], "bodies": described, "notes": notes, "seconds": took_s})
    else:
        for body in bodies:
            print(_line(body))
        print(f"wrote {', '.join(map(str, written))} in {took_s:.1f} s; run it: tensormass run {output}")
    for note in notes:
        print(f"tensormass: {path}: {note}", file=sys.stderr)
    for body in bodies:
        for note in body.notes:
            print(f"tensormass: {path}: {body.title!r}: {note}", file=sys.stderr)
    return 0


def _list(args: argparse.Namespace) -> int:
    labels = organ_bodies.scaled(read_labels(args.input), args.unit)
    voxel_m3 = abs(float(np.linalg.det(labels.affine[:3, :3])))
    counts = [np.bincount(layer.reshape(-1)) for layer in labels.voxels]
    rows: list[dict[str, Any]] = []
    for segment in segments.named(labels):
        of_layer = counts[segment.layer]
        count = int(of_layer[segment.label]) if segment.label < len(of_layer) else 0
        of_name = tissues.of_segment(segment.name, segment.term)
        rows.append(
            {
                "segment": segment.name,
                "label": segment.label,
                "layer": segment.layer,
                "voxels": count,
                "volume_m3": count * voxel_m3,
                "tissue": of_name.name if of_name else None,
            }
        )
    if args.json:
        print_json({"segments": rows, "notes": labels.notes})
        return 0
    print(f"{args.input}: {len(rows)} segments; choose with --segment NAME")
    for row in rows:
        tissue = row["tissue"] or "unknown: --tissue"
        print(f"  {row['segment']}  (label {row['label']}): {1e6 * row['volume_m3']:.4g} mL, tissue {tissue}")
    for note in labels.notes:
        print(f"tensormass: {args.input}: {note}", file=sys.stderr)
    return 0


def _described(body: organ_bodies.Body) -> dict[str, object]:
    return {
        "name": body.name,
        "segment": body.title,
        "tissue": body.tissue.name,
        "young_modulus_pa": body.tissue.young_modulus_pa.value,
        "elements": body.mesh.element_count,
        "nodes": len(body.mesh.nodes),
        "edge_m": body.edge_m,
        "volume_m3": body.mesh_volume_m3,
        "file_volume_m3": body.volume_m3,
        "held_nodes": int(body.held.sum()),
        "touches": {name: int(nodes.sum()) for name, nodes in body.touches.items()},
        "notes": body.notes,
    }


def _line(body: organ_bodies.Body) -> str:
    off = 100 * (body.mesh_volume_m3 / body.volume_m3 - 1)
    return (
        f"{body.name}: {body.mesh.element_count:,} tetrahedra, {1e6 * body.mesh_volume_m3:.4g} mL ({off:+.2f} % of the "
        f"file's), {body.tissue.name}, E {body.tissue.young_modulus_pa.value:.4g} Pa, {int(body.held.sum())} nodes held"
    )
