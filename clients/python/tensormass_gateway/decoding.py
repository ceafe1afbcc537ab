"""Decodes frames and topologies of the gateway, for viewers in Python and as the reference for others.

clients/web/src/stream/encoded.ts is the same in TypeScript. Both decode tests/proto/encoded_frames.json to the same
bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError

from tensormass.v1 import gateway_pb2, scene_pb2, stream_pb2
from tensormass_gateway.encoding import WIDE_MARK
from tensormass_gateway.normals import SCALE

_MAX_ABSOLUTE = float(np.finfo(np.float32).max)
_MAX_CELLS = 1 << 17
"""No q is larger: 16 bits of a keyframe and 16 bits of a difference."""

MAX_VERTICES = (512 << 20) // 12
"""Vertices of the largest frame on the bus. A longer claim would only take memory."""

MAX_VERTICES_PER_BYTE = 256
"""More vertices in a byte than meshoptimizer's vertex codec can pack, which needs two bytes for 256."""


class FrameError(Exception):
    """A message is damaged, or its keyframe is missing. The text says which."""


@dataclass(frozen=True)
class DecodedTopology:
    """A topology as a viewer draws it."""

    topology: stream_pb2.Topology
    whole_version: int
    """Version of the bus's topology."""
    whole_vertices: npt.NDArray[np.uint32]
    """[vertex_count]: the place of each vertex in the frames of the bus."""


def decode_topology(stream: str, payload: bytes) -> DecodedTopology:
    """Decodes a message of the stream `topology` or `simplified_topology`, without its key.

    Raises:
        FrameError: the message is damaged.
    """
    try:
        if stream == "topology":
            topology = stream_pb2.Topology.FromString(payload)
            return DecodedTopology(topology, topology.version, np.arange(_vertex_count(topology), dtype=np.uint32))
        message = gateway_pb2.SimplifiedTopology.FromString(payload)
    except DecodeError as error:
        raise FrameError(f"a message of {stream} is not protobuf: {error}") from error
    count = _vertex_count(message.topology)
    if len(message.whole_vertices) != 4 * count:
        raise FrameError(f"{len(message.whole_vertices)} bytes name the vertices of {count}")
    vertices = np.frombuffer(message.whole_vertices, "<u4")
    if vertices.max(initial=0) >= max(message.whole_vertex_count, 1):
        raise FrameError(f"a vertex is beyond the {message.whole_vertex_count} of the whole surface")
    if (np.diff(vertices.astype(np.int64)) <= 0).any():
        raise FrameError("the vertices of the whole surface do not ascend")
    return DecodedTopology(message.topology, message.whole_version, vertices)


def _vertex_count(topology: stream_pb2.Topology) -> int:
    return sum(body.vertex_count for body in topology.bodies)


@dataclass(frozen=True)
class DecodedFrame:
    """A frame as a viewer draws it."""

    head: stream_pb2.Frame
    """The frame without its positions."""
    positions: npt.NDArray[np.float32]
    """[vertex_count, 3] m"""
    error_m: npt.NDArray[np.float64]
    """Largest error of a coordinate, [3]; zeros if positions are exact."""
    normals: npt.NDArray[np.float32] | None
    """[vertex_count, 3], unit vectors rounded to 1 / 127; None: not asked for."""
    detail_error_m: float = 0.0
    """No vertex of the whole surface is further from this surface, before rounding; zero: it is the whole surface."""


class FrameDecoder:
    """Decodes the frames of one connection. Acknowledge each with `keyframe`, also one that could not be decoded."""

    def __init__(self) -> None:
        self._number = 0
        self._cells = np.empty((0, 3), np.int32)

    @property
    def keyframe(self) -> int | None:
        """Returns the number of the keyframe that it keeps, for the acknowledgement; None if it keeps no keyframe."""
        return self._number or None

    def decode(self, stream: str, payload: bytes) -> DecodedFrame:
        """Decodes a message of the stream `frame` or `encoded_frame`, without its key.

        Raises:
            FrameError: the message is damaged, or its keyframe is not the one that is kept. The decoder then keeps no
                keyframe, so the next acknowledgement asks for one.
        """
        try:
            return self._decode(stream, payload)
        except FrameError:
            self._number = 0
            raise

    def _decode(self, stream: str, payload: bytes) -> DecodedFrame:
        try:
            if stream == "frame":
                head = stream_pb2.Frame.FromString(payload)
                positions = _floats(head.positions)
                head.ClearField("positions")
                return DecodedFrame(head, positions, np.zeros(3), None)
            message = gateway_pb2.EncodedFrame.FromString(payload)
        except DecodeError as error:
            raise FrameError(f"a message of {stream} is not protobuf: {error}") from error
        positions = self._positions(message)
        if len(positions) != message.vertex_count:
            raise FrameError(f"{len(positions)} positions of {message.vertex_count} vertices")
        normals, error_m = _normals(message), _vector(message.error_m)
        return DecodedFrame(message.frame, positions, error_m, normals, message.detail_error_m)

    def _positions(self, message: gateway_pb2.EncodedFrame) -> npt.NDArray[np.float32]:
        match message.codec:
            case gateway_pb2.EncodedFrame.CODEC_FLOAT32:
                return _floats(message.positions)
            case gateway_pb2.EncodedFrame.CODEC_Q16:
                cells = self._kept(message, _integers(message.positions, "<u2"))
            case gateway_pb2.EncodedFrame.CODEC_MESHOPT:
                cells = self._kept(message, _unpacked(message, "<u2"))
            case gateway_pb2.EncodedFrame.CODEC_DELTA:
                cells = self._moved(message, _integers(message.positions, "i1"))
            case gateway_pb2.EncodedFrame.CODEC_MESHOPT_DELTA:
                cells = self._moved(message, _unpacked(message, "i1"))
            case _:
                raise FrameError(f"codec {message.codec} is unknown")
        origin, cell = _vector(message.origin_m), _vector(message.cell_m)
        if not (np.abs(origin) + _MAX_CELLS * np.abs(cell) < _MAX_ABSOLUTE).all():
            raise FrameError("the grid of a frame is not finite or too large")
        return np.asarray((origin + cell * cells).astype(np.float32))

    def _kept(self, message: gateway_pb2.EncodedFrame, integers: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
        cells = integers.astype(np.int32)
        if message.keyframe:
            self._number, self._cells = message.keyframe, cells
        return cells

    def _moved(self, message: gateway_pb2.EncodedFrame, narrow: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
        if message.keyframe != self._number or self._number == 0:
            raise FrameError(f"a frame refers to keyframe {message.keyframe}, but {self._number or 'none'} was kept")
        differences = narrow.astype(np.int32)
        wide = differences == WIDE_MARK
        if len(message.wide_differences) != 2 * np.count_nonzero(wide):
            raise FrameError(f"{len(message.wide_differences)} bytes of wide differences do not fit their marks")
        if len(differences) != len(self._cells):
            raise FrameError(f"{len(differences)} vertices differ from {len(self._cells)} of the keyframe")
        differences[wide] = np.frombuffer(message.wide_differences, "<i2")
        return self._cells + differences


def _integers(packed: bytes, kind: str) -> npt.NDArray[np.integer]:
    if len(packed) % (3 * np.dtype(kind).itemsize):
        raise FrameError(f"{len(packed)} bytes of positions are a fraction of a vertex")
    return np.frombuffer(packed, kind).reshape(-1, 3)


def _unpacked(message: gateway_pb2.EncodedFrame, kind: str) -> npt.NDArray[np.integer]:
    packed, vertex_count = message.positions, message.vertex_count
    if vertex_count > min(MAX_VERTICES, MAX_VERTICES_PER_BYTE * len(packed)):
        raise FrameError(f"{len(packed)} bytes of positions claim {vertex_count} vertices")
    if vertex_count == 0:
        if packed:
            raise FrameError(f"{len(packed)} bytes of positions without vertices")
        return np.empty((0, 3), kind)
    import meshopt

    try:
        rows = meshopt.decode_vertex_buffer(packed, vertex_count, 4 * np.dtype(kind).itemsize)
    except ValueError as error:
        raise FrameError(f"positions are not in meshoptimizer's vertex codec: {error}") from error
    return np.asarray(rows.view(kind).reshape(-1, 4)[:, :3])


def _floats(packed: bytes) -> npt.NDArray[np.float32]:
    if len(packed) % 12:
        raise FrameError(f"{len(packed)} bytes of positions are a fraction of a vertex")
    positions = np.frombuffer(packed, "<f4").reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise FrameError("a position is not finite")
    return positions


def _normals(message: gateway_pb2.EncodedFrame) -> npt.NDArray[np.float32] | None:
    if not message.normals:
        return None
    if len(message.normals) != 3 * message.vertex_count:
        raise FrameError(f"{len(message.normals)} bytes of normals for {message.vertex_count} vertices")
    return np.frombuffer(message.normals, np.int8).reshape(-1, 3).astype(np.float32) / np.float32(SCALE)


def _vector(value: scene_pb2.Vector3) -> npt.NDArray[np.float64]:
    return np.array([value.x, value.y, value.z])
