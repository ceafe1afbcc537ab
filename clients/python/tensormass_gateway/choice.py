"""What a viewer may choose about its frames: codec, rate, normals and detail.

A viewer chooses in the address with which it connects, `/stream?token=...&codec=q16&rate_hz=30&detail=0.25`, or later
by a message of type `frames`. gateway.proto describes the codecs, simplification.py what less detail means.
"""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from google.protobuf import struct_pb2

from tensormass.v1 import gateway_pb2
from tensormass_gateway.requests import finite_number, printable

_FIELDS = gateway_pb2.FrameChoice.DESCRIPTOR.fields_by_name.keys()

MIN_RATE_HZ = 0.1
"""A viewer that wants fewer frames than this disconnects in between."""

MAX_RATE_HZ = 1000.0
"""No screen shows more frames. Without a rate, every frame that the daemon publishes leaves."""

MIN_DETAIL, MAX_DETAIL = 0.01, 1.0
"""Shares of the triangles, in hundredths. Below a hundredth an organ is a lump; 1 is the whole surface."""


class Codec(enum.StrEnum):
    """Codecs of the positions in a frame."""

    FLOAT32 = "float32"
    """The bus's own bytes."""
    Q16 = "q16"
    """16-bit integers on a grid in the bounding box of the frame."""
    DELTA = "delta"
    """Differences, of 8 bits where they fit, to the last keyframe that the viewer acknowledged."""
    MESHOPT = "meshopt"
    """The integers of delta, compressed by meshoptimizer's vertex codec."""


class ChoiceError(Exception):
    """A viewer asked for something that there is not. The text is for the viewer; its choice stays as it was."""


@dataclass(frozen=True)
class Choice:
    """The frames that a viewer gets."""

    codec: Codec = Codec.FLOAT32
    rate_hz: float | None = None
    """Most frames a second; None: every frame."""
    normals: bool = False
    """Whether a frame has the normals of its vertices."""
    detail: float = MAX_DETAIL
    """Share of the triangles, a multiple of 0.01."""

    @property
    def is_bus(self) -> bool:
        """Tells whether frames leave as they come from the bus."""
        return self.codec is Codec.FLOAT32 and not self.normals and self.is_whole

    @property
    def is_whole(self) -> bool:
        """Tells whether the viewer gets all triangles."""
        return self.detail == MAX_DETAIL

    def changed(self, request: Mapping[str, Any]) -> Choice:
        """Returns this choice with the fields of `request`: codec, rate_hz (None: every frame), normals, detail.

        Raises:
            ChoiceError: a field is unknown, or its value is.
        """
        fields = dict(request)
        if "codec" in fields and (not isinstance(fields["codec"], str) or fields["codec"] not in set(Codec)):
            raise ChoiceError(f"codec {_shown(fields['codec'])} is unknown; take one of {', '.join(Codec)}")
        if fields.get("rate_hz") is not None:
            rate_hz = finite_number(fields["rate_hz"])
            if rate_hz is None or not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
                limits = f"from {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g}"
                raise ChoiceError(f"rate_hz {_shown(fields['rate_hz'])} is not a number {limits}")
            fields["rate_hz"] = rate_hz
        if not isinstance(fields.get("normals", False), bool):
            raise ChoiceError(f"normals {_shown(fields['normals'])} is not true or false")
        if "detail" in fields:
            detail = finite_number(fields["detail"])
            if detail is None or not MIN_DETAIL <= detail <= MAX_DETAIL:
                limits = f"from {MIN_DETAIL:g} to {MAX_DETAIL:g}"
                raise ChoiceError(f"detail {_shown(fields['detail'])} is not a share of the triangles {limits}")
            fields["detail"] = round(detail, 2)
        if unknown := fields.keys() - _FIELDS:
            raise ChoiceError(f"{_shown(min(unknown))} is unknown; a viewer chooses codec, rate_hz, normals and detail")
        if "codec" in fields:
            fields["codec"] = Codec(fields["codec"])
        return replace(self, **fields)

    def message(self, error: str = "") -> gateway_pb2.ChosenFrames:
        """Returns the answer to a viewer: the choice that holds now, and why it did not change."""
        message = gateway_pb2.ChosenFrames(
            codec=self.codec, normals=self.normals, detail=self.detail, error=printable(error)
        )
        if self.rate_hz is None:
            message.rate_hz.null_value = struct_pb2.NULL_VALUE
        else:
            message.rate_hz.number_value = self.rate_hz
        return message


def choice_of(query: Mapping[str, str]) -> Choice:
    """Returns the choice in the address of a connection; other parameters are left alone.

    Raises:
        ChoiceError: a value is unknown.
    """
    request: dict[str, Any] = {name: query[name] for name in _FIELDS if name in query}
    for name in request.keys() & {"rate_hz", "detail"}:
        with contextlib.suppress(ValueError):  # `changed` refuses the text
            request[name] = float(request[name])
    if request.get("normals") in ("true", "false"):
        request["normals"] = request["normals"] == "true"
    return Choice().changed(request)


def _shown(value: object) -> str:
    """Returns a value for a message. A viewer may send a text of any length."""
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}..."
