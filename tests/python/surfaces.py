"""Triangulated surfaces for tests, and scenes that show them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tensormass.v1 import stream_pb2

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def ball(halvings: int) -> tuple[Floats, Indices]:
    """A unit sphere: an octahedron whose triangles are divided into four, `halvings` times."""
    points = [(1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0, 0, 1.0), (0, 0, -1.0)]
    triangles = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(halvings):
        middles: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, middles: dict[tuple[int, int], int] = middles) -> int:
            if (edge := (min(a, b), max(a, b))) not in middles:
                middles[edge] = len(points)
                points.append(tuple((np.array(points[a]) + points[b]) / 2))
            return middles[edge]

        divided = []
        for a, b, c in triangles:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            divided += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = divided
    positions = np.array(points)
    return positions / np.linalg.norm(positions, axis=1, keepdims=True), np.array(triangles, np.int64)


def plate(cells: int) -> tuple[Floats, Indices]:
    """A flat square with an edge of 1, open around."""
    x, y = np.meshgrid(np.arange(cells + 1) / cells, np.arange(cells + 1) / cells, indexing="ij")
    positions = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return positions, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def two_balls() -> tuple[stream_pb2.Topology, Floats]:
    """A scene of two bodies: a ball of nodes, some of them fixed, and a coarser one beside it with a skin."""
    (large, large_triangles), (small, small_triangles) = ball(4), ball(3)
    fixed = np.flatnonzero(large[:, 2] < -0.5)
    bodies = [
        stream_pb2.BodySurface(
            name="large",
            vertex_count=len(large),
            triangles=large_triangles.astype("<u4").tobytes(),
            nodes=(7 * np.arange(len(large)) + 3).astype("<u4").tobytes(),
            fixed_vertices=fixed.astype("<u4").tobytes(),
        ),
        stream_pb2.BodySurface(
            name="small",
            first_vertex=len(large),
            vertex_count=len(small),
            triangles=small_triangles.astype("<u4").tobytes(),
        ),
    ]
    topology = stream_pb2.Topology(scene="balls", version=1_800_000_000_000_000_001, bodies=bodies)
    topology.tools.add(name="probe", radius_m=0.01)
    return topology, np.concatenate([0.1 * large, 0.05 * small + [0.3, 0, 0]])


def attached(topology: stream_pb2.Topology) -> stream_pb2.Topology:
    """The same scene with 11 springs between its bodies, of two attachments."""
    out = stream_pb2.Topology()
    out.CopyFrom(topology)
    for name, pairs, breaking_force_n in (
        ("ligament", [(i, 12) for i in range(9)], 3.0),
        ("vein", [(9, 10), (9, 11)], None),
    ):
        out.attachments.add(
            name=name,
            springs=np.array(pairs, "<u4").tobytes(),
            rest_lengths_m=np.full(len(pairs), 0.05, "<f4").tobytes(),
            stiffness_n_per_m=100.0,
            breaking_force_n=breaking_force_n,
        )
    out.attachment_point_count = 13
    return out


def frame_at(topology: stream_pb2.Topology, sequence: int, positions: Floats) -> stream_pb2.Frame:
    return stream_pb2.Frame(
        topology_version=topology.version,
        sequence=sequence,
        step=sequence,
        positions=positions.astype("<f4").tobytes(),
        tools=[stream_pb2.ToolFeedback(tool="probe")],
    )


def pressed(positions: Floats, depth: float) -> Floats:
    """The same vertices, pushed down by up to `depth` around the top of the first ball."""
    dent = depth * np.exp(-((positions[:, 0] ** 2 + positions[:, 1] ** 2) / 0.03**2))
    return positions - np.stack([0 * dent, 0 * dent, dent], axis=1)


def distance_to(points: Floats, positions: Floats, triangles: Indices) -> Floats:
    """The distance of each point from the nearest triangle, all against all: the plain way."""
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    least = np.full(len(points), np.inf)
    normal = np.cross(b - a, c - a)
    for i, p in enumerate(points):
        # Inside of a triangle's prism the distance is that from its plane, elsewhere that from its sides.
        sides = [(np.cross(t - s, p - s) * normal).sum(axis=1) for s, t in ((a, b), (b, c), (c, a))]
        inside = np.min(sides, axis=0) >= 0
        plane = np.abs(((p - a) * normal).sum(axis=1)) / np.linalg.norm(normal, axis=1)
        least[i] = plane[inside].min(initial=np.inf)
        for s, t in ((a, b), (b, c), (c, a)):
            along = np.clip(((p - s) * (t - s)).sum(axis=1) / ((t - s) ** 2).sum(axis=1), 0, 1)
            least[i] = min(least[i], np.linalg.norm(p - s - along[:, None] * (t - s), axis=1).min())
    return least
