"""Visible surfaces that change: a topology and the changes since it, checked once, as triangles to draw.

    Topology, SurfaceChanges --check--> Surface --triangles(body, vertices that a frame has)--> what to draw

changes.proto says what a message means. Frames and changes may overtake each other. A surface that is newer than a
frame draws the triangles whose vertices the frame has; an older one draws what it knows.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from tensormass.v1 import changes_pb2, stream_pb2

Indices = npt.NDArray[np.uint32]
Scalar = TypeVar("Scalar", bound=np.generic)

FACE_OUTER = changes_pb2.BodyChanges.FACE_OUTER
_FACES = set(changes_pb2.BodyChanges.Face.values())


class Part(NamedTuple):
    """The surface of one body."""

    triangles: Indices
    """[n, 3]: those that are alive, with vertices numbered in the body."""
    faces: npt.NDArray[np.uint8]
    """[n]: `BodyChanges.Face` of each."""
    places: npt.NDArray[np.int64]
    """[vertices of the body, appended ones last]: the place of each in Frame.positions."""
    last_places: npt.NDArray[np.int64]
    """[n]: the largest place of a triangle's vertices."""
    coagulation: npt.NDArray[np.uint8]
    """[vertices of the body, appended ones last]: how far the tissue is coagulated, 0 to 255."""


class Surface:
    """The visible surface of a topology with its changes."""

    def __init__(self, topology: stream_pb2.Topology, changes: changes_pb2.SurfaceChanges | None = None) -> None:
        """Checks the changes.

        Args:
            changes: of this topology; None: it is as it was loaded.

        Raises:
            ValueError: a list does not fit the topology. The text says which.
        """
        self.topology = topology
        self.changes = changes if changes is not None else changes_pb2.SurfaceChanges(topology_version=topology.version)
        if changes is not None:
            check(changes, topology)

    @property
    def revision(self) -> int:
        return self.changes.revision

    @property
    def is_changed(self) -> bool:
        """Tells whether something differs from the topology. A reset takes all changes back."""
        return any(each.ByteSize() > 0 for each in self.changes.bodies)

    @property
    def vertex_count(self) -> int:
        """Vertices of a frame of this revision."""
        return self.base_count + self.changes.appended_vertex_count

    @cached_property
    def base_count(self) -> int:
        """Vertices of the topology."""
        return sum(body.vertex_count for body in self.topology.bodies)

    @cached_property
    def parts(self) -> list[Part]:
        """The surface of each body."""
        none = changes_pb2.BodyChanges()
        first, parts = 0, []
        for i, body in enumerate(self.topology.bodies):
            parts.append(_part(body, self.changes.bodies[i] if self.changes.bodies else none, first))
            first += body.vertex_count
        return parts

    def triangles(self, body: int, vertex_count: int) -> tuple[Indices, npt.NDArray[np.uint8]]:
        """Returns the triangles [n, 3] of a body whose vertices a frame has, and the `Face` [n] of each.

        Args:
            body: its place in the topology.
            vertex_count: positions in the frame.
        """
        part = self.parts[body]
        if vertex_count >= self.vertex_count:
            return part.triangles, part.faces
        there = part.last_places < vertex_count
        return part.triangles[there], part.faces[there]

    def vertices(self, body: int, values: npt.NDArray[Scalar]) -> npt.NDArray[Scalar]:
        """Returns the values of a body's vertices [n, ...], appended ones last.

        A vertex that the frame does not have gets those of the body's first one; no triangle of `triangles` uses it.

        Args:
            body: its place in the topology.
            values: of all vertices of a frame, such as its positions.
        """
        part = self.parts[body]
        count = self.topology.bodies[body].vertex_count
        if len(part.places) == count:
            first = part.places[0] if count else 0
            return values[first : first + count]
        return values[np.where(part.places < len(values), part.places, part.places[0])]


def check(changes: changes_pb2.SurfaceChanges, topology: stream_pb2.Topology) -> None:
    """Raises ValueError if changes do not fit a topology, with the body and the list."""
    if changes.topology_version != topology.version:
        raise ValueError(f"changes of topology {changes.topology_version} do not belong to {topology.version}")
    if changes.bodies and len(changes.bodies) != len(topology.bodies):
        raise ValueError(
            f"changes of {len(changes.bodies)} bodies do not fit the {len(topology.bodies)} of the topology"
        )
    base = sum(body.vertex_count for body in topology.bodies)
    for body, change in zip(topology.bodies, changes.bodies, strict=False):
        where = f"changes of body {body.name!r}"
        dead = _numbers(where, "dead_triangles", change.dead_triangles, 1)
        places = _numbers(where, "appended_vertices", change.appended_vertices, 1)
        corners = _numbers(where, "appended_triangles", change.appended_triangles, 3)
        triangle_count = len(body.triangles) // 12 + len(corners) // 3
        if len(change.appended_kinds) != len(corners) // 3:
            raise ValueError(f"{where}: {len(change.appended_kinds)} kinds of {len(corners) // 3} appended triangles")
        if (np.diff(dead) <= 0).any():
            raise ValueError(f"{where}: dead_triangles do not ascend")
        if dead.max(initial=-1) >= triangle_count:
            raise ValueError(f"{where}: dead triangle {dead.max()} of {triangle_count}")
        if len(places) and not (base <= places.min() and places.max() < base + changes.appended_vertex_count):
            raise ValueError(
                f"{where}: appended vertices are at {places.min()} to {places.max()}, not within {base} to "
                f"{base + changes.appended_vertex_count - 1}"
            )
        if corners.max(initial=-1) >= body.vertex_count + len(places):
            raise ValueError(
                f"{where}: an appended triangle names vertex {corners.max()} of {body.vertex_count + len(places)}"
            )
        if len(change.coagulation) not in (0, body.vertex_count + len(places)):
            raise ValueError(
                f"{where}: coagulation of {len(change.coagulation)} of {body.vertex_count + len(places)} vertices"
            )


def _numbers(where: str, name: str, packed: bytes, per_item: int) -> npt.NDArray[np.int64]:
    if len(packed) % (4 * per_item):
        raise ValueError(f"{where}: {len(packed)} bytes of {name} are not a multiple of {4 * per_item}")
    return np.frombuffer(packed, "<u4").astype(np.int64)


def _part(body: stream_pb2.BodySurface, change: changes_pb2.BodyChanges, first: int) -> Part:
    base = np.frombuffer(body.triangles, "<u4").reshape(-1, 3)
    appended = np.frombuffer(change.appended_triangles, "<u4").reshape(-1, 3)
    triangles = np.concatenate([base, appended]) if len(appended) else base
    faces = np.full(len(triangles), FACE_OUTER, np.uint8)
    faces[len(base) :] = np.frombuffer(change.appended_kinds, np.uint8)
    faces[~np.isin(faces, list(_FACES))] = FACE_OUTER
    dead = np.frombuffer(change.dead_triangles, "<u4")
    if len(dead):
        triangles, faces = np.delete(triangles, dead, axis=0), np.delete(faces, dead)
    places = np.concatenate(
        [np.arange(first, first + body.vertex_count), np.frombuffer(change.appended_vertices, "<u4")]
    ).astype(np.int64)
    last = places[triangles].max(axis=1) if len(triangles) else np.empty(0, np.int64)
    coagulation = np.frombuffer(change.coagulation, np.uint8) if change.coagulation else np.zeros(len(places), np.uint8)
    return Part(triangles, faces, places, last, coagulation)
