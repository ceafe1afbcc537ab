"""Repair of volume meshes: inverted, flat and repeated elements, loose parts. What is changed becomes a note."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from tensormass._shared.components import MIN_PART, components
from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.mesh_geometry import _signed_volumes, signed_volumes
from tensormass._src.meshes import ElementBlock, VolumeMesh

# Parts that a note lists.
_MAX_LISTED = 5


def repair_mesh(mesh: VolumeMesh, *, largest: bool = False) -> VolumeMesh:
    """Repairs what the daemon would refuse: rewinds inverted elements, and drops flat and repeated ones, crumbs (parts
    below 1 % of the largest one) and nodes of no element. Parts are connected over shared nodes. `notes` of the mesh
    say what was done.

    Args:
        largest: keeps the largest part alone, by volume.

    Raises:
        InvalidArgumentError: the mesh encloses no volume.
    """
    volumes = signed_volumes(mesh)
    extent = float(np.ptp(mesh.nodes, axis=0).max())
    solid = np.abs(volumes) > 1e-12 * extent**3
    if not solid.any():
        raise InvalidArgumentError("the mesh encloses no volume")
    notes = []
    if inverted := int((volumes[solid] < 0).sum()):
        notes.append(f"{_elements(inverted, 'is', 'are')} inverted and rewound")
    if flat := int((~solid).sum()):
        notes.append(f"{_elements(flat, 'is', 'are')} flat and dropped")
    again = solid & ~_first_ones(mesh)
    if again.any():
        notes.append(
            f"{_elements(int(again.sum()), 'repeats', 'repeat')} the nodes of another one, and only that is kept"
        )
    kept = solid & ~again
    component = components(len(mesh.nodes), [elements for _, elements in compact(mesh, kept, renumber=False).blocks])
    of_element = np.concatenate([component[elements[:, 0]] for _, elements in mesh.blocks])
    kept &= _kept_parts(of_element, np.where(kept, np.abs(volumes), 0.0), notes, largest=largest)
    out = compact(rewind(mesh), kept)
    notes += [
        f"the set {name!r} has no node of what is kept and is dropped" for name in mesh.sets if name not in out.sets
    ]
    if unused := len(mesh.nodes) - len(_used(mesh)):
        notes.append(f"nodes of no element are dropped ({unused})")
    return replace(out, notes=(*mesh.notes, *notes))


def _elements(count: int, one: str, many: str) -> str:
    return f"1 element {one}" if count == 1 else f"{count} elements {many}"


def _used(mesh: VolumeMesh) -> npt.NDArray[np.integer]:
    return np.unique(np.concatenate([elements.reshape(-1) for _, elements in mesh.blocks]))


def _kept_parts(
    part: npt.NDArray[np.int64], volumes: npt.NDArray[np.float64], notes: list[str], *, largest: bool
) -> npt.NDArray[np.bool_]:
    """Chooses parts by their volumes, and notes what is kept and dropped. Returns a mask of elements."""
    names, index = np.unique(part[volumes > 0], return_inverse=True)
    of_part = np.bincount(index, weights=volumes[volumes > 0])
    counts = np.bincount(index)
    shares = of_part / of_part.sum()
    kept = of_part == of_part.max() if largest else of_part >= MIN_PART * of_part.max()
    if largest:
        kept[np.argmax(of_part) + 1 :] = False
    if (dropped := int((~kept).sum())) > 0:
        what = "1 separate part" if dropped == 1 else f"{dropped} separate parts"
        share = 100 * float(shares[~kept].sum())
        ending = "is dropped" if dropped == 1 else "are dropped"
        notes.append(f"{what} of {counts[~kept].sum()} elements and {share:.2g} % of the volume {ending}")
    if int(kept.sum()) > 1:
        listed = ", ".join(f"{100 * share:.2g} %" for share in np.sort(shares[kept])[::-1][:_MAX_LISTED])
        notes.append(
            f"{kept.sum()} separate parts are kept ({listed} of the volume): they share no node and move by "
            "themselves; largest=True, or `tensormass mesh --largest`, keeps the largest alone"
        )
    return np.isin(part, names[kept])


def _first_ones(mesh: VolumeMesh) -> npt.NDArray[np.bool_]:
    """Marks elements that are the first ones of their shape with their nodes, in any order."""
    out = np.ones(mesh.element_count, bool)
    starts = np.cumsum([0, *(len(elements) for _, elements in mesh.blocks)])
    for shape in {block.shape.name: None for block in mesh.blocks}:
        chosen = [index for index, block in enumerate(mesh.blocks) if block.shape.name == shape]
        rows = np.concatenate([np.arange(starts[index], starts[index + 1]) for index in chosen])
        nodes = np.sort(np.concatenate([mesh.blocks[index].nodes for index in chosen]), axis=1)
        _, first = np.unique(nodes, axis=0, return_index=True)
        out[rows] = False
        out[rows[first]] = True
    return out


def rewind(mesh: VolumeMesh) -> VolumeMesh:
    """Gives inverted elements the node order of their mirror image."""
    blocks = []
    for block in mesh.blocks:
        elements = block.nodes.copy()
        inverted = _signed_volumes(mesh.nodes, block) < 0
        elements[inverted] = elements[inverted][:, block.shape.mirrored]
        blocks.append(ElementBlock(block.shape, elements))
    return replace(mesh, blocks=tuple(blocks))


def compact(mesh: VolumeMesh, kept: npt.NDArray[np.bool_] | None = None, *, renumber: bool = True) -> VolumeMesh:
    """Keeps the elements of a mask [element_count] (None: all) and the nodes that they use, in the same order. Sets and
    fields follow; empty sets are dropped. Without `renumber`, all nodes stay."""
    kept = np.ones(mesh.element_count, bool) if kept is None else kept
    ends = np.cumsum([len(elements) for _, elements in mesh.blocks])[:-1]
    blocks = [
        ElementBlock(shape, elements[mask])
        for (shape, elements), mask in zip(mesh.blocks, np.split(kept, ends), strict=True)
        if mask.any()
    ]
    fields = {name: values[kept] for name, values in mesh.element_fields.items()}
    if not renumber:
        return VolumeMesh(mesh.nodes, tuple(blocks), mesh.sets, fields, mesh.notes)
    used = np.unique(np.concatenate([elements.reshape(-1) for _, elements in blocks]))
    index_of = np.full(len(mesh.nodes), -1, np.int64)
    index_of[used] = np.arange(len(used))
    sets = {name: index_of[nodes][index_of[nodes] >= 0] for name, nodes in mesh.sets.items()}
    return VolumeMesh(
        np.ascontiguousarray(mesh.nodes[used]),
        tuple(ElementBlock(shape, index_of[elements].astype(np.uint32)) for shape, elements in blocks),
        {name: nodes.astype(np.uint32) for name, nodes in sets.items() if nodes.size > 0},
        fields,
        mesh.notes,
    )
