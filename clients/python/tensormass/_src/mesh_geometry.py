"""Geometry of meshes: volumes, angles, boundary, quality."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tensormass._src.meshes import ElementBlock, FloatArray, IndexArray, TriangleSurface, VolumeMesh


@dataclass(frozen=True)
class MeshQuality:
    """Figures that matter to a solver. Lengths and volumes are in the mesh's own unit, for elements with straight
    edges."""

    #: Number of nodes.
    node_count: int
    #: Number of elements, by the name of their shape.
    element_counts: dict[str, int]
    #: Sum over the elements; inverted ones count as negative.
    volume: float
    #: Smallest angle between two faces of an element [deg].
    min_dihedral_angle_deg: float
    #: Mean over the edges of all elements.
    mean_edge_length: float
    #: Number of elements that are inverted, as a whole or at a corner.
    inverted_count: int


def signed_volumes(mesh: VolumeMesh) -> FloatArray:
    """Returns the volume of each element, [element_count], in the cube of the mesh's unit; negative for inverted ones.

    Exact for straight edges.
    """
    return np.concatenate([_signed_volumes(mesh.nodes, block) for block in mesh.blocks])


def _signed_volumes(nodes: FloatArray, block: ElementBlock) -> FloatArray:
    """Computes volumes by the divergence theorem, exact for straight edges and bilinear faces."""
    corner = nodes[block.nodes[:, : block.shape.corner_count]]
    corner = corner - corner[:, :1]
    volumes: FloatArray = np.zeros(len(corner))
    for face in block.shape.faces:
        for (i, j, k), weight in _cuts(face):
            volumes += weight / 6 * np.einsum("ei,ei->e", corner[:, i], np.cross(corner[:, j], corner[:, k]))
    return volumes


def _cuts(face: tuple[int, ...]) -> list[tuple[tuple[int, int, int], float]]:
    """Cuts a face into weighted triangles. A quadrilateral is cut along both diagonals, each for half."""
    if len(face) == 3:
        return [(face, 1.0)]
    a, b, c, d = face
    return [((a, b, c), 0.5), ((a, c, d), 0.5), ((a, b, d), 0.5), ((b, c, d), 0.5)]


def _least_jacobians(nodes: FloatArray, block: ElementBlock) -> FloatArray:
    """Returns for each element, [n], the smallest determinant of the edges at a corner."""
    corner = nodes[block.nodes[:, : block.shape.corner_count]]
    frames = np.array(block.shape.corner_frames)
    a, b, c = (corner[:, frames[:, k]] - corner[:, frames[:, 0]] for k in (1, 2, 3))
    least: FloatArray = np.einsum("efi,efi->ef", np.cross(a, b), c).min(axis=1)
    return least


def dihedral_angles_deg(mesh: VolumeMesh) -> FloatArray:
    """Returns the angle between the two faces at each edge of each element, in no particular order."""
    angles = []
    for shape, elements in mesh.blocks:
        corner = mesh.nodes[elements]
        normals = []
        for face in shape.faces:
            # Cross product of two sides of a triangle, or of the diagonals of a quadrilateral.
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


def mesh_quality(mesh: VolumeMesh) -> MeshQuality:
    """Measures counts, volume, edge length and the worst dihedral angle of a mesh."""
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


def boundary_surface(mesh: VolumeMesh) -> TriangleSurface:
    """Returns the boundary as outward triangles, with those nodes alone that are on it. Quadrilaterals are split."""
    used, index = np.unique(boundary_triangles(mesh), return_inverse=True)
    return TriangleSurface(mesh.nodes[used], index.reshape(-1, 3).astype(np.uint32))


def boundary_triangles(mesh: VolumeMesh) -> IndexArray:
    """Returns the faces that belong to one element only, as outward triangles of the mesh's nodes, uint32 [n, 3]."""
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
    return np.concatenate(triangles)
