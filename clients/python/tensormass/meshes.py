"""Volume meshes and triangulated surfaces: checks, geometry, quality, repair, grids, and volumes from surfaces.

Files are read and written in mesh_files.py. Only `repair` changes a mesh that came from outside.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tensormass.errors import InvalidArgumentError
from tensormass.names import suggestion
from tensormass.processes import ChildProcess
from tensormass.shapes import SHAPES, Shape

FloatArray = npt.NDArray[np.float64]
IndexArray = npt.NDArray[np.uint32]

#: Parameters of single elements that a mesh can carry, and how many components each has.
ELEMENT_FIELDS = {"young_modulus_pa": 1, "poisson_ratio": 1, "fibre_directions": 3}


class ElementBlock(NamedTuple):
    """Elements of one shape: `nodes` uint32 [element_count, nodes of the shape], VTK order."""

    shape: Shape
    nodes: IndexArray


@dataclass(frozen=True)
class VolumeMesh:
    """Elements of any shapes, conforming across their faces. An element's index counts through the blocks."""

    #: float64 [node_count, 3]
    nodes: FloatArray
    blocks: tuple[ElementBlock, ...]
    #: Named sets of nodes, uint32 [k] each; they become the body's sets.
    sets: Mapping[str, IndexArray] = field(default_factory=dict)
    #: Parameters of single elements by the names of `ELEMENT_FIELDS`, float64 [element_count] or [element_count, 3].
    element_fields: Mapping[str, FloatArray] = field(default_factory=dict)

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
            InvalidArgumentError: naming `where`, the row and the remedy.
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
        """As `from_arrays`, of linear tetrahedra [n, 4] alone."""
        return VolumeMesh.from_arrays(nodes, [("tetrahedron", tetrahedra)], where=where)

    @property
    def element_count(self) -> int:
        """Of all blocks."""
        return sum(len(block.nodes) for block in self.blocks)

    def elements(self, shape: str) -> IndexArray:
        """The elements of one shape, [n, nodes of the shape]; n may be 0."""
        empty = np.empty((0, SHAPES[shape].node_count), np.uint32)
        return np.concatenate([empty, *(block.nodes for block in self.blocks if block.shape.name == shape)])


@dataclass(frozen=True)
class TriangleSurface:
    """`vertices` float64 [vertex_count, 3]; `triangles` uint32 [triangle_count, 3], counter-clockwise from outside."""

    vertices: FloatArray
    triangles: IndexArray

    @staticmethod
    def from_arrays(vertices: npt.ArrayLike, triangles: npt.ArrayLike, where: str = "surface") -> TriangleSurface:
        """As `VolumeMesh.from_arrays`."""
        points = _checked_points(vertices, f"{where}.vertices")
        return TriangleSurface(points, _checked_indices(triangles, 3, len(points), f"{where}.triangles"))


@dataclass(frozen=True)
class MeshQuality:
    """What matters to a solver. Lengths and volumes in the mesh's own unit, of elements with straight edges."""

    node_count: int
    #: By the shape's name.
    element_counts: dict[str, int]
    volume: float
    min_dihedral_angle_deg: float
    mean_edge_length: float
    #: Elements that are turned inside out, as a whole or at a corner.
    inverted_count: int


# --- checks -----------------------------------------------------------------------------------------------------------


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
    """[k], from indices [k] or a mask [node_count].

    Raises:
        InvalidArgumentError: naming `where` and what is wrong.
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


# --- geometry ---------------------------------------------------------------------------------------------------------


def signed_volumes(mesh: VolumeMesh) -> FloatArray:
    """[element_count], negative where inverted."""
    return np.concatenate([_signed_volumes(mesh.nodes, block) for block in mesh.blocks])


def _signed_volumes(nodes: FloatArray, block: ElementBlock) -> FloatArray:
    """By the divergence theorem, exact for straight edges and bilinear faces."""
    corner = nodes[block.nodes[:, : block.shape.corner_count]]
    corner = corner - corner[:, :1]
    volumes: FloatArray = np.zeros(len(corner))
    for face in block.shape.faces:
        for (i, j, k), weight in _cuts(face):
            volumes += weight / 6 * np.einsum("ei,ei->e", corner[:, i], np.cross(corner[:, j], corner[:, k]))
    return volumes


def _cuts(face: tuple[int, ...]) -> list[tuple[tuple[int, int, int], float]]:
    """Weighted triangles of a face: a quadrilateral along both diagonals, for half each."""
    if len(face) == 3:
        return [(face, 1.0)]
    a, b, c, d = face
    return [((a, b, c), 0.5), ((a, c, d), 0.5), ((a, b, d), 0.5), ((b, c, d), 0.5)]


def _least_jacobians(nodes: FloatArray, block: ElementBlock) -> FloatArray:
    """[n]: over the corners, the determinant of the edges that leave there."""
    corner = nodes[block.nodes[:, : block.shape.corner_count]]
    frames = np.array(block.shape.corner_frames)
    a, b, c = (corner[:, frames[:, k]] - corner[:, frames[:, 0]] for k in (1, 2, 3))
    least: FloatArray = np.einsum("efi,efi->ef", np.cross(a, b), c).min(axis=1)
    return least


def dihedral_angles_deg(mesh: VolumeMesh) -> FloatArray:
    """Between the faces of an element in each of its edges, of all elements, in no particular order."""
    angles = []
    for shape, elements in mesh.blocks:
        corner = mesh.nodes[elements]
        normals = []
        for face in shape.faces:
            # The product of two sides of a triangle, of a quadrilateral's diagonals.
            first = corner[:, face[-2]] - corner[:, face[0]]
            second = corner[:, face[-1]] - corner[:, face[-3]]
            normals.append(np.cross(first, second))
        normal = np.stack(normals, axis=1)
        length = np.linalg.norm(normal, axis=2, keepdims=True)
        normal = normal / np.where(length > 0, length, 1.0)
        first_face, second_face = np.array(shape.edge_faces).T
        cosine = -np.einsum("eij,eij->ei", normal[:, first_face], normal[:, second_face])
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).reshape(-1))
    return np.concatenate(angles)


def quality(mesh: VolumeMesh) -> MeshQuality:
    """Counts, volume, edge length and the worst dihedral angle."""
    counts: dict[str, int] = {}
    lengths = []
    for shape, elements in mesh.blocks:
        counts[shape.name] = counts.get(shape.name, 0) + len(elements)
        start, end = np.array(shape.edges).T
        ends = mesh.nodes[elements]
        lengths.append(np.linalg.norm(ends[:, start] - ends[:, end], axis=2).reshape(-1))
    return MeshQuality(
        node_count=len(mesh.nodes),
        element_counts=counts,
        volume=float(signed_volumes(mesh).sum()),
        min_dihedral_angle_deg=float(dihedral_angles_deg(mesh).min()),
        mean_edge_length=float(np.concatenate(lengths).mean()),
        inverted_count=sum(int((_least_jacobians(mesh.nodes, block) <= 0).sum()) for block in mesh.blocks),
    )


def boundary(mesh: VolumeMesh) -> TriangleSurface:
    """Outward triangles of the faces that belong to one element only, on a compact list of vertices."""
    triangles = []
    for corner_count in (3, 4):
        faces = np.concatenate(
            [
                np.empty((0, corner_count), np.uint32),
                *(
                    elements[:, face]
                    for shape, elements in mesh.blocks
                    for face in shape.faces
                    if len(face) == corner_count
                ),
            ]
        )
        _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        outer = faces[np.sort(first[count == 1])]
        triangles += [outer[:, [0, k, k + 1]] for k in range(1, corner_count - 1)]
    used, index = np.unique(np.concatenate(triangles), return_inverse=True)
    return TriangleSurface(mesh.nodes[used], index.reshape(-1, 3).astype(np.uint32))


def repair(mesh: VolumeMesh) -> VolumeMesh:
    """What the daemon would refuse or warn of: inverted elements are rewound, flat ones dropped, and only the largest
    component (by volume, connected over shared nodes) is kept, on a compact list of nodes."""
    volumes = signed_volumes(mesh)
    extent = float(np.ptp(mesh.nodes, axis=0).max())
    solid = np.abs(volumes) > 1e-12 * extent**3
    if not solid.any():
        raise InvalidArgumentError("the mesh encloses no volume")
    mesh = compact(rewind(mesh), solid)
    component = _components(len(mesh.nodes), [elements for _, elements in mesh.blocks])
    of_element = np.concatenate([component[elements[:, 0]] for _, elements in mesh.blocks])
    largest = int(np.argmax(np.bincount(of_element, weights=np.abs(volumes[solid]))))
    return compact(mesh, of_element == largest)


def rewind(mesh: VolumeMesh) -> VolumeMesh:
    """Gives inverted elements the node order of their mirror image."""
    blocks = []
    for block in mesh.blocks:
        elements = block.nodes.copy()
        inverted = _signed_volumes(mesh.nodes, block) < 0
        elements[inverted] = elements[inverted][:, block.shape.mirrored]
        blocks.append(ElementBlock(block.shape, elements))
    return replace(mesh, blocks=tuple(blocks))


def compact(mesh: VolumeMesh, kept: npt.NDArray[np.bool_] | None = None) -> VolumeMesh:
    """The elements of a mask [element_count] (None: all) and the nodes that they use; the order stays; sets and
    fields follow, without sets that are left empty."""
    kept = np.ones(mesh.element_count, bool) if kept is None else kept
    ends = np.cumsum([len(elements) for _, elements in mesh.blocks])[:-1]
    blocks = [
        ElementBlock(shape, elements[mask])
        for (shape, elements), mask in zip(mesh.blocks, np.split(kept, ends), strict=True)
        if mask.any()
    ]
    used = np.unique(np.concatenate([elements.reshape(-1) for _, elements in blocks]))
    index_of = np.full(len(mesh.nodes), -1, np.int64)
    index_of[used] = np.arange(len(used))
    sets = {name: index_of[nodes][index_of[nodes] >= 0] for name, nodes in mesh.sets.items()}
    return VolumeMesh(
        np.ascontiguousarray(mesh.nodes[used]),
        tuple(ElementBlock(shape, index_of[elements].astype(np.uint32)) for shape, elements in blocks),
        {name: nodes.astype(np.uint32) for name, nodes in sets.items() if nodes.size > 0},
        {name: values[kept] for name, values in mesh.element_fields.items()},
    )


def _components(node_count: int, blocks: Sequence[npt.NDArray[np.integer]]) -> npt.NDArray[np.int64]:
    """Label of each node: the smallest node index of its component. Hooks labels together, halving the chains."""
    label = np.arange(node_count, dtype=np.int64)
    while True:
        new = label.copy()
        for elements in blocks:
            lowest = label[elements].min(axis=1)
            for corner in range(elements.shape[1]):
                np.minimum.at(new, label[elements[:, corner]], lowest)
        new = new[new]
        new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


# --- grids ------------------------------------------------------------------------------------------------------------

# How a cell is cut, its corners counted as x + 2 y + 4 z and its centre as 8; the daemon cuts `Mesh.grid` in this way.
_CELL_CUTS = {
    "tetrahedron": [[0, 1, 3, 7], [0, 5, 1, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 6, 4, 7]],
    "pyramid": [[0, 1, 3, 2, 8], [4, 6, 7, 5, 8], [0, 4, 5, 1, 8], [2, 3, 7, 6, 8], [0, 2, 6, 4, 8], [1, 5, 7, 3, 8]],
    "wedge": [[0, 1, 3, 4, 5, 7], [0, 3, 2, 4, 7, 6]],
    "hexahedron": [[0, 1, 3, 2, 4, 5, 7, 6]],
}
_CELL_CUTS["quadratic_tetrahedron"] = _CELL_CUTS["tetrahedron"]
_MIDDLES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])


def grid(
    cells: Sequence[int],
    size_m: npt.ArrayLike,
    *,
    shape: str = "tetrahedron",
    origin_m: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> VolumeMesh:
    """A box of cells [3], each cut into elements of one shape, with nodes and elements in the order of `Mesh.grid`."""
    if shape not in _CELL_CUTS:
        raise InvalidArgumentError(f"grid: unknown shape {shape!r}; {suggestion(shape, _CELL_CUTS)}")
    counts = np.array(cells, dtype=np.int64)
    size, origin = np.array(size_m, dtype=np.float64), np.array(origin_m, dtype=np.float64)
    if counts.shape != (3,) or (counts < 1).any() or size.shape != (3,) or not (size > 0).all():
        raise InvalidArgumentError(f"grid: expected three counts of cells and three lengths, got {cells!r}, {size_m!r}")
    cuts = np.array(_CELL_CUTS[shape])
    # Points are named by their place in half cells, so that corners, centres and middles are all whole.
    corner_of_cell = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)]) * 2
    local = np.concatenate([corner_of_cell, [[1, 1, 1]]])[cuts]  # [element, node, 3]
    if shape == "quadratic_tetrahedron":
        local = np.concatenate([local, (local[:, _MIDDLES[:, 0]] + local[:, _MIDDLES[:, 1]]) // 2], axis=1)
    places = (2 * _lattice(counts)[:, None, None, :] + local).reshape(-1, local.shape[1], 3)

    points = [2 * _lattice(counts + 1)]
    if shape == "pyramid":
        points.append(2 * _lattice(counts) + 1)
    if shape == "quadratic_tetrahedron":
        halves = _lattice(2 * counts + 1)
        points.append(halves[(halves % 2).any(axis=1)])
    nodes = np.concatenate(points)
    stride = np.array([1, 2 * counts[0] + 1, (2 * counts[0] + 1) * (2 * counts[1] + 1)])
    node_of = np.empty(int(np.prod(2 * counts + 1)), np.uint32)
    node_of[nodes @ stride] = np.arange(len(nodes))
    block = ElementBlock(SHAPES[shape], node_of[places @ stride])
    return VolumeMesh(origin + size * (nodes / (2.0 * counts)), (block,))


def _lattice(counts: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """[n, 3]: the points of a box, x fastest."""
    z, y, x = np.meshgrid(*(np.arange(count) for count in counts[::-1]), indexing="ij")
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)


# --- volumes from surfaces --------------------------------------------------------------------------------------------


def tetrahedralize(surface: TriangleSurface, edge_length: float) -> VolumeMesh:
    """Fills a closed surface, dirty or not, with tetrahedra (fTetWild); takes seconds to minutes.

    fTetWild draws random numbers: the mesh differs from run to run, so keep what was made.

    Args:
        edge_length: wanted length of an edge, in the surface's unit. The boundary keeps to the surface within a
            twentieth of it.

    Raises:
        InvalidArgumentError: an edge that is not positive or longer than the surface, or nothing enclosed.
    """
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if not 0 < edge_length < diagonal:
        raise InvalidArgumentError(
            f"edge length {edge_length:g}: must be positive and below the surface's diagonal, {diagonal:g}"
        )
    # A process of its own: the mesher writes files into its working directory, prints, and may end the process.
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
    return repair(VolumeMesh.from_tetrahedra(nodes, tetrahedra, "result of fTetWild"))


# Without `coarsen` edges get no longer than the input's.
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
