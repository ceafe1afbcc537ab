"""Chooses the reader of a mesh file, by its ending and its first bytes."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from tensormass._src.mesh_formats import finish
from tensormass._src.mesh_formats.raw import FormatError, Raw

#: [ending]: module of this folder that reads it.
READERS = {
    ".msh": "gmsh",
    ".vtk": "vtk_legacy",
    ".vtu": "vtk_xml",
    ".vtp": "vtk_xml",
    ".inp": "abaqus",
    ".mesh": "medit",
    ".meshb": "medit",
    ".ele": "tetgen",
    ".node": "tetgen",
    ".stl": "stl",
    ".ply": "ply",
    ".off": "off",
    ".obj": "obj",
}
# Bytes that tell a format whatever the ending is.
_FIRST_BYTES = {b"$NOD": "gmsh", b"$MeshFormat": "gmsh", b"# vtk DataFile": "vtk_legacy", b"<VTKFile": "vtk_xml"}


def read(path: Path) -> Raw:
    """Reads a file as it is.

    Raises:
        FormatError: an unknown format, or a file that cannot be read.
    """
    with path.open("rb") as file:
        first = file.read(64)
    ending = path.suffix.lower()
    if ending == ".msh" and first[:1] == b"(":
        raise FormatError(f"{path}: a mesh of ANSYS (Fluent) is not read; save it as Gmsh, VTK or Abaqus")
    name = next((reader for mark, reader in _FIRST_BYTES.items() if first.startswith(mark)), READERS.get(ending))
    if name is None:
        raise FormatError(
            f"{path}: files of this ending are not read; known are {', '.join(READERS)}. Convert it "
            "(`meshlane convert`), or give the mesh of meshlane or meshio to Scene.from_meshio"
        )
    with np.errstate(all="ignore"):
        raw: Raw = importlib.import_module(f"tensormass._src.mesh_formats.{name}").read(path)
    return raw


def read_volume(path: Path) -> finish.Volume:
    """Reads a volume. Raises FormatError."""
    raw = read(path)
    with np.errstate(all="ignore"):
        return finish.volume(raw, str(path))


def read_surface(path: Path) -> finish.Surface:
    """Reads a surface. Raises FormatError."""
    raw = read(path)
    with np.errstate(all="ignore"):
        return finish.surface(raw, str(path))
