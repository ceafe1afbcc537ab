"""Meshes for the cases, made here and not by the server: mapped boxes of cells, cut into elements of one shape."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass.v1 import scene_pb2

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """nodes: [node_count, 3] m; blocks: elements of each shape, [element_count, nodes of the shape], in VTK order."""

    nodes: Floats
    blocks: tuple[tuple[str, Integers], ...]

    def where(self, condition: Callable[[Floats, Floats, Floats], npt.NDArray[np.bool_]]) -> Integers:
        """Indices of nodes. condition: (x, y, z) [node_count] to a mask; called once."""
        return np.flatnonzero(condition(*self.nodes.T))

    def boundary(self) -> Integers:
        """Indices of the nodes on the boundary."""
        return np.unique(np.concatenate(boundary_faces(self)))

    def message(self) -> scene_pb2.Mesh:
        packed = scene_pb2.PackedMesh(node_positions=self.nodes.astype("<f8").tobytes())
        for shape, elements in self.blocks:
            packed.elements.add(shape=SHAPES[shape].number, nodes=elements.astype("<u4").tobytes())
        return scene_pb2.Mesh(packed=packed)


@dataclass(frozen=True)
class Shape:
    """number: value in the protocol. faces: corners counter-clockwise seen from outside, then edge midpoints."""

    number: scene_pb2.Shape
    faces: tuple[tuple[int, ...], ...]
    # Cuts hexahedra into this shape: (nodes, cells [cell_count, 8]) to (nodes, elements).
    cut: Callable[[Floats, Integers], tuple[Floats, Integers]]
    # Order of the complete polynomials that it interpolates exactly.
    order: int = 1


_HEXAHEDRON_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_WEDGE_FACES = ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5))


def _cut_hexahedra(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    return nodes, cells


def _cut_wedges(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    """Cuts each cell into two wedges, extruded along its third axis."""
    return nodes, cells[:, [[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]]].reshape(-1, 6)


def _with_centres(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    """Adds the centre of each cell; returns all nodes and the indices of the centres."""
    return np.vstack([nodes, nodes[cells].mean(axis=1)]), len(nodes) + np.arange(len(cells))


def _cut_pyramids(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    """Cuts each cell into six pyramids with their apex at its centre. A base is a face seen from inside."""
    all_nodes, centres = _with_centres(nodes, cells)
    bases = cells[:, np.array(_HEXAHEDRON_FACES)[:, ::-1]]
    return all_nodes, np.concatenate([bases, np.repeat(centres[:, None, None], 6, axis=1)], axis=2).reshape(-1, 5)


def _triangles(face: Integers) -> list[Integers]:
    """Cuts a face along the diagonal through its smallest node index, so that both neighbours cut it alike."""
    if len(face) == 3:
        return [face]
    face = np.roll(face, -int(np.argmin(face)))
    return [face[[0, 1, 2]], face[[0, 2, 3]]]


def _cut_tetrahedra(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    """Cuts each cell into two wedges, and each wedge into three tetrahedra. Their apex is the wedge's smallest node
    index, their bases the triangles of the faces without that node."""
    nodes, wedges = _cut_wedges(nodes, cells)
    out = []
    for wedge in wedges:
        apex = wedge.min()
        for face in _WEDGE_FACES:
            if apex not in wedge[list(face)]:
                out += [[*triangle[::-1], apex] for triangle in _triangles(wedge[list(face)])]
    return nodes, np.array(out)


# Ends of the edges whose middles are the nodes after the corners.
_MIDDLES = {
    "quadratic_tetrahedron": ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)),
    "quadratic_hexahedron": (
        *((0, 1), (1, 2), (2, 3), (3, 0)),
        *((4, 5), (5, 6), (6, 7), (7, 4)),
        *((0, 4), (1, 5), (2, 6), (3, 7)),
    ),
}


def _with_middles(shape: str, nodes: Floats, linear: Integers) -> tuple[Floats, Integers]:
    """Adds a node in the middle of each edge of linear elements."""
    local = np.array(_MIDDLES[shape])
    ends = np.sort(linear[:, local].reshape(-1, 2), axis=1)
    edges, edge_of = np.unique(ends, axis=0, return_inverse=True)
    middles = len(nodes) + edge_of.reshape(-1, len(local))
    return np.vstack([nodes, nodes[edges].mean(axis=1)]), np.hstack([linear, middles])


def _cut_quadratic_tetrahedra(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    return _with_middles("quadratic_tetrahedron", *_cut_tetrahedra(nodes, cells))


def _cut_quadratic_hexahedra(nodes: Floats, cells: Integers) -> tuple[Floats, Integers]:
    return _with_middles("quadratic_hexahedron", nodes, cells)


SHAPES = {
    "tetrahedron": Shape(scene_pb2.SHAPE_TETRAHEDRON, ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)), _cut_tetrahedra),
    "pyramid": Shape(
        scene_pb2.SHAPE_PYRAMID, ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)), _cut_pyramids
    ),
    "wedge": Shape(scene_pb2.SHAPE_WEDGE, _WEDGE_FACES, _cut_wedges),
    "hexahedron": Shape(scene_pb2.SHAPE_HEXAHEDRON, _HEXAHEDRON_FACES, _cut_hexahedra),
    "quadratic_tetrahedron": Shape(
        scene_pb2.SHAPE_QUADRATIC_TETRAHEDRON,
        ((0, 2, 1, 6, 5, 4), (0, 1, 3, 4, 8, 7), (1, 2, 3, 5, 9, 8), (0, 3, 2, 7, 9, 6)),
        _cut_quadratic_tetrahedra,
        order=2,
    ),
    "quadratic_hexahedron": Shape(
        scene_pb2.SHAPE_QUADRATIC_HEXAHEDRON,
        (
            (0, 3, 2, 1, 11, 10, 9, 8),
            (4, 5, 6, 7, 12, 13, 14, 15),
            (0, 1, 5, 4, 8, 17, 12, 16),
            (1, 2, 6, 5, 9, 18, 13, 17),
            (2, 3, 7, 6, 10, 19, 14, 18),
            (3, 0, 4, 7, 11, 16, 15, 19),
        ),
        _cut_quadratic_hexahedra,
        order=2,
    ),
}

# All shapes, and one mesh that mixes the linear ones.
MESHES = (*SHAPES, "mixed")


def cell_grid(cells: tuple[int, int, int]) -> tuple[Floats, Integers]:
    """The unit cube as a grid: nodes [n, 3] and hexahedra [cells, 8]."""
    axes = [np.linspace(0, 1, count + 1) for count in cells]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(nodes)).reshape([count + 1 for count in cells])
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    nx, ny, nz = cells
    hexahedra = [index[i : nx + i, j : ny + j, k : nz + k].ravel() for i, j, k in corners]
    return nodes, np.stack(hexahedra, axis=1)


def from_cells(shape: str, nodes: Floats, cells: Integers) -> Mesh:
    """Cuts hexahedra [cells, 8] into one shape."""
    all_nodes, elements = SHAPES[shape].cut(nodes, cells)
    return Mesh(all_nodes, ((shape, elements),))


def box(
    shape: str,
    cells: tuple[int, int, int],
    size_m: tuple[float, float, float] = (1, 1, 1),
    place: Callable[[Floats], Floats] = lambda nodes: nodes,
) -> Mesh:
    """A box with a corner at the origin. Its cells are cut into `shape`, or for "mixed" into another shape in each
    layer of x.

    place: nodes [n, 3] m to moved nodes. It is called before cells are cut, so that edge midpoints stay midpoints.
    """
    nodes, hexahedra = cell_grid(cells)
    nodes = place(nodes * np.array(size_m))
    if shape == "mixed":
        return _mixed(nodes, hexahedra, cells)
    return from_cells(shape, nodes, hexahedra)


def _mixed(nodes: Floats, hexahedra: Integers, cells: tuple[int, int, int]) -> Mesh:
    """Layers along x: hexahedra, wedges, pyramids, a transition, then tetrahedra around the cells' centres."""
    if cells[0] < 5:
        raise ValueError("a mixed mesh needs five layers of cells along x")
    layer = np.repeat(np.arange(cells[0]), cells[1] * cells[2])
    _, wedges = _cut_wedges(nodes, hexahedra[layer == 1])
    nodes, cut = _cut_pyramids(nodes, hexahedra[layer == 2])
    pyramids = list(cut)
    tetrahedra = []
    for first in (3, 4):
        chosen = hexahedra[layer == 3] if first == 3 else hexahedra[layer > 3]
        nodes, centres = _with_centres(nodes, chosen)
        for cell, centre in zip(chosen, centres, strict=True):
            for number, local in enumerate(_HEXAHEDRON_FACES):
                face = cell[list(local)]
                if first == 3 and number == 5:  # towards the pyramids
                    pyramids.append(np.array([*face[::-1], centre]))
                else:
                    tetrahedra += [[*triangle[::-1], centre] for triangle in _triangles(face)]
    blocks = [
        ("hexahedron", hexahedra[layer == 0]),
        ("wedge", wedges),
        ("pyramid", np.array(pyramids)),
        ("tetrahedron", np.array(tetrahedra)),
    ]
    return Mesh(nodes, tuple(blocks))


def boundary_faces(mesh: Mesh) -> list[Integers]:
    """Faces that belong to only one element."""
    once: dict[tuple[int, ...], Integers] = {}
    for shape, elements in mesh.blocks:
        for local in SHAPES[shape].faces:
            for face in elements[:, list(local)]:
                key = tuple(sorted(face.tolist()))
                if once.pop(key, None) is None:
                    once[key] = face
    return list(once.values())


def shaken(seed: int, share: float, cells: tuple[int, int, int]) -> Callable[[Floats], Floats]:
    """A `place` for the unit cube: moves inner nodes by up to `share` of a cell and keeps the boundary."""

    def place(nodes: Floats) -> Floats:
        inside = np.all((nodes > 1e-9) & (nodes < 1 - 1e-9), axis=1)
        random = np.random.default_rng(seed).uniform(-share, share, nodes.shape)
        return nodes + np.where(inside[:, None], random / np.array(cells), 0)

    return place


def sphere_octant(shape: str, across: int, through: int, inner_m: float, outer_m: float) -> Mesh:
    """The octant x, y, z >= 0 of a thick sphere around the origin: three patches of across² cells in `through` layers.

    Edge midpoints lie on the sphere too.
    """
    grid, hexahedra = cell_grid((across, across, through))
    nodes: list[Floats] = []
    cells: list[Integers] = []
    # A patch is a third of the octant, in which one coordinate is the largest.
    for axis in range(3):
        tangents = np.tan(np.pi / 4 * grid[:, :2])
        direction = np.empty_like(grid)
        direction[:, axis] = 1
        direction[:, (axis + 1) % 3] = tangents[:, 0]
        direction[:, (axis + 2) % 3] = tangents[:, 1]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        cells.append(hexahedra + len(nodes) * len(grid))
        nodes.append(direction * (inner_m + (outer_m - inner_m) * grid[:, 2:]))
    all_nodes = np.vstack(nodes)
    _, first, merged = np.unique(np.round(all_nodes / outer_m, 9), axis=0, return_index=True, return_inverse=True)
    mesh = from_cells(shape, all_nodes[first], merged.reshape(-1)[np.vstack(cells)])
    return _middles_on_sphere(mesh) if shape in _MIDDLES else mesh


def _middles_on_sphere(mesh: Mesh) -> Mesh:
    ((shape, elements),) = mesh.blocks
    nodes = mesh.nodes.copy()
    edges = _MIDDLES[shape]
    for edge, (i, j) in enumerate(edges, start=elements.shape[1] - len(edges)):
        middle, ends = elements[:, edge], nodes[elements[:, [i, j]]]
        radius = np.linalg.norm(ends, axis=2).mean(axis=1)
        straight = ends.mean(axis=1)
        nodes[middle] = straight * (radius / np.linalg.norm(straight, axis=1))[:, None]
    return Mesh(nodes, ((shape, elements),))
