"""Shapes of elements, as in `Shape` of scene.proto: node order, faces, and names in files.

Edges and neighbours of a corner are derived from the faces. Nodes are in VTK order; a wedge is
positively wound if (x1 - x0) × (x2 - x0) · (x3 - x0) > 0, as in meshio, Gmsh and CalculiX.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

from tensormass.v1 import scene_pb2

_PREFIX = "SHAPE_"


@dataclass(frozen=True)
class Shape:
    """One shape. Its local nodes are the corners, then the middles of the edges."""

    #: Name in the protocol, in small letters: "quadratic_tetrahedron".
    name: str
    #: Number of nodes of an element.
    node_count: int
    #: Number of those nodes that are corners. They come first.
    corner_count: int
    #: Name in meshio.
    meshio_type: str
    #: Corners of each face, counter-clockwise seen from outside.
    faces: tuple[tuple[int, ...], ...]
    #: Node order of the mirror image, which rewinds an inverted element.
    mirrored: tuple[int, ...]
    #: Ends of the edges whose middles are the nodes after the corners.
    middles: tuple[tuple[int, int], ...] = ()
    #: [edge](corner, corner), each once.
    edges: tuple[tuple[int, int], ...] = field(init=False)
    #: [edge](face, face): the two faces that meet in it.
    edge_faces: tuple[tuple[int, int], ...] = field(init=False)
    #: [corner](corner, neighbour, neighbour, neighbour), positively wound; without corners of four neighbours.
    corner_frames: tuple[tuple[int, int, int, int], ...] = field(init=False)

    def __post_init__(self) -> None:
        faces_of: dict[tuple[int, int], list[int]] = {}
        for index, face in enumerate(self.faces):
            for a, b in zip(face, face[1:] + face[:1], strict=True):
                faces_of.setdefault((min(a, b), max(a, b)), []).append(index)
        object.__setattr__(self, "edges", tuple(sorted(faces_of)))
        object.__setattr__(self, "edge_faces", tuple((f[0], f[1]) for _, f in sorted(faces_of.items())))
        frames = []
        for corner in range(self.corner_count):
            neighbours = {a + b - corner for a, b in faces_of if corner in (a, b)}
            face = next(face for face in self.faces if corner in face)
            at = face.index(corner)
            after, before = face[(at + 1) % len(face)], face[at - 1]
            if len(neighbours) == 3:
                (inwards,) = neighbours - {after, before}
                frames.append((corner, before, after, inwards))
        object.__setattr__(self, "corner_frames", tuple(frames))

    @property
    def number(self) -> scene_pb2.Shape:
        """Returns the protocol's value."""
        return cast(scene_pb2.Shape, scene_pb2.Shape.Value(_PREFIX + self.name.upper()))


_TETRAHEDRON_FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
_HEXAHEDRON_FACES = ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
_ALL = (
    Shape("tetrahedron", 4, 4, "tetra", _TETRAHEDRON_FACES, (0, 2, 1, 3)),
    Shape("pyramid", 5, 5, "pyramid", ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)), (0, 3, 2, 1, 4)),
    Shape(
        "wedge",
        6,
        6,
        "wedge",
        ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
        (0, 2, 1, 3, 5, 4),
    ),
    Shape(
        "hexahedron",
        8,
        8,
        "hexahedron",
        _HEXAHEDRON_FACES,
        (0, 3, 2, 1, 4, 7, 6, 5),
    ),
    Shape(
        "quadratic_tetrahedron",
        10,
        4,
        "tetra10",
        _TETRAHEDRON_FACES,
        (0, 2, 1, 3, 6, 5, 4, 7, 9, 8),
        ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)),
    ),
    Shape(
        "quadratic_hexahedron",
        20,
        8,
        "hexahedron20",
        _HEXAHEDRON_FACES,
        (0, 3, 2, 1, 4, 7, 6, 5, 11, 10, 9, 8, 15, 14, 13, 12, 16, 19, 18, 17),
        ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
    ),
)
#: Shapes by name.
SHAPES = {shape.name: shape for shape in _ALL}
BY_MESHIO_TYPE = {shape.meshio_type: shape for shape in _ALL}
BY_NUMBER = {shape.number: shape for shape in _ALL}
