"""Normals of a surface's vertices, for viewers that do not compute them."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from tensormass._shared.surfaces import Surface
from tensormass.v1 import stream_pb2

SCALE = 127
"""A unit normal is sent as integers of this size."""


class Triangles:
    """The triangles of all bodies in a topology."""

    def __init__(
        self, topology: stream_pb2.Topology, surface: Surface | None = None, vertex_count: int | None = None
    ) -> None:
        """Makes the triangles of a topology.

        Args:
            surface: the topology with its changes; None: it has none.
            vertex_count: positions in the frames, if they are of another revision than the surface.

        Raises:
            ValueError: a triangle names a vertex that its body does not have.
        """
        parts = [np.empty((0, 3), np.int64)]
        self.vertex_count = 0
        for body in topology.bodies:
            triangles = np.frombuffer(body.triangles, "<u4").astype(np.int64).reshape(-1, 3)
            if triangles.max(initial=-1) >= body.vertex_count:
                raise ValueError(f"a triangle of body {body.name!r} names a vertex that it does not have")
            parts.append(triangles + self.vertex_count)
            self.vertex_count += body.vertex_count
        if surface is not None and surface.is_changed:
            self.vertex_count = count = surface.vertex_count if vertex_count is None else vertex_count
            parts = [part.places[surface.triangles(body, count)[0]] for body, part in enumerate(surface.parts)]
        self._corners = np.ascontiguousarray(np.concatenate(parts).T)

    @cached_property
    def _runs(self) -> tuple[npt.NDArray[np.int64], ...]:
        """The triangles around each vertex, one vertex after the other: sums over them are then sums of a run.

        Returns the triangles, the vertices that have some, and where the run of each begins. Sorting takes longer than
        the normals of a frame, and most viewers ask for none.
        """
        corners = self._corners.T.ravel()
        order = np.argsort(corners, kind="stable")
        vertices, begins = np.unique(corners[order], return_index=True)
        return order // 3, vertices, begins

    def normals(self, planes: npt.NDArray[np.float32]) -> npt.NDArray[np.int8]:
        """Returns the normals [vertex_count, 3] in units of 1 / SCALE.

        Args:
            planes: [3, vertex_count] m, one row for each axis.
        """
        return np.rint(self.directions(planes, SCALE)).astype(np.int8)

    def directions(self, planes: npt.NDArray[np.float32], length: float = 1) -> npt.NDArray[np.float32]:
        """Returns vectors of this length along the normals, [vertex_count, 3]. Zero where no triangle has an area.

        Args:
            planes: [3, vertex_count] m, one row for each axis.
        """
        around, vertices, begins = self._runs
        (a, b, c) = self._corners
        u, v = planes[:, b] - planes[:, a], planes[:, c] - planes[:, a]
        # A cross product of two edges is the triangle's normal, weighted by twice its area.
        faces = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
        out = np.zeros((self.vertex_count, 3), np.float32)
        if len(begins) == 0:
            return out
        sums = np.stack([np.add.reduceat(face.take(around), begins) for face in faces])
        # Scales first, because squares of very small areas leave the range of floats.
        sums /= max(float(np.abs(sums).max()), float(np.finfo(np.float32).tiny))
        lengths = np.sqrt((sums * sums).sum(axis=0))
        out[vertices] = np.divide(length * sums, lengths, out=np.zeros_like(sums), where=lengths > 0).T
        return out
