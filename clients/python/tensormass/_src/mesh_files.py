"""Reads and writes mesh files: volumes of any shapes with named sets and element fields, and triangulated surfaces.

meshio reads the formats, but for two: Gmsh 1 ($NOD/$ELM) is read here, and surfaces of Wavefront (.obj) by trimesh,
which keeps seams of a picture. Readers keep the node order of the file, because regions may refer to nodes by index.

Named groups of a file become named sets of nodes: physical groups of Gmsh, sets of nodes and of elements (Abaqus), and
nonzero point data `set:NAME`, the form in which sets are written. Cell data with a name of `meshes.ELEMENT_FIELDS`
become element fields.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from tensormass._src.errors import InvalidArgumentError, NotFoundError
from tensormass._src.extras import require
from tensormass._src.files import read_bytes, replacing
from tensormass._src.meshes import ELEMENT_FIELDS, ElementBlock, FloatArray, TriangleSurface, VolumeMesh
from tensormass._src.names import as_name
from tensormass._src.shapes import BY_MESHIO_TYPE

if TYPE_CHECKING:
    import meshio

# Gmsh element types. Elements without a volume are skipped; volumes other than tetrahedra are refused.
_GMSH_TETRAHEDRON = 4
_GMSH_WITHOUT_VOLUME = {1, 2, 3, 15}
_WITHOUT_VOLUME = {"vertex", "line", "line3", "triangle", "triangle6", "triangle7", "quad", "quad8", "quad9", "polygon"}
_SET_PREFIX = "set:"
# Formats of surfaces alone.
_SURFACE_ENDINGS = (".obj", ".stl", ".ply", ".off")
# Other names of `ELEMENT_FIELDS`.
_FIELD_ALIASES = {"fibre_direction": "fibre_directions"}


def read_mesh(path: str | Path) -> VolumeMesh:
    """Reads a volume mesh: Gmsh 1 or anything meshio knows (.msh 2.2/4.x, .vtk, .vtu, .inp, .mesh, .ele ...) but the
    .msh of ANSYS.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, without volume elements, or with shapes that are not simulated.
    """
    path = Path(path)
    if _begins_with(path, b"$NOD"):
        return read_gmsh1(path)
    # meshio refuses some of them for reasons of its own, such as texture coordinates.
    if path.suffix.lower() in _SURFACE_ENDINGS:
        raise InvalidArgumentError(
            f"{path}: {path.suffix} holds a surface, without volume elements; if it is closed, fill it with "
            "`tensormass mesh --edge LENGTH`"
        )
    return from_meshio(_meshio_read(path), str(path))


def from_meshio(mesh: meshio.Mesh, where: str = "meshio.Mesh") -> VolumeMesh:
    """Converts the volume elements of a `meshio.Mesh`, with its sets and element fields. Shapes that are not simulated
    are refused, not dropped."""
    others = sorted({block.type for block in mesh.cells} - set(BY_MESHIO_TYPE) - _WITHOUT_VOLUME)
    if others:
        raise InvalidArgumentError(
            f"{where}: has elements of type {', '.join(others)}; known are {', '.join(BY_MESHIO_TYPE)}: mesh it with "
            "those"
        )
    volumes = [index for index, block in enumerate(mesh.cells) if block.type in BY_MESHIO_TYPE]
    if not volumes:
        raise InvalidArgumentError(
            f"{where}: has no elements with a volume; if it is a closed surface, fill it with "
            "`tensormass mesh --edge LENGTH`"
        )
    fields = {}
    for name, values in mesh.cell_data.items():
        name = _FIELD_ALIASES.get(name, name)
        if name in ELEMENT_FIELDS:
            rows = np.concatenate([np.asarray(values[index], np.float64) for index in volumes])
            fields[name] = rows.reshape(-1) if ELEMENT_FIELDS[name] == 1 else rows
    return VolumeMesh.from_arrays(
        mesh.points,
        [(BY_MESHIO_TYPE[mesh.cells[index].type].name, mesh.cells[index].data) for index in volumes],
        sets=_sets(mesh, where),
        element_fields=fields,
        where=where,
    )


def _sets(mesh: meshio.Mesh, where: str) -> dict[str, npt.NDArray[np.int64]]:
    found: list[tuple[str, npt.NDArray[np.int64]]] = []
    found += [(name, np.asarray(nodes, np.int64).reshape(-1)) for name, nodes in mesh.point_sets.items()]
    for name, values in mesh.point_data.items():
        if name.startswith(_SET_PREFIX):
            found.append((name.removeprefix(_SET_PREFIX), np.flatnonzero(np.asarray(values).reshape(-1))))
    for name, cells in mesh.cell_sets.items():
        # Gmsh 4 stores bookkeeping there.
        if not name.startswith("gmsh:"):
            found.append((name, _nodes_of(mesh, cells)))
    if "gmsh:physical" in mesh.cell_data:
        for name, (tag, dimension) in mesh.field_data.items():
            if name not in mesh.cell_sets:
                cells = [
                    np.flatnonzero((np.asarray(tags) == tag) & (block.dim == dimension))
                    for block, tags in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True)
                ]
                found.append((name, _nodes_of(mesh, cells)))
    sets: dict[str, npt.NDArray[np.int64]] = {}
    for name, nodes in found:
        if nodes.size == 0:  # an empty group has no effect
            continue
        if as_name(name) in sets:
            raise InvalidArgumentError(f"{where}: two of its sets are called {as_name(name)!r}; rename one")
        sets[as_name(name)] = np.unique(nodes)
    return sets


def _nodes_of(mesh: meshio.Mesh, cells: list[npt.NDArray[np.integer] | None]) -> npt.NDArray[np.int64]:
    """Returns the nodes of cells, which are given as indices into each block."""
    nodes = [np.empty(0, np.int64)]
    for block, chosen in zip(mesh.cells, cells, strict=True):
        if chosen is not None and len(chosen):
            nodes.append(np.asarray(block.data)[np.asarray(chosen, np.int64)].reshape(-1).astype(np.int64))
    return np.unique(np.concatenate(nodes))


def read_surface(path: str | Path) -> TriangleSurface:
    """Reads a triangulated surface (.obj, .stl, .ply, .off, .vtk ...); quads are split, equal vertices merged.

    A Wavefront file (.obj) may have texture coordinates.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: not readable, or it has no triangles.
    """
    if Path(path).suffix.lower() == ".obj":
        return _merged(_read_wavefront(Path(path)))
    mesh = _meshio_read(Path(path))
    quads = [block.data for block in mesh.cells if block.type == "quad"]
    triangles = [block.data for block in mesh.cells if block.type == "triangle"]
    triangles += [np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]) for quad in quads]
    if not triangles:
        raise InvalidArgumentError(f"{path}: has no triangles; a skin and a surface to be meshed need them")
    return _merged(TriangleSurface.from_arrays(mesh.points, np.concatenate(triangles), str(path)))


def _merged(surface: TriangleSurface) -> TriangleSurface:
    """Merges equal vertices. STL repeats each vertex in each triangle, and trimesh those on a seam of a picture."""
    vertices, index = np.unique(surface.vertices, axis=0, return_inverse=True)
    if len(vertices) == len(surface.vertices):
        return surface
    return replace(surface, vertices=vertices, triangles=index.reshape(-1)[surface.triangles].astype(np.uint32))


def _read_wavefront(path: Path) -> TriangleSurface:
    """Reads a Wavefront file with trimesh: meshio refuses one whose vertices have several places in a picture."""
    _check_is_file(path)
    require("meshes", f"{path}: reading this surface")
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False, skip_materials=True)
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
        places = getattr(mesh.visual, "uv", None)
    except Exception as error:
        raise InvalidArgumentError(f"{path}: not readable as a surface: {error}") from error
    if not len(triangles):
        raise InvalidArgumentError(f"{path}: has no triangles; a skin and a surface to be meshed need them")
    if places is None or len(places) != len(vertices) or not np.isfinite(places).all():
        return TriangleSurface.from_arrays(vertices, triangles, str(path))
    return TriangleSurface.from_arrays(vertices, triangles, str(path), texture_coordinates=places[triangles])


def write_mesh(path: str | Path, mesh: VolumeMesh) -> None:
    """Writes a mesh. The ending of the name chooses the format: .msh (Gmsh 2.2), .vtk, .vtu or another one of meshio.

    Raises:
        InvalidArgumentError: unknown ending.
    """
    masks = {}
    for name, nodes in mesh.sets.items():
        masks[_SET_PREFIX + name] = np.zeros(len(mesh.nodes))
        masks[_SET_PREFIX + name][nodes] = 1
    write_blocks(path, mesh.nodes, mesh.blocks, masks, mesh.element_fields)


def check_holds_volumes(path: str | Path) -> None:
    """Refuses a file format that has no volume elements: meshio would write a file without any.

    Raises:
        InvalidArgumentError: such a format, by the ending of the name.
    """
    if Path(path).suffix.lower() in _SURFACE_ENDINGS:
        raise InvalidArgumentError(f"{path}: {Path(path).suffix} holds surfaces only; use .msh, .vtk or .vtu")


def write_surface(path: str | Path, surface: TriangleSurface) -> None:
    """Writes a triangulated surface. The ending of the name chooses the format."""
    require("meshes", "writing a surface")
    import meshio

    meshio.Mesh(surface.vertices, [("triangle", surface.triangles.astype("int32"))]).write(Path(path))


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
    require("meshes", "writing a mesh")
    import meshio

    path = Path(path)
    ends = np.cumsum([len(elements) for _, elements in blocks])[:-1]
    out = meshio.Mesh(
        points,
        [(shape.meshio_type, elements.astype(np.int64)) for shape, elements in blocks],
        point_data=dict(point_data),
        cell_data={name: np.split(values, ends) for name, values in cell_data.items()},
    )
    options = {"file_format": "gmsh22"} if path.suffix == ".msh" else {}
    try:
        with (
            replacing(path) as aside,
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(io.StringIO()),
        ):
            out.write(aside, **options)
    except (meshio.ReadError, meshio.WriteError, SystemExit) as error:
        raise InvalidArgumentError(f"{path}: cannot be written; use .msh, .vtk or .vtu") from error
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be written: {error.strerror}") from error


def read_gmsh1(path: str | Path) -> VolumeMesh:
    """Reads the Gmsh 1 format: `$NOD count, id x y z ... $ENDNOD $ELM count, id type physical entity n nodes ...`.

    Raises:
        InvalidArgumentError: a mistake; the message names the line.
    """
    try:
        lines = Path(path).read_text("ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidArgumentError(f"{path}: cannot be read as Gmsh 1: {error}") from error
    node_rows, first_node_line = _gmsh1_section(path, lines, "NOD")
    element_rows, first_element_line = _gmsh1_section(path, lines, "ELM")

    index_of: dict[int, int] = {}
    points = np.empty((len(node_rows), 3))
    for row, text in enumerate(node_rows):
        where = f"{path}:{first_node_line + row}"
        try:
            number, x, y, z = text.split()
            node, points[row] = int(number), (float(x), float(y), float(z))
        except ValueError as error:
            raise InvalidArgumentError(f"{where}: expected `id x y z`, found {text!r}") from error
        if node in index_of:
            raise InvalidArgumentError(f"{where}: node {node} is defined a second time")
        index_of[node] = row

    tetrahedra: list[list[int]] = []
    for row, text in enumerate(element_rows):
        where = f"{path}:{first_element_line + row}"
        try:
            element, kind, _physical, _entity, count, *nodes = (int(word) for word in text.split())
        except ValueError as error:
            raise InvalidArgumentError(f"{where}: expected integers `id type .. .. n nodes`, found {text!r}") from error
        if len(nodes) != count:
            raise InvalidArgumentError(f"{where}: element {element} announces {count} nodes and lists {len(nodes)}")
        if kind in _GMSH_WITHOUT_VOLUME:
            continue
        if kind != _GMSH_TETRAHEDRON or count != 4:
            raise InvalidArgumentError(f"{where}: element {element} has type {kind}; only tetrahedra (4) are read")
        try:
            tetrahedra.append([index_of[node] for node in nodes])
        except KeyError as error:
            raise InvalidArgumentError(f"{where}: element {element} uses node {error}, which is not defined") from None
    if not tetrahedra:
        raise InvalidArgumentError(f"{path}: has no tetrahedra")
    return VolumeMesh.from_tetrahedra(points, tetrahedra, str(path))


def _gmsh1_section(path: str | Path, lines: list[str], name: str) -> tuple[list[str], int]:
    """Returns the rows of `$name ... $ENDname` and the line number of the first row."""
    try:
        begin = lines.index(f"${name}")
        count = int(lines[begin + 1])
        rows = lines[begin + 2 : begin + 2 + count]
        closed = count >= 0 and [line.strip() for line in lines[begin + 2 + count :][:1]] == [f"$END{name}"]
    except (ValueError, IndexError) as error:
        raise InvalidArgumentError(f"{path}: section ${name} is missing or cut off") from error
    if not closed:
        raise InvalidArgumentError(f"{path}: section ${name} announces {count} rows, but $END{name} is not after them")
    return rows, begin + 3


def _begins_with(path: Path, first: bytes) -> bool:
    return read_bytes(path, len(first)) == first


def _check_is_file(path: Path) -> None:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file")


def _meshio_read(path: Path) -> meshio.Mesh:
    _check_is_file(path)
    # For the ending .msh, meshio tries the format of ANSYS first. It never returns from such a file that is cut off,
    # and it finds no volumes in a complete one, which describes cells by their faces.
    options = {"file_format": "gmsh"} if path.suffix.lower() == ".msh" else {}
    if options and _begins_with(path, b"("):
        raise InvalidArgumentError(f"{path}: a mesh of ANSYS (Fluent) is not read; save it as Gmsh, VTK or Abaqus")
    require("meshes", f"{path}: reading this mesh")
    import meshio

    said = io.StringIO()
    try:
        # meshio prints an error and exits on a file that it cannot read. It tells ASCII from binary STL by a product
        # that may overflow.
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), np.errstate(over="ignore"):
            return meshio.read(path, **options)
    except (Exception, SystemExit) as error:
        reason = " ".join((said.getvalue() or str(error)).split())
        raise InvalidArgumentError(f"{path}: not readable as a mesh: {reason}") from error
