"""Volume meshes and triangulated surfaces, checked when they are made from arrays.

mesh_files.py reads and writes them, mesh_geometry.py measures them, and mesh_repair.py is the only place that changes
a mesh from outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._src import notebook
from tensormass._src.mesh_formats.kinds import ELEMENT_FIELDS
from tensormass._src.shapes import SHAPES, Shape

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.uint32]
BoolArray = npt.NDArray[np.bool_]


class ElementBlock(NamedTuple):
    """Elements of one shape."""

    #: Shape of all elements.
    shape: Shape
    #: uint32 [element_count, nodes of the shape], in VTK order.
    nodes: IndexArray


@dataclass(frozen=True)
class VolumeMesh:
    """Elements of any shapes, conforming across their faces. The index of an element counts through all blocks."""

    #: float64 [node_count, 3]
    nodes: FloatArray
    #: Elements, those of one shape in each block.
    blocks: tuple[ElementBlock, ...]
    #: Named sets of nodes, uint32 [k] each. They become the sets of the body.
    sets: Mapping[str, IndexArray] = field(default_factory=dict)
    #: Parameters of single elements by the names of `ELEMENT_FIELDS`, float64 [element_count] or [element_count, 3].
    element_fields: Mapping[str, FloatArray] = field(default_factory=dict)
    #: What the file has and the mesh does not, with its count: cells without a volume, nodes of no element.
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        rows = [["nodes", f"{len(self.nodes):,}"]]
        rows += [[f"shape {block.shape.name.replace('_', ' ')}", f"{len(block.nodes):,}"] for block in self.blocks]
        rows += _extent(self.nodes)
        rows += [[f"set {name}", f"{len(nodes):,} nodes"] for name, nodes in self.sets.items()]
        rows += [[f"field {name}", "of each element"] for name in self.element_fields]
        rows += [["of the file", note] for note in self.notes]
        return notebook.table("volume mesh", rows)

    @staticmethod
    def from_arrays(
        nodes: npt.ArrayLike,
        blocks: Iterable[tuple[str, npt.ArrayLike]],
        *,
        sets: Mapping[str, npt.ArrayLike] | None = None,
        element_fields: Mapping[str, npt.ArrayLike] | None = None,
        where: str = "mesh",
    ) -> VolumeMesh:
        """Checks shapes, finiteness and index range.

        Args:
            nodes: [node_count, 3].
            blocks: pairs of a shape's name ("hexahedron", see `shapes.SHAPES`) and its elements [n, nodes of it].
            sets: by name, node indices [k] or a mask [node_count].
            element_fields: by the names of `ELEMENT_FIELDS`.

        Raises:
            InvalidArgumentError: a mistake in an array; the message names `where`, row and remedy.
        """
        points = _checked_points(nodes, f"{where}.nodes")
        checked = []
        for index, (name, elements) in enumerate(blocks):
            at = f"{where}.blocks[{index}]"
            if name not in SHAPES:
                raise InvalidArgumentError(f"{at}: unknown shape {name!r}; {suggestion(name, SHAPES)}")
            shape = SHAPES[name]
            checked.append(ElementBlock(shape, _checked_indices(elements, shape.node_count, len(points), at)))
        if not checked:
            raise InvalidArgumentError(f"{where}: has no elements")
        mesh = VolumeMesh(points, tuple(checked))
        fields = {
            name: _checked_field(values, name, mesh.element_count, f"{where}.element_fields")
            for name, values in (element_fields or {}).items()
        }
        named = {
            name: node_indices(values, len(points), f"{where}.sets[{name!r}]") for name, values in (sets or {}).items()
        }
        return VolumeMesh(points, mesh.blocks, named, fields)

    @staticmethod
    def from_tetrahedra(nodes: npt.ArrayLike, tetrahedra: npt.ArrayLike, where: str = "mesh") -> VolumeMesh:
        """Makes a mesh of linear tetrahedra [n, 4]. Checks and errors of `from_arrays`."""
        return VolumeMesh.from_arrays(nodes, [("tetrahedron", tetrahedra)], where=where)

    @property
    def element_count(self) -> int:
        """Returns the number of elements in all blocks."""
        return sum(len(block.nodes) for block in self.blocks)

    def elements(self, shape: str) -> IndexArray:
        """Returns the elements of one shape, [n, nodes of the shape]; n may be 0."""
        empty = np.empty((0, SHAPES[shape].node_count), np.uint32)
        return np.concatenate([empty, *(block.nodes for block in self.blocks if block.shape.name == shape)])


@dataclass(frozen=True)
class TriangleSurface:
    """A surface of triangles, such as the skin of a body or a tool of any shape."""

    #: float64 [vertex_count, 3]
    vertices: FloatArray
    #: uint32 [triangle_count, 3], counter-clockwise from outside.
    triangles: IndexArray
    #: Place (u, v) of each corner in a picture, float32 [triangle_count, 3, 2]: u to the right, v up, both 0 to 1; or
    #: None.
    texture_coordinates: npt.NDArray[np.float32] | None = None

    def _repr_html_(self) -> str:
        counts = [["vertices", f"{len(self.vertices):,}"], ["triangles", f"{len(self.triangles):,}"]]
        return notebook.table("triangle surface", [*counts, *_extent(self.vertices)])

    @staticmethod
    def from_arrays(
        vertices: npt.ArrayLike,
        triangles: npt.ArrayLike,
        where: str = "surface",
        *,
        texture_coordinates: npt.ArrayLike | None = None,
    ) -> TriangleSurface:
        """Makes a surface. Checks and errors of `VolumeMesh.from_arrays`.

        Args:
            texture_coordinates: of the corners of each triangle, [triangle_count, 3, 2].
        """
        points = _checked_points(vertices, f"{where}.vertices")
        checked = _checked_indices(triangles, 3, len(points), f"{where}.triangles")
        if texture_coordinates is None:
            return TriangleSurface(points, checked)
        places = np.ascontiguousarray(texture_coordinates, np.float32)
        if places.shape != (len(checked), 3, 2) or not np.isfinite(places).all():
            raise InvalidArgumentError(
                f"{where}.texture_coordinates: expected finite numbers of shape [{len(checked)}, 3, 2], "
                f"got {list(places.shape)}"
            )
        return TriangleSurface(points, checked, places)


def _extent(points: FloatArray) -> list[list[str]]:
    """Returns rows of a table without a unit, because only its user knows the mesh's unit of length."""
    if not len(points):
        return []
    return [["from", notebook.vector(points.min(axis=0))], ["to", notebook.vector(points.max(axis=0))]]


def _checked_points(values: npt.ArrayLike, where: str) -> FloatArray:
    try:
        points = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{where}: not an array of numbers: {error}") from error
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InvalidArgumentError(f"{where}: expected shape [n, 3] with n > 0, got {list(points.shape)}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InvalidArgumentError(f"{where}: row {bad[0]} is not finite: {points[bad[0]].tolist()}")
    return points


def _checked_indices(values: npt.ArrayLike, width: int, limit: int, where: str) -> IndexArray:
    indices = np.asarray(values)
    if indices.ndim != 2 or indices.shape[1] != width or len(indices) == 0:
        raise InvalidArgumentError(f"{where}: expected shape [n, {width}] with n > 0, got {list(indices.shape)}")
    if not np.issubdtype(indices.dtype, np.integer):
        raise InvalidArgumentError(f"{where}: expected integers, got {indices.dtype}")
    bad = np.flatnonzero(((indices < 0) | (indices >= limit)).any(axis=1))
    if bad.size:
        raise InvalidArgumentError(
            f"{where}: row {bad[0]} is {indices[bad[0]].tolist()}, but indices run from 0 to {limit - 1}"
        )
    return np.ascontiguousarray(indices, dtype=np.uint32)


def _checked_field(values: npt.ArrayLike, name: str, element_count: int, where: str) -> FloatArray:
    if name not in ELEMENT_FIELDS:
        raise InvalidArgumentError(f"{where}: unknown field {name!r}; {suggestion(name, ELEMENT_FIELDS)}")
    where = f"{where}[{name!r}]"
    try:
        array = np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{where}: not an array of numbers: {error}") from error
    expected = (element_count,) if ELEMENT_FIELDS[name] == 1 else (element_count, ELEMENT_FIELDS[name])
    if array.shape != expected:
        raise InvalidArgumentError(
            f"{where}: expected shape {list(expected)}, one row an element, got {list(array.shape)}"
        )
    bad = np.flatnonzero(~np.isfinite(array.reshape(element_count, -1)).all(axis=1))
    if bad.size:
        raise InvalidArgumentError(f"{where}: row {bad[0]} is not finite: {array[bad[0]].tolist()}")
    return array


def node_indices(values: npt.ArrayLike, node_count: int, where: str) -> IndexArray:
    """Returns indices [k], from indices [k] or a mask [node_count].

    Raises:
        InvalidArgumentError: neither of them; the message names `where`.
    """
    array = np.asarray(values)
    if array.dtype == np.bool_:
        if array.shape != (node_count,):
            raise InvalidArgumentError(f"{where}: a mask needs shape [{node_count}], got {list(array.shape)}")
        array = np.flatnonzero(array)
    if array.ndim != 1 or not (array.size == 0 or np.issubdtype(array.dtype, np.integer)):
        raise InvalidArgumentError(f"{where}: expected node indices or a mask, got {array.dtype} {list(array.shape)}")
    bad = array[(array < 0) | (array >= node_count)]
    if bad.size:
        raise InvalidArgumentError(f"{where}: index {bad[0]}, but nodes run from 0 to {node_count - 1}")
    return array.astype(np.uint32)
