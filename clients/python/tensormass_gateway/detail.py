"""Surfaces with fewer triangles, for viewers that ask for less detail than a scene has.

    Topology, a frame --simplification.py, in a thread--> Level --> SimplifiedTopology, once
                                                  whole frame --> SimplifiedFrame, one for all viewers of a level

A level is made once for each topology and detail, from the first frame at hand. Its vertices are some of the scene's.
A simplified frame is therefore the whole frame at those vertices. The topology of a level has a version of its own, so
that a viewer that changes its detail never draws a frame on the triangles of another level.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tensormass.v1 import gateway_pb2, stream_pb2
from tensormass_gateway.encoding import SharedFrame
from tensormass_gateway.normals import Triangles
from tensormass_gateway.simplification import LEAST_TRIANGLES, Simplification, simplify

SIMPLIFIED_TOPOLOGY = "simplified_topology"
"""Name in the key of a level's topology. In the outbox it is a topology like others."""

VERSIONS = 1 << 19
"""A level's version is at most this much above that of the whole topology: half a millisecond of the server's clock."""

MAX_LEVELS = 8
"""Levels of a scene that are kept for viewers to come. More are kept only while viewers show them."""

SIMPLIFIER = ThreadPoolExecutor(1, "simplifier")
"""One thread for all scenes: viewers that come and go, or change their detail, take one core at most."""


class Level:
    """The surface of a topology with about a share of its triangles."""

    def __init__(self, topology: stream_pb2.Topology, whole: SharedFrame, detail: float) -> None:
        """Takes seconds for 100,000 vertices.

        Args:
            topology: that of the whole surface.
            whole: a frame of that topology, with finite positions.
            detail: share of the triangles that stay.

        Raises:
            ValueError: a triangle names a vertex that its body does not have.
        """
        Triangles(topology)
        places = whole.planes.T.astype(np.float64)
        parts = list(_parts(topology, places, detail))
        self.whole_version = topology.version
        self.whole_vertex_count = whole.vertex_count
        self.vertices = np.concatenate([np.empty(0, np.int64), *(part.vertices + first for first, part in parts)])
        """Place of each vertex in the whole frame, ascending."""
        self.topology = _simplified(topology, [part for _, part in parts])
        choice = zlib.crc32(self.vertices.astype("<u4").tobytes())
        self.topology.version = topology.version + 1 + choice % VERSIONS
        self.triangles = Triangles(self.topology)
        self._gone = np.concatenate([np.empty(0, np.int64), *(part.gone + first for first, part in parts)])
        corners = [np.empty((0, 3), np.int64), *(part.corners + first for first, part in parts)]
        self._corners = np.ascontiguousarray(np.concatenate(corners).T)
        weights = [np.empty((0, 3)), *(part.weights for _, part in parts)]
        self._weights = np.ascontiguousarray(np.concatenate(weights).T.astype(np.float32))
        self._newest: SimplifiedFrame | None = None

    @property
    def version(self) -> int:
        """Version of its topology."""
        return self.topology.version

    def fits(self, whole: SharedFrame) -> bool:
        """Tells whether a frame is of the topology that was simplified."""
        return (whole.head.topology_version, whole.vertex_count) == (self.whole_version, self.whole_vertex_count)

    def message(self) -> gateway_pb2.SimplifiedTopology:
        """Returns its topology for viewers."""
        return gateway_pb2.SimplifiedTopology(
            topology=self.topology,
            whole_vertices=self.vertices.astype("<u4").tobytes(),
            whole_version=self.whole_version,
            whole_vertex_count=self.whole_vertex_count,
        )

    def frame(self, whole: SharedFrame, key: bytes) -> SimplifiedFrame:
        """Returns a frame at its vertices, the same one for all viewers. `key` is that of frames."""
        if self._newest is None or self._newest.whole is not whole:
            self._newest = SimplifiedFrame(whole, self, key)
        return self._newest

    def rest(self, whole: stream_pb2.Frame) -> stream_pb2.Frame:
        """Returns the rest positions at its vertices."""
        positions = np.frombuffer(whole.positions, "<f4").reshape(-1, 3)[self.vertices]
        return stream_pb2.Frame(topology_version=self.version, positions=positions.tobytes())

    def error_m(self, planes: npt.NDArray[np.float32]) -> float:
        """Returns a distance from its surface that no vertex of the whole surface exceeds.

        Args:
            planes: positions of the whole frame, [3, whole_vertex_count] m.
        """
        largest = np.float32(0)
        if len(self._gone):
            a, b, c = self._corners
            _, second, third = self._weights
            offsets = []
            # From the first corner on: differences of near coordinates lose no digits.
            for axis in planes:
                start = axis[a]
                offsets.append(axis[self._gone] - start - second * (axis[b] - start) - third * (axis[c] - start))
            x, y, z = offsets
            largest = (x * x + y * y + z * z).max()
        return float(np.sqrt(largest))


class SimplifiedFrame(SharedFrame):
    """A frame at the vertices of a level."""

    def __init__(self, whole: SharedFrame, level: Level, key: bytes) -> None:
        """Makes a frame of a whole one. Positions are taken when they are needed, in the encoder's thread."""
        head = stream_pb2.Frame()
        head.CopyFrom(whole.head)
        head.topology_version = level.version
        super().__init__(b"", whole.encoded_key, head, level.triangles)
        self.whole = whole
        self._level = level
        self._key = key

    @property
    def message(self) -> bytes:
        """A frame as on the bus, for positions that are not finite."""
        frame = stream_pb2.Frame(positions=self.packed)
        frame.MergeFrom(self.head)
        return self._key + frame.SerializeToString()

    @cached_property
    def packed(self) -> bytes:
        return self.planes.T.tobytes()

    @property
    def is_whole(self) -> bool:
        return False

    @property
    def vertex_count(self) -> int:
        return len(self._level.vertices)

    @cached_property
    def planes(self) -> npt.NDArray[np.float32]:
        return np.ascontiguousarray(self.whole.planes[:, self._level.vertices])

    @property
    def is_encodable(self) -> bool:
        # A gap that is not finite would also make the error so.
        return self.whole.is_encodable

    @cached_property
    def detail_error_m(self) -> float:
        return self._level.error_m(self.whole.planes)


def _parts(
    topology: stream_pb2.Topology, places: npt.NDArray[np.float64], detail: float
) -> Iterator[tuple[int, Simplification]]:
    """Simplifies each body. Returns its first vertex in the whole frame, too."""
    first = 0
    for body in topology.bodies:
        triangles = np.frombuffer(body.triangles, "<u4").astype(np.int64).reshape(-1, 3)
        target = max(LEAST_TRIANGLES, round(detail * len(triangles)))
        yield first, simplify(places[first : first + body.vertex_count], triangles, target)
        first += body.vertex_count


def _simplified(whole: stream_pb2.Topology, parts: list[Simplification]) -> stream_pb2.Topology:
    """Returns the topology of the vertices and triangles that stay."""
    topology = stream_pb2.Topology()
    topology.CopyFrom(whole)
    first = 0
    for body, part in zip(topology.bodies, parts, strict=True):
        vertices = part.vertices
        number = np.full(body.vertex_count, -1)
        number[vertices] = np.arange(len(vertices))
        fixed = number[np.frombuffer(body.fixed_vertices, "<u4")]
        if body.texture_coordinates:
            body.texture_coordinates = _texture_coordinates(body, part)
        body.first_vertex, body.vertex_count = first, len(vertices)
        body.triangles = number[part.triangles].astype("<u4").tobytes()
        body.fixed_vertices = fixed[fixed >= 0].astype("<u4").tobytes()
        if body.nodes:
            body.nodes = np.frombuffer(body.nodes, "<u4")[vertices].tobytes()
        first += len(vertices)
    return topology


def _texture_coordinates(whole: stream_pb2.BodySurface, part: Simplification) -> bytes:
    """Returns the places in the picture of the triangles that stay.

    A corner takes the place that its vertex has in one of the whole surface's triangles. At a seam it may be the place
    on the other side, which smears the picture across one triangle.
    """
    given = np.frombuffer(whole.texture_coordinates, "<f4")
    corners = np.frombuffer(whole.triangles, "<u4")
    if len(given) != 2 * len(corners):
        raise ValueError(f"body {whole.name!r} has {len(given)} texture coordinates for {len(corners)} corners")
    place = np.zeros((whole.vertex_count, 2), "<f4")
    place[corners] = given.reshape(-1, 2)
    return place[part.triangles.reshape(-1)].tobytes()
