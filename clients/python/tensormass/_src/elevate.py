"""Linear tetrahedra made quadratic, as the daemon makes them for `Body.element_order`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass._src.meshes import ElementBlock, IndexArray, VolumeMesh
from tensormass._src.shapes import SHAPES

_EMPTY = np.empty((0, 6), np.int64)
Numbers = npt.NDArray[np.int64]


def elevated(mesh: VolumeMesh) -> VolumeMesh:
    """Returns the mesh with a node in the middle of each edge of its linear tetrahedra. Other elements and the sets are
    unchanged.

    Nodes and elements have the order that the daemon gives them: new nodes follow the mesh's own, ordered by the lower
    end of their edge, then by the higher one. Linear tetrahedra share the mid-edge nodes of quadratic ones.
    """
    count = len(mesh.nodes)
    given, first, new = _edges(mesh)
    quadratic = [nodes[:, 4:] for shape, nodes in mesh.blocks if shape.name == "quadratic_tetrahedron"]
    middles = np.concatenate([_EMPTY, *quadratic]).reshape(-1)[first]
    known = np.concatenate([given, new])
    node_of = np.concatenate([middles, count + np.arange(len(new))])
    order = np.argsort(known)

    def made_quadratic(elements: IndexArray) -> ElementBlock:
        of_edges = node_of[order[np.searchsorted(known, _edge_numbers(elements, count), sorter=order)]]
        nodes = np.concatenate([elements, of_edges.astype(np.uint32)], axis=1)
        return ElementBlock(SHAPES["quadratic_tetrahedron"], nodes)

    positions = 0.5 * (mesh.nodes[new // count] + mesh.nodes[new % count])
    blocks = [made_quadratic(block.nodes) if block.shape.name == "tetrahedron" else block for block in mesh.blocks]
    return replace(mesh, nodes=np.concatenate([mesh.nodes, positions]), blocks=tuple(blocks))


def new_edges(mesh: VolumeMesh) -> Numbers:
    """Returns both ends of each edge that gets a node, the lower one first, [n, 2], in the order of the new nodes."""
    new = _edges(mesh)[2]
    return np.stack([new // len(mesh.nodes), new % len(mesh.nodes)], axis=1)


def _edges(mesh: VolumeMesh) -> tuple[Numbers, npt.NDArray[np.intp], Numbers]:
    """Returns the edges of quadratic tetrahedra, where each of them comes first, and the edges that get a node."""
    numbers = {
        name: [_edge_numbers(nodes, len(mesh.nodes)) for shape, nodes in mesh.blocks if shape.name == name]
        for name in ("tetrahedron", "quadratic_tetrahedron")
    }
    given, first = np.unique(np.concatenate([_EMPTY, *numbers["quadratic_tetrahedron"]]), return_index=True)
    return given, first, np.setdiff1d(np.concatenate([_EMPTY, *numbers["tetrahedron"]]), given)


def _edge_numbers(elements: IndexArray, node_count: int) -> Numbers:
    """Returns a number for each edge, [element_count, 6], that sorts edges by their lower end first."""
    ends = np.sort(elements[:, SHAPES["quadratic_tetrahedron"].middles].astype(np.int64), axis=2)
    return ends[:, :, 0] * node_count + ends[:, :, 1]
