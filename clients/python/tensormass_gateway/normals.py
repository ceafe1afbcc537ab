"""Normals of a surface's vertices, for viewers that do not compute them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tensormass.v1 import stream_pb2

SCALE = 127
"""A unit normal is sent as integers of this size."""


class Triangles:
    """The triangles of all bodies in a topology."""

    def __init__(self, topology: stream_pb2.Topology) -> None:
        """Raises ValueError if a triangle names a vertex that its body does not have."""
        parts = [np.empty((0, 3), np.int64)]
        self.vertex_count = 0
        for body in topology.bodies:
            triangles = np.frombuffer(body.triangles, "<u4").astype(np.int64).reshape(-1, 3)
            if triangles.max(initial=-1) >= body.vertex_count:
                raise ValueError(f"a triangle of body {body.name!r} names a vertex that it does not have")
            parts.append(triangles + self.vertex_count)
            self.vertex_count += body.vertex_count
        triangles = np.concatenate(parts)
        self._corners = [np.ascontiguousarray(corner) for corner in triangles.T]
        # The triangles around each vertex, one vertex after the other: sums over them are then sums of a run.
        order = np.argsort(triangles.ravel(), kind="stable")
        self._around = order // 3
        self._vertices, self._runs = np.unique(triangles.ravel()[order], return_index=True)

    def normals(self, planes: npt.NDArray[np.float32]) -> npt.NDArray[np.int8]:
        """Returns the normals [vertex_count, 3] in units of 1 / SCALE.

        Args:
            planes: [3, vertex_count] m, one row for each axis.
        """
        (a, b, c) = self._corners
        u, v = planes[:, b] - planes[:, a], planes[:, c] - planes[:, a]
        # A cross product of two edges is the triangle's normal, weighted by twice its area.
        faces = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
        packed = np.zeros((self.vertex_count, 3), np.int8)
        if len(self._runs) == 0:
            return packed
        sums = np.stack([np.add.reduceat(face.take(self._around), self._runs) for face in faces])
        # Scales first, because squares of very small areas leave the range of floats.
        sums /= max(float(np.abs(sums).max()), float(np.finfo(np.float32).tiny))
        lengths = np.sqrt((sums * sums).sum(axis=0))
        unit = np.divide(SCALE * sums, lengths, out=np.zeros_like(sums), where=lengths > 0)
        packed[self._vertices] = np.rint(unit).T
        return packed
