"""Writers of mesh files, by the ending of the name. Other programs read them: VTK, Gmsh, CalculiX, meshio, meshlane."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.mesh_formats.kinds import GMSH_NUMBERS, GMSH_ORDER, SET_PREFIX, VTK_NUMBERS
from tensormass._src.meshes import ElementBlock, FloatArray, TriangleSurface

Data = Mapping[str, npt.NDArray[np.generic]]
# Bytes of data that are compressed together.
_BLOCK = 1 << 20
_VTK_TYPES = {"f": "double", "i": "int", "u": "int", "b": "int"}
_XML_TYPES = {"f8": "Float64", "i8": "Int64", "u1": "UInt8"}
_ABAQUS = {
    "tetra": "C3D4",
    "pyramid": "C3D5",
    "wedge": "C3D6",
    "hexahedron": "C3D8",
    "tetra10": "C3D10",
    "hexahedron20": "C3D20",
}
_MEDIT = {"tetra": "Tetrahedra", "pyramid": "Pyramids", "wedge": "Prisms", "hexahedron": "Hexahedra"}
# Numbers a line of an input file, at most.
_ABAQUS_WIDTH = 16


@dataclass(frozen=True)
class Content:
    """A mesh with data of nodes [node_count, ...] and of elements [element_count, ...]."""

    points: FloatArray
    blocks: Sequence[ElementBlock]
    point_data: Data
    cell_data: Data

    @property
    def kinds(self) -> list[str]:
        return [shape.meshio_type for shape, _ in self.blocks]

    def left_out(self, *, sets: bool) -> list[str]:
        """Returns the names of the data that a format without data leaves out; with `sets`, it has sets of nodes."""
        return [*(name for name in self.point_data if not (sets and name.startswith(SET_PREFIX))), *self.cell_data]


def write_volume(path: Path, content: Content, given: Path) -> list[str]:
    """Writes a volume, and returns notes about what the format does not hold. `given` is the name for messages.

    Raises:
        InvalidArgumentError: an ending that is not known, or elements that the format does not hold.
    """
    ending = path.suffix.lower()
    if ending not in _VOLUMES:
        raise InvalidArgumentError(f"{given}: cannot be written; use .msh, .vtk or .vtu, or {', '.join(_OTHERS)}")
    known = {".mesh": set(_MEDIT), ".ele": {"tetra"}}.get(ending, set(content.kinds))
    if wrong := set(content.kinds) - known:
        raise InvalidArgumentError(
            f"{given}: {ending} holds no elements of type {', '.join(sorted(wrong))}; use .msh, .vtk or .vtu"
        )
    _VOLUMES[ending](path, content)
    left = content.left_out(sets=ending == ".inp") if ending in _OTHERS else []
    notes = [f"{given}: {ending} does not hold {', '.join(left)}; .msh, .vtk and .vtu do"] if left else []
    if ending == ".inp" and "pyramid" in content.kinds:
        notes.append(f"{given}: CalculiX does not know pyramids (C3D5); Abaqus does")
    return notes


def write_surface(path: Path, surface: TriangleSurface, given: Path) -> None:
    """Writes a surface. Raises InvalidArgumentError for an ending that is not known."""
    writer = _SURFACES.get(path.suffix.lower())
    if writer is None:
        raise InvalidArgumentError(f"{given}: cannot be written; use {', '.join(_SURFACES)}")
    with path.open("wb") as file:
        writer(file, surface)


# --- volumes ----------------------------------------------------------------------------------------------------------


def _gmsh(path: Path, content: Content) -> None:
    """Writes Gmsh 2.2, binary."""
    with path.open("wb") as file:
        file.write(b"$MeshFormat\n2.2 1 8\n" + np.array([1], "<i4").tobytes() + b"\n$EndMeshFormat\n")
        count = len(content.points)
        nodes = np.empty(count, [("number", "<i4"), ("at", "<f8", (3,))])
        nodes["number"], nodes["at"] = np.arange(1, count + 1), content.points
        file.write(b"$Nodes\n%d\n" % count + nodes.tobytes() + b"\n$EndNodes\n")
        total = sum(len(elements) for _, elements in content.blocks)
        file.write(b"$Elements\n%d\n" % total)
        first = 1
        for kind, (_, elements) in zip(content.kinds, content.blocks, strict=True):
            if not len(elements):
                continue
            if kind in GMSH_ORDER:
                elements = elements[:, np.argsort(GMSH_ORDER[kind])]
            file.write(np.array([GMSH_NUMBERS[kind], len(elements), 2], "<i4").tobytes())
            rows = np.empty((len(elements), 3 + elements.shape[1]), "<i4")
            rows[:, 1], rows[:, 2] = 0, 1  # without a group, in one entity
            rows[:, 0] = np.arange(first, first + len(elements))
            rows[:, 3:] = elements + np.uint32(1)
            file.write(rows.tobytes())
            first += len(elements)
        file.write(b"\n$EndElements\n")
        for section, data in (("NodeData", content.point_data), ("ElementData", content.cell_data)):
            for name, values in data.items():
                rows = values.reshape(len(values), -1)
                head = f'${section}\n1\n"{name}"\n1\n0.0\n3\n0\n{rows.shape[1]}\n{len(rows)}\n'
                table = np.empty(len(rows), [("number", "<i4"), ("values", "<f8", (rows.shape[1],))])
                table["number"], table["values"] = np.arange(1, len(rows) + 1), rows
                file.write(head.encode() + table.tobytes() + f"\n$End{section}\n".encode())


def _vtk(path: Path, content: Content) -> None:
    """Writes legacy VTK, binary, in a version that every VTK reads."""
    with path.open("wb") as file:
        file.write(b"# vtk DataFile Version 4.2\ntensormass\nBINARY\nDATASET UNSTRUCTURED_GRID\n")
        file.write(b"POINTS %d double\n" % len(content.points) + content.points.astype(">f8").tobytes())
        count = sum(len(elements) for _, elements in content.blocks)
        size = sum(elements.size + len(elements) for _, elements in content.blocks)
        file.write(b"\nCELLS %d %d\n" % (count, size))
        for _, elements in content.blocks:
            rows = np.empty((len(elements), 1 + elements.shape[1]), ">i4")
            rows[:, 0], rows[:, 1:] = elements.shape[1], elements
            file.write(rows.tobytes())
        file.write(b"\nCELL_TYPES %d\n" % count)
        for kind, (_, elements) in zip(content.kinds, content.blocks, strict=True):
            file.write(np.full(len(elements), VTK_NUMBERS[kind], ">i4").tobytes())
        for section, rows_count, data in (
            ("POINT_DATA", len(content.points), content.point_data),
            ("CELL_DATA", count, content.cell_data),
        ):
            if not data:
                continue
            file.write(f"\n{section} {rows_count}\nFIELD FieldData {len(data)}\n".encode())
            for name, values in data.items():
                rows = values.reshape(len(values), -1)
                kind = _VTK_TYPES[values.dtype.kind]
                dtype = ">f8" if kind == "double" else ">i4"
                file.write(f"{name.replace(' ', '%20')} {rows.shape[1]} {len(rows)} {kind}\n".encode())
                file.write(rows.astype(dtype).tobytes() + b"\n")


def _vtu(path: Path, content: Content) -> None:
    """Writes an unstructured grid in XML, compressed by ZLib."""
    count = sum(len(elements) for _, elements in content.blocks)
    sizes = [np.full(len(elements), elements.shape[1], np.int64) for _, elements in content.blocks]
    types = [
        np.full(len(elements), VTK_NUMBERS[kind], np.uint8)
        for kind, (_, elements) in zip(content.kinds, content.blocks, strict=True)
    ]
    flat = [elements.reshape(-1).astype(np.int64) for _, elements in content.blocks]
    with path.open("wb") as file:
        file.write(
            b'<?xml version="1.0"?>\n<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" '
            b'header_type="UInt64" compressor="vtkZLibDataCompressor">\n<UnstructuredGrid>\n'
        )
        file.write(b'<Piece NumberOfPoints="%d" NumberOfCells="%d">\n<Points>\n' % (len(content.points), count))
        _xml_array(file, "Points", content.points)
        file.write(b"</Points>\n<Cells>\n")
        _xml_array(file, "connectivity", np.concatenate(flat))
        _xml_array(file, "offsets", np.cumsum(np.concatenate(sizes)))
        _xml_array(file, "types", np.concatenate(types))
        file.write(b"</Cells>\n")
        for tag, data in (("PointData", content.point_data), ("CellData", content.cell_data)):
            file.write(f"<{tag}>\n".encode())
            for name, values in data.items():
                _xml_array(file, name, values)
            file.write(f"</{tag}>\n".encode())
        file.write(b"</Piece>\n</UnstructuredGrid>\n</VTKFile>\n")


def _xml_array(file: IO[bytes], name: str, values: npt.NDArray[np.generic]) -> None:
    rows = values.reshape(len(values), -1)
    dtype = "f8" if values.dtype.kind == "f" else "u1" if values.dtype == np.uint8 else "i8"
    data = rows.astype(f"<{dtype}").tobytes()
    pieces = [data[at : at + _BLOCK] for at in range(0, len(data), _BLOCK)]
    packed = [zlib.compress(piece, 6) for piece in pieces]
    last = len(pieces[-1]) % _BLOCK if pieces else 0
    header = np.array([len(pieces), _BLOCK, last, *map(len, packed)] if pieces else [0, 0, 0], "<u8").tobytes()
    quoted = name.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    width = f' NumberOfComponents="{rows.shape[1]}"' if rows.shape[1] > 1 else ""
    file.write(f'<DataArray type="{_XML_TYPES[dtype]}" Name="{quoted}"{width} format="binary">\n'.encode())
    file.write(base64.b64encode(header) + base64.b64encode(b"".join(packed)) + b"\n</DataArray>\n")


def _abaqus(path: Path, content: Content) -> None:
    """Writes an input file of Abaqus and CalculiX."""
    with path.open("w", encoding="ascii", errors="replace") as file:
        file.write("*HEADING\ntensormass\n*NODE, NSET=Nall\n")
        file.writelines(f"{n}, {x!r}, {y!r}, {z!r}\n" for n, (x, y, z) in enumerate(content.points.tolist(), 1))
        first = 1
        for kind, (_, elements) in zip(content.kinds, content.blocks, strict=True):
            file.write(f"*ELEMENT, TYPE={_ABAQUS[kind]}, ELSET=Eall\n")
            for number, nodes in enumerate((elements.astype(np.int64) + 1).tolist(), first):
                _abaqus_line(file, [number, *nodes])
            first += len(elements)
        for name, values in content.point_data.items():
            if name.startswith(SET_PREFIX):
                file.write(f"*NSET, NSET={name.removeprefix(SET_PREFIX)}\n")
                nodes = (np.flatnonzero(values) + 1).tolist()
                for at in range(0, len(nodes), _ABAQUS_WIDTH):
                    file.write(", ".join(map(str, nodes[at : at + _ABAQUS_WIDTH])) + ",\n")


def _abaqus_line(file: IO[str], numbers: list[int]) -> None:
    lines = [numbers[at : at + _ABAQUS_WIDTH] for at in range(0, len(numbers), _ABAQUS_WIDTH)]
    file.write(",\n".join(", ".join(map(str, line)) for line in lines) + "\n")


def _medit(path: Path, content: Content) -> None:
    """Writes Medit, version 2, as text."""
    with path.open("w", encoding="ascii") as file:
        file.write(f"MeshVersionFormatted 2\nDimension 3\nVertices\n{len(content.points)}\n")
        file.writelines(f"{x!r} {y!r} {z!r} 0\n" for x, y, z in content.points.tolist())
        for kind in dict.fromkeys(content.kinds):
            rows = np.concatenate([block.nodes for block in content.blocks if block.shape.meshio_type == kind])
            file.write(f"{_MEDIT[kind]}\n{len(rows)}\n")
            file.writelines(" ".join(map(str, row)) + " 0\n" for row in (rows.astype(np.int64) + 1).tolist())
        file.write("End\n")


def _tetgen(path: Path, content: Content) -> None:
    """Writes nodes and elements of TetGen, numbered from 0."""
    with path.with_suffix(".node").open("w", encoding="ascii") as file:
        file.write(f"{len(content.points)} 3 0 0\n")
        file.writelines(f"{n} {x!r} {y!r} {z!r}\n" for n, (x, y, z) in enumerate(content.points.tolist()))
    rows = np.concatenate([block.nodes for block in content.blocks])
    with path.open("w", encoding="ascii") as file:
        file.write(f"{len(rows)} 4 0\n")
        file.writelines(f"{n} {' '.join(map(str, row))}\n" for n, row in enumerate(rows.tolist()))


_VOLUMES: dict[str, Callable[[Path, Content], None]] = {
    ".msh": _gmsh,
    ".vtk": _vtk,
    ".vtu": _vtu,
    ".inp": _abaqus,
    ".mesh": _medit,
    ".ele": _tetgen,
}
# Formats without data.
_OTHERS = (".inp", ".mesh", ".ele")


# --- surfaces ---------------------------------------------------------------------------------------------------------


def _ply(file: IO[bytes], surface: TriangleSurface) -> None:
    file.write(b"ply\nformat binary_little_endian 1.0\n")
    file.write(b"element vertex %d\n" % len(surface.vertices))
    file.writelines(b"property double %s\n" % axis for axis in (b"x", b"y", b"z"))
    file.write(b"element face %d\nproperty list uchar int vertex_indices\nend_header\n" % len(surface.triangles))
    file.write(surface.vertices.astype("<f8").tobytes())
    rows = np.empty(len(surface.triangles), [("count", "u1"), ("corners", "<i4", (3,))])
    rows["count"], rows["corners"] = 3, surface.triangles
    file.write(rows.tobytes())


def _stl(file: IO[bytes], surface: TriangleSurface) -> None:
    corners = surface.vertices[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(corners), [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["normal"] = normals / np.where(lengths > 0, lengths, 1)
    rows["corners"] = corners
    file.write(b"binary STL of tensormass".ljust(80) + np.array([len(corners)], "<u4").tobytes() + rows.tobytes())


def _off(file: IO[bytes], surface: TriangleSurface) -> None:
    file.write(f"OFF\n{len(surface.vertices)} {len(surface.triangles)} 0\n".encode())
    file.writelines(_text_rows("", surface.vertices.tolist()))
    file.writelines(_text_rows("3 ", surface.triangles.tolist()))


def _obj(file: IO[bytes], surface: TriangleSurface) -> None:
    file.writelines(_text_rows("v ", surface.vertices.tolist()))
    file.writelines(_text_rows("f ", (surface.triangles.astype(np.int64) + 1).tolist()))


def _text_rows(first: str, rows: Iterable[Iterable[float]]) -> Iterable[bytes]:
    return ((first + " ".join(map(repr, row)) + "\n").encode() for row in rows)


_SURFACES: dict[str, Callable[[IO[bytes], TriangleSurface], None]] = {
    ".ply": _ply,
    ".stl": _stl,
    ".obj": _obj,
    ".off": _off,
}
