"""The springs of attachments in a frame, decoded from the protocol's messages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InternalError
from tensormass.v1 import stream_pb2


@dataclass(frozen=True)
class Springs:
    """Springs of an attachment at one moment. See `AttachmentSprings` in stream.proto."""

    #: Ends of each spring, float32 [spring_count, 2, 3] m. The first one is a node of the attachment's body.
    ends_m: npt.NDArray[np.float32]
    #: Length of each spring, [spring_count] m.
    lengths_m: npt.NDArray[np.float64]
    #: Length of each spring at rest, [spring_count] m.
    rest_lengths_m: npt.NDArray[np.float32]
    #: Force with which each spring pulls, [spring_count] N; 0 if it is slack or broken.
    tensions_n: npt.NDArray[np.float64]
    #: Whether each spring is broken, bool [spring_count].
    broken: npt.NDArray[np.bool_]
    #: Stiffness of one spring [N/m].
    stiffness_n_per_m: float
    #: Force at which one spring breaks [N]; None: it never does.
    breaking_force_n: float | None

    @staticmethod
    def from_message(
        message: stream_pb2.AttachmentSprings, points: npt.NDArray[np.float32], broken: npt.NDArray[np.bool_]
    ) -> Springs:
        """Decodes an attachment.

        Args:
            points: those of the frame, [point_count, 3] m.
            broken: the flags of its springs, bool [spring_count].

        Raises:
            InternalError: a spring without an end or a length, which a daemon does not send.
        """
        count = spring_count(message)
        pairs = np.frombuffer(message.springs, dtype="<u4").reshape(-1, 2)
        if len(message.rest_lengths_m) != 4 * count:
            raise InternalError(f"attachment {message.name!r}: {count} springs do not each have a length at rest")
        if count and int(pairs.max()) >= len(points):
            raise InternalError(
                f"attachment {message.name!r}: a spring names point {pairs.max()}, but there are {len(points)}"
            )
        ends_m = points[pairs]
        rest_lengths_m = np.frombuffer(message.rest_lengths_m, dtype="<f4")
        lengths_m = np.linalg.norm(ends_m[:, 1].astype(np.float64) - ends_m[:, 0], axis=1)
        pulls_n = message.stiffness_n_per_m * np.maximum(lengths_m - rest_lengths_m, 0.0)
        return Springs(
            ends_m=ends_m,
            lengths_m=lengths_m,
            rest_lengths_m=rest_lengths_m,
            tensions_n=np.where(broken, 0.0, pulls_n),
            broken=broken,
            stiffness_n_per_m=message.stiffness_n_per_m,
            breaking_force_n=message.breaking_force_n if message.HasField("breaking_force_n") else None,
        )


def spring_count(message: stream_pb2.AttachmentSprings) -> int:
    """Returns the number of springs. InternalError: a fraction of a spring."""
    if len(message.springs) % 8:
        raise InternalError(f"attachment {message.name!r}: {len(message.springs)} bytes are a fraction of a spring")
    return len(message.springs) // 8


def broken_flags(bits: bytes, count: int) -> npt.NDArray[np.bool_]:
    """Decodes `Frame.broken_springs`, bool [count]. InternalError: bits of another number of springs."""
    if not bits:
        return np.zeros(count, dtype=np.bool_)
    if len(bits) != (count + 7) // 8:
        raise InternalError(f"{len(bits)} bytes of broken springs do not fit {count} springs")
    return np.unpackbits(np.frombuffer(bits, dtype=np.uint8), count=count, bitorder="little").astype(np.bool_)
