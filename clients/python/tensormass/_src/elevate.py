"""Linear tetrahedra made quadratic, as the daemon makes them for `Body.element_order`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass._src.meshes import ElementBlock, IndexArray, VolumeMesh
from tensormass._src.shapes import QUADRATIC_MIDDLES, SHAPES


def elevated(mesh: VolumeMesh) -> VolumeMesh:
    """Returns the mesh with a node in the middle of each edge of its linear tetrahedra. Other elements and the sets are
    unchanged.

    Nodes and elements have the order that the daemon gives them: new nodes follow the mesh's own, ordered by the lower
    end of their edge, then by the higher one. Linear tetrahedra share the mid-edge nodes of quadratic ones.
    """
    linear = [nodes for shape, nodes in mesh.blocks if shape.name == "tetrahedron"]
    quadratic = [nodes for shape, nodes in mesh.blocks if shape.name == "quadratic_tetrahedron"]
    count = len(mesh.nodes)

    def edges(elements: IndexArray) -> npt.NDArray[np.int64]:
        """Returns a number for each edge, [element_count, 6], that sorts edges by their lower end first."""
        ends = np.sort(elements[:, QUADRATIC_MIDDLES].astype(np.int64), axis=2)
        return ends[:, :, 0] * count + ends[:, :, 1]

    empty = np.empty((0, 6), np.int64)
    given, first = np.unique(np.concatenate([empty, *map(edges, quadratic)]), return_index=True)
    new = np.setdiff1d(np.concatenate([empty, *map(edges, linear)]), given)
    middles = np.concatenate([empty, *(nodes[:, 4:] for nodes in quadratic)]).reshape(-1)[first]
    known = np.concatenate([given, new])
    node_of = np.concatenate([middles, count + np.arange(len(new))])
    order = np.argsort(known)

    def made_quadratic(elements: IndexArray) -> ElementBlock:
        of_edges = node_of[order[np.searchsorted(known, edges(elements), sorter=order)]]
        nodes = np.concatenate([elements, of_edges.astype(np.uint32)], axis=1)
        return ElementBlock(SHAPES["quadratic_tetrahedron"], nodes)

    positions = 0.5 * (mesh.nodes[new // count] + mesh.nodes[new % count])
    blocks = [made_quadratic(block.nodes) if block.shape.name == "tetrahedron" else block for block in mesh.blocks]
    return replace(mesh, nodes=np.concatenate([mesh.nodes, positions]), blocks=tuple(blocks))
