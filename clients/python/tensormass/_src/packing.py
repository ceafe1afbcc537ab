"""Meshes as packed arrays in the protocol's messages, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src import grids, meshes
from tensormass._src.elevate import elevated, new_edges
from tensormass._src.shapes import BY_NUMBER
from tensormass.v1 import scene_pb2


def pack_mesh(mesh: meshes.VolumeMesh) -> scene_pb2.PackedMesh:
    """Packs a mesh into the protocol's little-endian float64 and uint32 arrays."""
    return scene_pb2.PackedMesh(
        node_positions=mesh.nodes.astype("<f8", copy=False).tobytes(),
        elements=[
            scene_pb2.PackedElements(shape=shape.number, nodes=elements.astype("<u4", copy=False).tobytes())
            for shape, elements in mesh.blocks
        ],
    )


def unpack_mesh(packed: scene_pb2.PackedMesh, where: str = "mesh") -> meshes.VolumeMesh:
    """Unpacks the mesh of a message.

    Raises:
        InvalidArgumentError: arrays that are cut off or do not match.
    """
    blocks = []
    for index, block in enumerate(packed.elements):
        shape = BY_NUMBER.get(block.shape or scene_pb2.SHAPE_TETRAHEDRON)
        if shape is None or len(block.nodes) % (4 * shape.node_count) != 0:
            raise InvalidArgumentError(f"{where}.elements[{index}]: an unknown shape, or not whole elements")
        blocks.append((shape.name, np.frombuffer(block.nodes, "<u4").reshape(-1, shape.node_count)))
    if len(packed.node_positions) % 24 != 0:
        raise InvalidArgumentError(f"{where}.node_positions: not a whole number of nodes")
    return meshes.VolumeMesh.from_arrays(
        np.frombuffer(packed.node_positions, "<f8").reshape(-1, 3), blocks, where=where
    )


def body_mesh(body: scene_pb2.Body) -> meshes.VolumeMesh:
    """Returns the mesh that the daemon makes of a body's message: a grid is cut into elements, and `element_order` adds
    nodes. Its nodes have the order of `SceneHandle.positions` and `SceneHandle.fields`.

    Positions are in the mesh's own unit, before `scale` and `translation_m`. The daemon also moves some of the added
    nodes to the skin; `SceneHandle.positions` has them there.

    Args:
        body: of `Scene.message`, with its mesh read: `tm.Scene.from_file("demo").body("liver")`.

    Raises:
        InvalidArgumentError: arrays that are cut off or do not match.
    """
    mesh = _given_mesh(body)
    return elevated(mesh) if body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC else mesh


def own_node_count(body: scene_pb2.Body) -> int:
    """Returns the number of nodes of a body's mesh, without those that `element_order` adds."""
    if body.mesh.WhichOneof("source") == "grid":
        return len(_given_mesh(body).nodes)
    return len(body.mesh.packed.node_positions) // 24


def middle_ends(body: scene_pb2.Body) -> npt.NDArray[np.int64]:
    """Returns the ends of the edges whose middles `element_order: quadratic` adds, [n, 2], in the order of the new
    nodes."""
    return new_edges(_given_mesh(body))


def _given_mesh(body: scene_pb2.Body) -> meshes.VolumeMesh:
    if body.mesh.WhichOneof("source") != "grid":
        return unpack_mesh(body.mesh.packed, f"body {body.name!r}")
    of = body.mesh.grid
    shape = BY_NUMBER[of.shape or scene_pb2.SHAPE_TETRAHEDRON].name
    size, origin = ([v.x, v.y, v.z] for v in (of.size_m, of.origin_m))
    return grids.grid([of.cells_x, of.cells_y, of.cells_z], size, shape=shape, origin_m=origin)


def pack_triangles(surface: meshes.TriangleSurface) -> scene_pb2.PackedTriangles:
    """Packs a surface like `pack_mesh`."""
    return scene_pb2.PackedTriangles(
        vertex_positions=surface.vertices.astype("<f8", copy=False).tobytes(),
        triangles=surface.triangles.astype("<u4", copy=False).tobytes(),
    )


def add_what_the_mesh_carries(body: scene_pb2.Body, mesh: meshes.VolumeMesh, where: str) -> None:
    """Copies named sets and element fields of a mesh. Its sets come first, because the scene's may refer to them."""
    own = list(body.sets)
    for named in own:
        if named.name in mesh.sets:
            raise InvalidArgumentError(f"{where}: the mesh has a set {named.name!r} already; name this one otherwise")
    del body.sets[:]
    for name, nodes in mesh.sets.items():
        body.sets.add(name=name).regions.add().nodes.indices.extend(nodes.tolist())
    body.sets.extend(own)
    for name, values in mesh.element_fields.items():
        setattr(body.element_fields, name, values.astype("<f8", copy=False).tobytes())
