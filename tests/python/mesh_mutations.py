"""Reads damaged mesh files and label maps, thousands a reader, and reports each that is neither read nor refused.

    python tests/python/mesh_mutations.py --count 100000 --seed 7
    python tests/python/mesh_mutations.py gmsh --count 1 --seed 7 --first 4711     # one of them again

The mutations follow from the seed and their number alone. Each reader runs in a process with a limit of memory.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

import label_files
import mesh_texts as texts
import numpy as np

from tensormass._src import mesh_writing, meshes
from tensormass._src.grids import grid
from tensormass._src.label_formats import content
from tensormass._src.label_formats import reading as label_reading
from tensormass._src.mesh_formats import finish, limits, reading
from tensormass._src.mesh_formats.raw import FormatError

#: Mutations a reader in `make test`.
COUNT = 2000
#: CPU time of one small file that counts as never [s].
MAX_CPU_S = 5.0
# Numbers that mislead readers.
_NUMBERS = (
    b"0",
    b"-1",
    b"1",
    b"7",
    b"255",
    b"65536",
    b"2147483648",
    b"4294967295",
    b"99999999999999999999",
    b"1e9",
    b"nan",
)
_WORD = re.compile(rb"[0-9][0-9.eE+-]*")


def samples() -> dict[str, list[tuple[str, bytes]]]:
    """Returns files by their reader: name and content."""
    mesh = grid([1, 1, 1], [1.0, 1.0, 1.0])
    cells = [*((10, nodes) for nodes in texts.TETRAHEDRA), (11, texts.VOXEL)]
    data = "CELL_DATA 7\nSCALARS set:a long\nLOOKUP_TABLE default\n1 0 0 0 0 0 0\nFIELD f 1\npoisson_ratio 1 7 double\n"
    sets = (
        "*NSET, NSET=a, GENERATE\n1, 7, 2\n*NSET, NSET=b\na, 8\n*ELSET, ELSET=E\n1, 2\n*ELEMENT, TYPE=S3\n9, 1, 2, 4\n"
    )
    turned = "*Instance, name=P-1, part=P\n1, 0, 0\n1, 0, 0, 1, 0, 1, 90\n*End Instance\n"
    found = {
        "gmsh": [("m.msh", text.encode()) for text in (texts.gmsh1(), texts.gmsh22(), texts.gmsh40(), texts.gmsh41())],
        "vtk_legacy": [
            ("m.vtk", texts.legacy_vtk(cells, "3.0", data + ".1 .1 .1 .1 .1 .1 .1\n").encode()),
            ("m.vtk", texts.legacy_vtk(cells, "5.1").encode()),
            ("s.vtk", texts.POLYDATA.format(version="3.0", parts=texts.OLD_PARTS).encode()),
            ("s.vtk", texts.POLYDATA.format(version="5.1", parts=texts.NEW_PARTS).encode()),
        ],
        "vtk_xml": [("m.vtu", texts.vtu(cells).encode()), ("m.vtu", texts.lzma_vtu().encode())],
        "abaqus": [
            ("m.inp", texts.abaqus(sets).encode()),
            ("m.inp", texts.assembly(turned, "*Nset, nset=h, instance=P-1\n1, Top\n").encode()),
        ],
        "medit": [("m.mesh", texts.medit(more="Corners\n1\n1\nTriangles\n1\n1 2 4 1\n").encode())],
        "tetgen": [("t.ele", texts.tetgen_elements().encode())],
        "stl": [("s.stl", texts.STL.encode())],
        "ply": [("s.ply", texts.PLY.encode())],
        "off": [("s.off", texts.OFF.encode())],
        "obj": [("s.obj", texts.OBJ.replace("1//1", "1/1/1").encode())],
    }
    with tempfile.TemporaryDirectory() as folder:
        masks = {"set:a": np.arange(len(mesh.nodes)) % 2}
        content = mesh_writing.Content(mesh.nodes, mesh.blocks, masks, {"poisson_ratio": np.full(6, 0.3)})
        for ending, reader in ((".msh", "gmsh"), (".vtk", "vtk_legacy"), (".vtu", "vtk_xml")):
            path = Path(folder) / f"b{ending}"
            mesh_writing.write_volume(path, content, path)
            found[reader].append((path.name, path.read_bytes()))
        square = meshes.TriangleSurface.from_arrays(texts.POINTS[:4], [[0, 1, 3], [0, 3, 2]])
        for ending in ("ply", "stl"):
            path = Path(folder) / f"s.{ending}"
            mesh_writing.write_surface(path, square, path)
            found[ending].append((path.name, path.read_bytes()))
    return found | label_samples()


def label_samples() -> dict[str, list[tuple[str, bytes]]]:
    """Returns label maps by their reader. Packed ones are few, because damage to them mostly breaks the packing."""
    spacing = (6e-3, 8e-3, 9e-3)
    voxels, affine = label_files.shape(spacing), label_files.oblique(spacing)
    more = (
        "Segment0_Name:=a\nSegment0_LabelValue:=1\nSegment0_Layer:=1\nSegment0_Tags:=x|TerminologyEntry:a~b^c^d~e^f^g~|"
    )
    with tempfile.TemporaryDirectory() as folder:
        files = [
            label_files.nrrd(Path(folder) / "a.nrrd", voxels, affine, encoding="raw", names={1: "liver", 2: "b"}),
            label_files.nrrd(Path(folder) / "b.nrrd", np.stack([voxels, voxels]), affine, encoding="raw", more=more),
            label_files.nrrd(Path(folder) / "c.nrrd", voxels, affine, encoding="ascii", unit="um"),
            label_files.nrrd(Path(folder) / "d.nrrd", voxels.astype("f4"), affine, order=">"),
            label_files.nifti(Path(folder) / "a.nii", voxels, affine),
            label_files.nifti(Path(folder) / "b.nii", voxels.astype("f4"), affine, form="both", slope=1.0),
            label_files.nifti(Path(folder) / "c.nii", voxels.astype("i2"), affine, form="qform", version=2, order=">"),
            label_files.nifti(Path(folder) / "d.nii.gz", voxels, affine, form="none"),
        ]
        # Most of a file is voxels, and any byte is a label, so the headers get more damage in files of few voxels.
        return {
            reader: [(path.name, path.read_bytes()) for path in files if label_reading.reader_of(path) == reader]
            for reader in ("nrrd", "nifti")
        }


def mutated(content: bytes, chance: random.Random) -> bytes:
    """Returns a damaged copy."""
    out = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 4))):
        at = chance.randrange(len(out) + 1)
        to = min(len(out), at + chance.choice((1, 2, 8, 40)))
        kind = chance.randrange(8)
        if kind == 0:
            out[at:to] = b""
        elif kind == 1:
            out[at:at] = out[at:to]
        elif kind == 2:
            out[at:] = b""
        elif kind == 3:
            out[at:to] = chance.randbytes(to - at)
        elif kind == 4 and at < len(out):
            out[at] ^= 1 << chance.randrange(8)
        elif kind in (5, 6):
            words = [match.span() for match in _WORD.finditer(out)]
            if words:
                first, last = chance.choice(words)
                out[first:last] = chance.choice(_NUMBERS)
        else:
            lines = bytes(out).split(b"\n")
            i, j = chance.randrange(len(lines)), chance.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
            out = bytearray(b"\n".join(lines))
    return bytes(out)


class LateError(Exception):
    """A file took too long."""


@contextlib.contextmanager
def _watched() -> Iterator[None]:
    def late(*_: object) -> None:
        raise LateError(f"more than {MAX_CPU_S:g} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, MAX_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _check(path: Path) -> bool:
    """Reads a file and makes a volume and a surface of it. Returns whether one was made, whose numbers make sense."""
    if label_reading.reader_of(path) is not None:
        return _check_labels(path)
    was_read = False
    raw = None
    for make in (finish.volume, finish.surface):
        try:
            raw = reading.read(path) if raw is None else raw
            found = make(raw, str(path))
        except FormatError as error:
            if str(path.parent) not in str(error):
                raise AssertionError(f"the reason names no file: {error}") from error
            if raw is None:
                break
            continue
        blocks = [nodes for _, nodes in found.blocks] if isinstance(found, finish.Volume) else [found.triangles]
        assert np.isfinite(found.points).all(), "a point is not finite"
        for nodes in blocks:
            assert nodes.size, "a block is empty"
            assert 0 <= nodes.min() <= nodes.max() < len(found.points), "an index is outside"
        was_read = True
    return was_read


def _check_labels(path: Path) -> bool:
    try:
        labels = label_reading.read(path)
    except FormatError as error:
        if str(path.parent) not in str(error):
            raise AssertionError(f"the reason names no file: {error}") from error
        return False
    assert labels.voxels.ndim == 4
    assert 0 < labels.voxels.size <= content.MAX_VOXELS
    assert np.isfinite(labels.affine).all(), "a place is not finite"
    assert abs(np.linalg.det(labels.affine[:3, :3])) > 0, "a voxel has no volume"
    for segment in labels.segments:
        assert segment.layer < len(labels.voxels)
    return True


def run(reader: str, count: int, seed: int, first: int = 0) -> tuple[int, list[str]]:
    """Reads mutations of one reader. Returns how many were read, and what went wrong."""
    files = samples()[reader]
    was_read, wrong = 0, []
    with tempfile.TemporaryDirectory() as folder:
        if reader == "tetgen":
            (Path(folder) / "t.node").write_text(texts.tetgen_nodes())
        for number in range(first, first + count):
            chance = random.Random(f"{seed} {reader} {number}")
            name, content = files[number % len(files)]
            path = Path(folder) / name
            if reader == "tetgen" and number % 2:
                (path.with_suffix(".node")).write_bytes(mutated(texts.tetgen_nodes().encode(), chance))
            path.write_bytes(mutated(content, chance))
            try:
                with _watched():
                    was_read += _check(path)
            except Exception as error:
                last = traceback.extract_tb(error.__traceback__)[-1]
                wrong.append(
                    f"{reader} {number}: {type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"
                )
            if reader == "tetgen" and number % 2:
                path.with_suffix(".node").write_text(texts.tetgen_nodes())
    return was_read, wrong


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("reader", nargs="?", choices=list(samples()), help="default: all of them")
    parser.add_argument("--count", type=int, default=COUNT, help="mutations a reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    args = parser.parse_args()
    if args.reader is None:
        results = [
            subprocess.run(
                [
                    sys.executable,
                    __file__,
                    reader,
                    f"--count={args.count}",
                    f"--seed={args.seed}",
                    f"--first={args.first}",
                ]
            ).returncode
            for reader in samples()
        ]
        return int(any(results))
    limits.limit_memory(Path(__file__))
    start = time.perf_counter()
    was_read, wrong = run(args.reader, args.count, args.seed, args.first)
    for line in wrong[:20]:
        print(line)
    took = time.perf_counter() - start
    print(f"{args.reader}: {args.count} files, {was_read} read, {len(wrong)} neither read nor refused, {took:.1f} s")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
