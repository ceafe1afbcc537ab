"""Prints a table: each mesh file of some folders, and what each reader makes of it.

    python tests/python/mesh_table.py                          # ../shared/meshes, PyVista's examples, what VTK writes
    python tests/python/mesh_table.py FOLDER ... --json FILE    # CalculiX's examples, your own files

Readers are ours, VTK, meshio and meshlane, as far as they are installed; `--vtk PYTHON` adds what the VTK of another
interpreter writes. A row says elements with a volume, other cells, sets and volume, or why a file is refused. The last
lines count the files. The exit status is 1 if a file disagrees: another program sees another volume than we do.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tensormass._shared.errors import TensormassError
from tensormass._src import mesh_files, mesh_geometry
from tensormass._src.mesh_formats.reading import READERS

ROOT = Path(__file__).resolve().parents[2]
# Relative difference of volumes above which two readers disagree. VTK adds up other triangles of warped faces.
_TOLERANCE = 1e-3
_MAX_REASON = 110
#: Writes files in every mode and with every compressor of the VTK that runs it.
_WRITE = """
import sys, vtk
folder = sys.argv[1]
version = vtk.vtkVersion().GetVTKVersion()
points = vtk.vtkPoints()
for z in range(3):
    for y in range(2):
        for x in range(2):
            points.InsertNextPoint(x, y, z)
grid = vtk.vtkUnstructuredGrid()
grid.SetPoints(points)
for kind, nodes in [(11, range(8)), (13, (4, 5, 7, 8, 9, 11)), (13, (4, 7, 6, 8, 11, 10))]:
    ids = vtk.vtkIdList()
    for node in nodes:
        ids.InsertNextId(node)
    grid.InsertNextCell(kind, ids)
label = vtk.vtkIdTypeArray()
label.SetName("label")
for value in (1, 2, 2):
    label.InsertNextValue(value)
grid.GetCellData().AddArray(label)
for mode in ("Ascii", "Binary", "Appended"):
    for compressor in ("None", "ZLib", "LZ4", "LZMA"):
        writer = vtk.vtkXMLUnstructuredGridWriter()
        writer.SetFileName(f"{folder}/vtk-{version}-{mode}-{compressor}.vtu")
        writer.SetInputData(grid)
        getattr(writer, f"SetDataModeTo{mode}")()
        getattr(writer, f"SetCompressorTypeTo{compressor}")()
        writer.Write()
for kind in ("ASCII", "Binary"):
    for old in (0, 1):
        writer = vtk.vtkUnstructuredGridWriter()
        writer.SetFileName(f"{folder}/vtk-{version}-{kind}-{'4.2' if old else '5.1'}.vtk")
        writer.SetInputData(grid)
        getattr(writer, f"SetFileTypeTo{kind}")()
        if hasattr(writer, "SetFileVersion"):
            writer.SetFileVersion(42 if old else 51)
        writer.Write()
"""


@dataclass
class Read:
    """What one reader makes of a file."""

    reader: str
    elements: int = 0
    others: int = 0
    sets: int = 0
    volume: float = 0.0
    #: Why it is refused, or what is left out.
    said: str = ""

    @property
    def is_refused(self) -> bool:
        return self.elements == 0 and self.others == 0


def _ours(path: Path) -> Read:
    try:
        mesh = mesh_files.read_mesh(path)
    except TensormassError as error:
        reason = str(error)
        try:
            surface = mesh_files.read_surface(path)
        except TensormassError as other:
            # The reason of a surface that is damaged is that of the surface.
            return Read("tensormass", said=str(other) if "holds a surface" in reason else reason)
        return Read("tensormass", 0, len(surface.triangles), 0, 0.0, "a surface")
    volume = float(mesh_geometry.signed_volumes(mesh).sum())
    return Read("tensormass", mesh.element_count, 0, len(mesh.sets), volume, "; ".join(mesh.notes))


def _by_meshio(library: str) -> Callable[[Path], Read]:
    def read(path: Path) -> Read:
        module = importlib.import_module(library)
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
            try:
                mesh = module.read(path)
            except BaseException as error:
                return Read(library, said=f"{type(error).__name__}: {error}")
        kinds = {"tetra", "tetra10", "hexahedron", "hexahedron20", "wedge", "pyramid"}
        others = sum(len(cells.data) for cells in mesh.cells if cells.type not in kinds)
        try:
            volume_mesh = mesh_files.from_meshio(mesh)
        except (TensormassError, ValueError, IndexError) as error:
            return Read(library, 0, others, 0, 0.0, str(error) if not others else "")
        volume = float(mesh_geometry.signed_volumes(volume_mesh).sum())
        return Read(library, volume_mesh.element_count, others, len(volume_mesh.sets), volume)

    return read


def _by_vtk(path: Path) -> Read:
    import pyvista

    if path.suffix not in (".vtk", ".vtu", ".vtp", ".stl", ".ply", ".obj"):
        return Read("vtk", said="not a format of VTK")
    try:
        grid = pyvista.read(path)
        if isinstance(grid, pyvista.PolyData):
            return Read("vtk", 0, grid.n_cells)
        cells = grid.cast_to_unstructured_grid()
    except Exception as error:
        return Read("vtk", said=f"{type(error).__name__}: {error}")
    solid = np.isin(cells.celltypes, (10, 11, 12, 13, 14, 24, 25, 26, 27, 29))
    volume = float(np.abs(cells.compute_cell_sizes()["Volume"])[solid].sum()) if solid.any() else 0.0
    return Read("vtk", int(solid.sum()), int((~solid).sum()), 0, volume)


def readers() -> list[Callable[[Path], Read]]:
    """Returns the readers that are installed; ours comes first."""
    found: list[Callable[[Path], Read]] = [_ours]
    if importlib.util.find_spec("pyvista"):
        found.append(_by_vtk)
    return found + [_by_meshio(name) for name in ("meshio", "meshlane") if importlib.util.find_spec(name)]


def files(folders: Iterable[Path]) -> list[Path]:
    """Returns the files of known endings in folders; a file stands for itself."""
    found = []
    for folder in folders:
        inside = sorted(folder.rglob("*")) if folder.is_dir() else [folder]
        found += [
            path for path in inside if path.is_file() and path.suffix.lower() in READERS and path.suffix != ".node"
        ]
    return found


def disagrees(reads: list[Read]) -> bool:
    """Tells whether another reader found more volume than ours. Less is usual: some leave out what they do not know."""
    own = reads[0]
    if own.is_refused:
        return False
    return any(other.volume > own.volume * (1 + _TOLERANCE) + 1e-300 for other in reads[1:])


def _default_folders(folder: Path, pythons: list[str]) -> list[Path]:
    found = [ROOT.parent / "shared" / "meshes"]
    if (spec := importlib.util.find_spec("pyvista")) is not None and spec.origin:
        found.append(Path(spec.origin).parent / "examples")
    for python in [sys.executable, *pythons]:
        ran = subprocess.run([python, "-c", _WRITE, str(folder)], capture_output=True, text=True)
        if ran.returncode:
            print(f"skipped: {python} has no VTK that writes ({ran.stderr.strip().splitlines()[-1:]})", file=sys.stderr)
    return [path for path in [*found, folder] if path.exists()]


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="*", type=Path, help="default: what is beside the checkout or installed")
    parser.add_argument("--vtk", action="append", default=[], metavar="PYTHON", help="an interpreter with another VTK")
    parser.add_argument("--json", type=Path, help="writes all rows to a file")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        folders = args.folders or _default_folders(Path(folder), args.vtk)
        rows = [(path, [read(path) for read in readers()]) for path in files(folders)]
    print("| file | reader | elements | other cells | sets | volume | said |\n|---|---|---|---|---|---|---|")
    for path, reads in rows:
        for read in reads:
            said = " ".join(read.said.replace(str(path), path.name).split()).replace("|", "/")
            said = said if len(said) <= _MAX_REASON else said[:_MAX_REASON] + "…"
            numbers = f"{read.elements} | {read.others} | {read.sets} | {read.volume:.5g}"
            print(f"| {path.name} | {read.reader} | {numbers} | {said} |")
    wrong = [path.name for path, reads in rows if disagrees(reads)]
    for index, read in enumerate(rows[0][1] if rows else []):
        refused = sum(reads[index].is_refused for _, reads in rows)
        print(f"{read.reader}: {len(rows)} files, {len(rows) - refused} read, {refused} refused")
    print(f"{len(wrong)} files in which another reader found more volume: {', '.join(wrong) or 'none'}")
    if args.json:
        table = [{"file": path.name, "reads": [asdict(read) for read in reads]} for path, reads in rows]
        args.json.write_text(json.dumps(table, indent=1))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
