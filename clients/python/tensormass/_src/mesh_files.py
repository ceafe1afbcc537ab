"""Reads and writes mesh files: volumes of any shapes with named sets and element fields, and triangulated surfaces.

The folder mesh_formats reads each format in a process of its own, and mesh_writing.py writes. Readers keep the order of
the file's nodes, because regions may refer to nodes by index; nodes of no element are left out.

Named groups of a file become named sets of nodes: physical groups of Gmsh, sets of nodes and of elements (Abaqus), and
nonzero data `set:NAME` of points or cells, the form in which sets are written. Cell data with a name of
`meshes.ELEMENT_FIELDS` become element fields.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError, MeshFileWarning, NotFoundError
from tensormass._shared.files import read_bytes, replacing
from tensormass._shared.mesh_names import SURFACE_ENDINGS, check_holds_volumes
from tensormass._src import mesh_reading, mesh_writing
from tensormass._src.label_formats.content import Labels
from tensormass._src.mesh_formats import finish
from tensormass._src.mesh_formats.kinds import KINDS, SET_PREFIX, VOLUMES
from tensormass._src.mesh_formats.raw import Block, FormatError, Raw
from tensormass._src.meshes import ElementBlock, FloatArray, TriangleSurface, VolumeMesh

# Folder of this package, whose lines a warning does not name.
_PACKAGE = str(Path(__file__).resolve().parents[1])


class MeshioCells(Protocol):
    """A block of cells of meshio or meshlane."""

    type: str
    data: Any


class MeshioMesh(Protocol):
    """A mesh of meshio or meshlane."""

    points: Any
    cells: Sequence[Any]
    point_data: Mapping[str, Any]
    cell_data: Mapping[str, Any]
    field_data: Mapping[str, Any]
    point_sets: Mapping[str, Any]
    cell_sets: Mapping[str, Any]


def read_mesh(path: str | Path, *, trusted: bool = False) -> VolumeMesh:
    """Reads a volume mesh: Gmsh (.msh 1, 2.2, 4.0, 4.1), VTK (.vtk, .vtu), Abaqus and CalculiX (.inp), Medit (.mesh) or
    TetGen (.ele).

    `notes` of the mesh say what the file has and the mesh does not; a MeshFileWarning has them, too.

    Args:
        trusted: reads a file that this program has written, without a process of its own.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, without volume elements, or with shapes that are not simulated.
    """
    path = Path(path)
    _check_is_file(path)
    if path.suffix.lower() in SURFACE_ENDINGS and read_bytes(path, 4) != b"$NOD":
        raise InvalidArgumentError(
            f"{path}: {path.suffix} holds a surface, without volume elements; if it is closed, fill it with "
            "`tensormass mesh --edge LENGTH`"
        )
    mesh = _volume_mesh(mesh_reading.volume(path, trusted=trusted), str(path))
    _warn(path, mesh.notes)
    return mesh


def from_meshio(mesh: MeshioMesh, where: str = "meshio.Mesh") -> VolumeMesh:
    """Converts the volume elements of a mesh of meshio or meshlane, with its sets and element fields. Shapes that are
    not simulated are refused, not dropped. All nodes are kept."""
    try:
        raw = _raw_of_meshio(mesh, where)
        return _volume_mesh(finish.volume(raw, where, drop_unused=False), where)
    except FormatError as error:
        raise InvalidArgumentError(str(error)) from error


def _raw_of_meshio(mesh: MeshioMesh, where: str) -> Raw:
    blocks, begins, total = [], [], 0
    for cells in mesh.cells:
        if cells.type not in KINDS:
            if cells.type.startswith("polyhedron") or cells.type[:5] in ("tetra", "hexah", "wedge", "pyram", "VTK_L"):
                known = ", ".join(VOLUMES)
                raise FormatError(f"{where}: has elements of type {cells.type}; known are {known}: mesh it with those")
            nodes = np.empty((0, 1), np.int64)
        else:
            nodes = np.asarray(cells.data)
            if KINDS[cells.type].dimension == 3 and nodes.ndim != 2:
                raise FormatError(f"{where}: elements of type {cells.type} have differing numbers of nodes")
            nodes = nodes if nodes.ndim == 2 else np.empty((0, 1), np.int64)
        begins.append(total)
        kind = cells.type if cells.type in KINDS else "polygon"
        blocks.append(Block(kind, nodes, slice(total, total + len(cells.data))))
        total += len(cells.data)
    raw = Raw(np.asarray(mesh.points, np.float64), blocks, place=lambda cell: f"{where}: cell {cell}")
    for name, values in mesh.cell_data.items():
        parts = [np.asarray(part) for part in values]
        if sum(map(len, parts)) == total and len({part.shape[1:] for part in parts}) == 1:
            raw.cell_data[name] = np.concatenate(parts)
    for name, nodes in mesh.point_sets.items():
        raw.node_sets[name] = np.asarray(nodes, np.int64).reshape(-1)
    for name, chosen in mesh.cell_sets.items():
        # Gmsh 4 stores bookkeeping there.
        if name.startswith("gmsh:"):
            continue
        rows = [np.asarray(of, np.int64) + begin for of, begin in zip(chosen, begins, strict=True) if of is not None]
        raw.cell_sets[name] = np.concatenate([np.empty(0, np.int64), *rows])
    if "gmsh:physical" in raw.cell_data:
        tags = raw.cell_data["gmsh:physical"].reshape(-1)
        dimensions = np.concatenate(
            [
                np.full(len(cells.data), KINDS[block.kind].dimension)
                for cells, block in zip(mesh.cells, blocks, strict=True)
            ]
        )
        for name, (tag, dimension) in mesh.field_data.items():
            if name not in mesh.cell_sets:
                raw.cell_sets[name] = np.flatnonzero((tags == tag) & (dimensions == dimension))
    finish.sets_from_data(
        raw,
        {
            name: np.asarray(values).reshape(-1)
            for name, values in mesh.point_data.items()
            if name.startswith(SET_PREFIX)
        },
    )
    return raw


def _volume_mesh(found: finish.Volume, where: str) -> VolumeMesh:
    mesh = VolumeMesh.from_arrays(found.points, found.blocks, sets=found.sets, element_fields=found.fields, where=where)
    return VolumeMesh(mesh.nodes, mesh.blocks, mesh.sets, mesh.element_fields, tuple(found.notes))


def _warn(path: Path, notes: Sequence[str]) -> None:
    if not notes:
        return
    message = f"{path}: {'; '.join(notes)}"
    if sys.version_info >= (3, 12):
        warnings.warn(message, MeshFileWarning, skip_file_prefixes=(_PACKAGE,))
    else:
        warnings.warn(message, MeshFileWarning, stacklevel=3)


def read_surface(path: str | Path, *, trusted: bool = False) -> TriangleSurface:
    """Reads a triangulated surface (.obj, .stl, .ply, .off, .vtp, .vtk ...); quads are split, equal vertices merged.

    A Wavefront file (.obj) may have texture coordinates.

    Args:
        trusted: see `read_mesh`.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, or it has no triangles.
    """
    path = Path(path)
    _check_is_file(path)
    found = mesh_reading.surface(path, trusted=trusted)
    surface = TriangleSurface.from_arrays(found.points, found.triangles, str(path), texture_coordinates=found.texture)
    _warn(path, found.notes)
    return surface


def read_labels(path: str | Path) -> Labels:
    """Reads a label map: a segmentation of 3D Slicer (.seg.nrrd), NRRD (.nrrd, .nhdr) or NIfTI (.nii, .nii.gz).
    Another process reads it, with limits of time and memory.

    Raises:
        InvalidArgumentError: not readable; the message names file and remedy.
    """
    return mesh_reading.labels(Path(path))


def write_mesh(path: str | Path, mesh: VolumeMesh) -> None:
    """Writes a mesh. The ending of the name chooses the format: .msh (Gmsh 2.2), .vtk, .vtu, .inp (Abaqus, CalculiX;
    without element fields), .mesh (Medit) or .ele (TetGen; both without sets and fields).

    Raises:
        InvalidArgumentError: unknown ending.
    """
    masks = {}
    for name, nodes in mesh.sets.items():
        masks[SET_PREFIX + name] = np.zeros(len(mesh.nodes))
        masks[SET_PREFIX + name][nodes] = 1
    write_blocks(path, mesh.nodes, mesh.blocks, masks, mesh.element_fields)


def write_surface(path: str | Path, surface: TriangleSurface) -> None:
    """Writes a triangulated surface. The ending of the name chooses the format: .ply, .stl, .obj or .off."""
    path = Path(path)
    try:
        with replacing(path) as aside:
            mesh_writing.write_surface(aside, surface, path)
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error


def write_fields(
    path: str | Path,
    mesh: VolumeMesh,
    node_fields: Mapping[str, npt.NDArray[np.generic]],
    element_fields: Mapping[str, npt.NDArray[np.generic]],
) -> None:
    """Writes a mesh with fields of any name, to look at them in ParaView, without its sets and its own element fields.
    The ending of the name chooses the format as in `write_mesh`; take .vtu or .vtk.

    Args:
        node_fields: by name, [node_count] or [node_count, components].
        element_fields: by name, [element_count] or [element_count, components].

    Raises:
        InvalidArgumentError: unknown ending, or the file cannot be written.
    """
    write_blocks(path, mesh.nodes, mesh.blocks, node_fields, element_fields)


def write_blocks(
    path: str | Path,
    points: FloatArray,
    blocks: Sequence[ElementBlock],
    point_data: Mapping[str, npt.NDArray[np.generic]],
    cell_data: Mapping[str, npt.NDArray[np.generic]],
) -> None:
    """Writes blocks of elements like `write_mesh`, with data of nodes [node_count, ...] and elements [element_count,
    ...]."""
    check_holds_volumes(path)
    path = Path(path)
    content = mesh_writing.Content(points, blocks, point_data, cell_data)
    try:
        with replacing(path) as aside:
            notes = mesh_writing.write_volume(aside, content, path)
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error
    for note in notes:
        warnings.warn(note, MeshFileWarning, stacklevel=2)


def _check_is_file(path: Path) -> None:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file")
    if not os.access(path, os.R_OK):
        raise InvalidArgumentError(f"{path}: cannot be read: Permission denied")
