"""Encodes frames for viewers, each in the codec that it chose (choice.py). gateway.proto has the format.

    Feed --offers--> SharedFrame, one for all viewers --FrameEncoder, one a viewer--> bytes for its WebSocket

A frame is encoded when it leaves, so a frame that a newer one replaces costs nothing. Viewers of one scene share the
parts that do not depend on the viewer: the grid of a frame and its normals.

The codecs delta and meshopt refer to the last keyframe that the viewer acknowledged. A viewer that has lost it, or
never had one, acknowledges without a keyframe and gets one with its next frame. A frame that moved too far from its
keyframe becomes a keyframe itself, because it would hardly be smaller otherwise. So does one of another revision of
the surface.

A viewer that asked for less detail gets a SimplifiedFrame (detail.py), which is encoded in the same way.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tensormass.v1 import gateway_pb2, scene_pb2, stream_pb2
from tensormass_gateway.choice import Choice, ChoiceError, Codec
from tensormass_gateway.normals import Triangles

GRID_CELLS = 65535
"""Cells along each edge of a frame's bounding box: the largest integer of 16 bits."""

MAX_DIFFERENCE = 127
"""Largest difference to a keyframe that takes one byte [cells]."""

WIDE_MARK = -128
"""Stands for a difference that follows in two bytes."""

MAX_WIDE_DIFFERENCE = 32767

MAX_WIDE_SHARE = 1 / 8
"""A frame with a larger share of wide differences becomes a keyframe, so that the next differences are small again."""

MESHOPT_VERSION = 1
"""Version of meshoptimizer's vertex codec. Its predecessor has no differences of 16 bits, so frames are larger."""

MESHOPT_LEVEL = 2
"""Effort of the compression, 0 to 3. Level 3 takes longer and saves nothing here."""

_FLOAT32_ROUNDING = 2.0**-24


@dataclass(frozen=True)
class Grid:
    """A lattice of positions: origin + cell · q, for integers q."""

    origin_m: npt.NDArray[np.float64]
    cell_m: npt.NDArray[np.float64]

    def nearest(self, planes: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Returns the integers q [3, vertex_count] nearest to positions `planes` [3, vertex_count] m."""
        inverse = np.divide(1, self.cell_m, out=np.zeros(3), where=self.cell_m > 0)
        return np.asarray(np.rint((planes - self.origin_m[:, None]) * inverse[:, None]))

    def error_m(self, largest_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Returns the largest error of a decoded coordinate, for each axis.

        Args:
            largest_m: largest absolute coordinate of each axis.
        """
        # A decoder rounds to float32. A decoded position may lie half a cell outside of the frame's box.
        return self.cell_m / 2 + _FLOAT32_ROUNDING * (largest_m + self.cell_m)


@dataclass(frozen=True)
class Keyframe:
    """A frame to which the differences of later ones refer."""

    number: int
    grid: Grid
    cells: npt.NDArray[np.uint16]
    """q of its vertices, [3, vertex_count]."""
    revision: int = 0
    """Revision of its surface. With another one, a vertex of the same number may be another point."""


class SharedFrame:
    """One frame of a scene, for all viewers."""

    def __init__(
        self, message: bytes, encoded_key: bytes, frame: stream_pb2.Frame, triangles: Triangles | None = None
    ) -> None:
        """Takes `frame` over and removes its positions.

        Args:
            message: the frame as it came from the bus, key included.
            encoded_key: key of encoded frames, with its zero byte.
            frame: the same frame, parsed.
            triangles: those of its topology; None: no normals.
        """
        self._message = message
        self.encoded_key = encoded_key
        self._packed = frame.positions
        frame.ClearField("positions")
        self.head = frame
        self.triangles = triangles

    @property
    def message(self) -> bytes:
        """The frame as on the bus, key included."""
        return self._message

    @property
    def packed(self) -> bytes:
        """Positions as on the bus: float32 little-endian [vertex_count, 3] m."""
        return self._packed

    @property
    def detail_error_m(self) -> float:
        """Distance from the surface of this frame that no vertex of the whole surface exceeds [m]."""
        return 0.0

    @property
    def is_whole(self) -> bool:
        """Tells whether the frame has all vertices of its scene."""
        return True

    @property
    def vertex_count(self) -> int:
        return len(self.packed) // 12

    @cached_property
    def planes(self) -> npt.NDArray[np.float32]:
        """Positions [3, vertex_count] m, one row for each axis: NumPy is several times as fast on long rows."""
        return np.ascontiguousarray(np.frombuffer(self.packed, "<f4").reshape(-1, 3).T)

    @cached_property
    def box_m(self) -> npt.NDArray[np.float64]:
        """Lowest and highest coordinate of each axis, [2, 3] m; zeros without vertices."""
        if self.vertex_count == 0:
            return np.zeros((2, 3))
        return np.stack([self.planes.min(axis=1), self.planes.max(axis=1)]).astype(np.float64)

    @property
    def is_encodable(self) -> bool:
        """Tells whether positions are whole and finite. A viewer refuses other frames, so they pass as they came."""
        return len(self.packed) % 12 == 0 and bool(np.isfinite(self.box_m).all())

    @cached_property
    def largest_m(self) -> npt.NDArray[np.float64]:
        """Largest absolute coordinate of each axis."""
        return np.asarray(np.abs(self.box_m).max(axis=0))

    @cached_property
    def own_grid(self) -> Grid:
        """The grid in the frame's bounding box."""
        low, high = self.box_m
        return Grid(low, (high - low) / GRID_CELLS)

    @cached_property
    def own_cells(self) -> npt.NDArray[np.uint16]:
        """q on the frame's own grid, [3, vertex_count]."""
        return self.own_grid.nearest(self.planes).astype(np.uint16)

    @cached_property
    def packed_cells(self) -> bytes:
        return self.own_cells.T.astype("<u2").tobytes()

    @cached_property
    def packed_rows(self) -> bytes:
        """q as rows of four integers, compressed by meshoptimizer's vertex codec."""
        return _packed(self.own_cells, "<u2")

    @cached_property
    def normals(self) -> bytes:
        """Normals as EncodedFrame has them; empty without triangles."""
        if self.triangles is None or self.triangles.vertex_count != self.vertex_count:
            return b""
        return self.triangles.normals(self.planes).tobytes()


def encode(
    frame: SharedFrame, choice: Choice, held: Keyframe | None, next_number: int
) -> tuple[bytes, Keyframe | None]:
    """Returns the message of a frame, and the keyframe that it is, if it is one.

    Args:
        held: the keyframe that the viewer has; None if it has no keyframe.
        next_number: number of the next keyframe.
    """
    if (choice.is_bus and frame.is_whole) or not frame.is_encodable:
        return frame.message, None
    encoded = gateway_pb2.EncodedFrame(
        frame=frame.head,
        vertex_count=frame.vertex_count,
        normals=frame.normals if choice.normals else b"",
        detail_error_m=frame.detail_error_m,
    )
    keyframe = None
    if choice.codec is Codec.FLOAT32:
        encoded.codec = gateway_pb2.EncodedFrame.CODEC_FLOAT32
        encoded.positions = frame.packed
    elif choice.codec is Codec.Q16 or held is None or not _write_differences(encoded, frame, held, choice.codec):
        if choice.codec is Codec.MESHOPT:
            encoded.codec, encoded.positions = gateway_pb2.EncodedFrame.CODEC_MESHOPT, frame.packed_rows
        else:
            encoded.codec, encoded.positions = gateway_pb2.EncodedFrame.CODEC_Q16, frame.packed_cells
        _write_grid(encoded, frame.own_grid, frame.largest_m)
        if choice.codec is not Codec.Q16:
            keyframe = Keyframe(next_number, frame.own_grid, frame.own_cells, frame.head.revision)
            encoded.keyframe = next_number
    return frame.encoded_key + encoded.SerializeToString(), keyframe


def _write_differences(encoded: gateway_pb2.EncodedFrame, frame: SharedFrame, held: Keyframe, codec: Codec) -> bool:
    """Writes the differences of a frame to a keyframe, and tells whether they are worth it."""
    if held.cells.shape[1] != frame.vertex_count or held.revision != frame.head.revision:
        return False
    # On an axis along which the keyframe had no extent, its grid has one place only.
    flat = held.grid.cell_m == 0
    if (frame.box_m[:, flat] != held.grid.origin_m[flat]).any():
        return False
    differences = held.grid.nearest(frame.planes)
    differences -= held.cells
    sizes = np.abs(differences)
    wide = sizes > MAX_DIFFERENCE
    wide_count = np.count_nonzero(wide)
    if wide_count > MAX_WIDE_SHARE * wide.size or sizes.max(initial=0) > MAX_WIDE_DIFFERENCE:
        return False
    narrow = differences.astype(np.int16)
    if wide_count:
        encoded.wide_differences = narrow.T[wide.T].astype("<i2").tobytes()
        narrow[wide] = WIDE_MARK
    if codec is Codec.MESHOPT:
        encoded.codec, encoded.positions = gateway_pb2.EncodedFrame.CODEC_MESHOPT_DELTA, _packed(narrow, "i1")
    else:
        encoded.codec = gateway_pb2.EncodedFrame.CODEC_DELTA
        encoded.positions = narrow.T.astype(np.int8).tobytes()
    encoded.keyframe = held.number
    _write_grid(encoded, held.grid, frame.largest_m)
    return True


def _packed(planes: npt.NDArray[np.integer], kind: str) -> bytes:
    """Returns integers [3, vertex_count] as rows of four, compressed by meshoptimizer's vertex codec."""
    if planes.shape[1] == 0:
        return b""
    # Imported here: viewers in Python that use other codecs do not need the package.
    import meshopt

    rows = np.zeros((planes.shape[1], 4), kind)
    rows[:, :3] = planes.T
    return bytes(meshopt.encode_vertex_buffer_level(rows, MESHOPT_LEVEL, MESHOPT_VERSION))


def _write_grid(encoded: gateway_pb2.EncodedFrame, grid: Grid, largest_m: npt.NDArray[np.float64]) -> None:
    for field, values in (
        (encoded.origin_m, grid.origin_m),
        (encoded.cell_m, grid.cell_m),
        (encoded.error_m, grid.error_m(largest_m)),
    ):
        field.CopyFrom(scene_pb2.Vector3(x=values[0], y=values[1], z=values[2]))


class FrameEncoder:
    """Encodes the frames of one viewer, and knows which keyframe the viewer has."""

    def __init__(self, choice: Choice | None = None) -> None:
        self.choice = choice or Choice()
        self._sent: Keyframe | None = None
        self._held: Keyframe | None = None
        self._count = 0

    async def encode(self, frame: SharedFrame) -> bytes:
        """Returns the message of a frame in the chosen codec."""
        if self.choice.is_bus and frame.is_whole:
            return frame.message
        # A large frame takes milliseconds, in which other browsers are served.
        message, keyframe = await asyncio.to_thread(encode, frame, self.choice, self._held, self._count + 1)
        if keyframe is not None:
            self._sent = keyframe
            self._count = keyframe.number
        return message

    def acknowledge(self, keyframe: object) -> None:
        """Takes the number of the keyframe that the viewer has. Without one, the next frame is a keyframe.

        Raises:
            ChoiceError: there was no such keyframe. The next frame is then a keyframe, too.
        """
        known = {held.number: held for held in (self._held, self._sent) if held is not None}
        self._held = None
        if keyframe is None:
            return
        if not isinstance(keyframe, int) or isinstance(keyframe, bool) or not 1 <= keyframe <= self._count:
            raise ChoiceError(
                f"acknowledged keyframe {str(keyframe)[:20]}, but {self._count or 'no'} keyframes were sent; "
                "the next frame is a keyframe"
            )
        self._held = known.get(keyframe)
