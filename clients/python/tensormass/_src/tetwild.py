"""Volume meshes from closed surfaces, by fTetWild."""

from __future__ import annotations

import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from tensormass._shared.errors import InvalidArgumentError, MeshFileWarning
from tensormass._shared.extras import require
from tensormass._shared.processes import ChildProcess
from tensormass._src.mesh_repair import repair_mesh
from tensormass._src.meshes import TriangleSurface, VolumeMesh

# fTetWild needs hours for more, and says nothing meanwhile.
_MOST_TETRAHEDRA = 1e7


def tetrahedralize(surface: TriangleSurface, edge_length: float, *, largest: bool = False) -> VolumeMesh:
    """Fills a closed surface, dirty or not, with tetrahedra (fTetWild); takes seconds to minutes.

    fTetWild draws random numbers, so the mesh differs from run to run. Keep the result.

    Args:
        edge_length: wanted length of an edge, in the surface's unit. The boundary stays within a twentieth of it
            from the surface.
        largest: keeps the largest of several parts alone. Otherwise all are kept, but for crumbs below a hundredth of
            the largest one. A MeshFileWarning names what is kept and dropped, as do the mesh's notes.

    Raises:
        InvalidArgumentError: an edge that is not positive, longer than the surface or far too short, or nothing
            enclosed.
        NotFoundError: the extra `tetrahedra` is not installed.
    """
    require("tetrahedra", "filling a surface with tetrahedra")
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if not 0 < edge_length < diagonal:
        raise InvalidArgumentError(
            f"edge length {edge_length:g}: must be positive and below the surface's diagonal, {diagonal:g}"
        )
    volume = _enclosed_volume(surface)
    # A regular tetrahedron has a volume of edge³ / (6 √2).
    expected = 6 * np.sqrt(2) * volume / edge_length**3
    if expected > _MOST_TETRAHEDRA:
        size = " × ".join(f"{length:g}" for length in np.ptp(surface.vertices, axis=0))
        raise InvalidArgumentError(
            f"edge length {edge_length:g}: a surface of {size} would get about {expected:.0e} tetrahedra; take a longer"
            " edge, or give both in the same unit of length (`tensormass mesh --unit 1mm` for one in millimetres)"
        )
    # Runs in its own process, because the mesher writes files into its working directory, prints, and may exit.
    with tempfile.TemporaryDirectory() as folder:
        surface_file, volume_file = Path(folder) / "surface.npz", Path(folder) / "volume.npz"
        np.savez(surface_file, vertices=surface.vertices, triangles=surface.triangles.astype(np.int32))
        run = [sys.executable, "-P", "-c", _TETWILD]
        run += [str(surface_file), str(volume_file), str(edge_length), str(edge_length / 20 / diagonal)]
        with tempfile.TemporaryFile() as log:
            mesher = ChildProcess(run, output=log, folder=folder)
            try:
                mesher.process.wait()
            finally:
                status = mesher.stop()
            log.seek(0)
            words = log.read().decode(errors="replace").strip()
        if status != 0 or not volume_file.is_file():
            reason = (words or f"it ended with status {status}").splitlines()[-1]
            raise InvalidArgumentError(f"fTetWild could not mesh the surface: {reason}")
        with np.load(volume_file) as volume:
            nodes, tetrahedra = volume["nodes"], volume["tetrahedra"]
    if len(tetrahedra) == 0:
        raise InvalidArgumentError("the surface encloses no volume; close its holes first")
    mesh = repair_mesh(VolumeMesh.from_tetrahedra(nodes, tetrahedra, "result of fTetWild"), largest=largest)
    parts = [note for note in mesh.notes if "separate part" in note]
    if parts:
        warnings.warn(f"the surface: {'; '.join(parts)}", MeshFileWarning, stacklevel=2)
    return replace(mesh, notes=tuple(parts))


def _enclosed_volume(surface: TriangleSurface) -> float:
    """Returns the volume within a closed surface; too small a one if the surface is open or not oriented."""
    a, b, c = np.moveaxis((surface.vertices - surface.vertices.mean(axis=0))[surface.triangles], 1, 0)
    return abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6


# Without `coarsen`, edges get no longer than those of the input.
_TETWILD = """
import sys
import numpy as np
from pytetwild import tetrahedralize
surface = np.load(sys.argv[1])
nodes, tetrahedra = tetrahedralize(
    surface["vertices"], surface["triangles"], edge_length_abs=float(sys.argv[3]), epsilon=float(sys.argv[4]),
    coarsen=True, quiet=True)
np.savez(sys.argv[2], nodes=nodes, tetrahedra=tetrahedra)
"""
