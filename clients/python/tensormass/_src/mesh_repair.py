"""Repair of volume meshes: inverted elements, flat elements, loose components."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass._src.errors import InvalidArgumentError
from tensormass._src.mesh_geometry import _signed_volumes, signed_volumes
from tensormass._src.meshes import ElementBlock, VolumeMesh


def repair(mesh: VolumeMesh) -> VolumeMesh:
    """Repairs what the daemon would refuse or warn of: rewinds inverted elements, drops flat ones, and keeps the
    largest component (by volume, connected over shared nodes) on a compact list of nodes."""
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
    """Keeps the elements of a mask [element_count] (None: all) and the nodes that they use, in the same order. Sets and
    fields follow; empty sets are dropped."""
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
        mesh.notes,
    )


def _components(node_count: int, blocks: Sequence[npt.NDArray[np.integer]]) -> npt.NDArray[np.int64]:
    """Labels each node with the smallest node index of its component. Merges labels and halves the chains of labels
    until nothing changes."""
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
