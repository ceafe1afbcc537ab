"""Writes encoded_frames.json: messages of the gateway, and what every decoder must make of them, to the last bit.

    python tests/proto/encoded_frames.py

The messages are those of one connection, in their order. test_encoded_frames.py decodes them in Python and
clients/web/test/encoded.test.ts in TypeScript. Texts in base64 hold the payload of a message, float32 positions
[vertex_count, 3] m and int8 normals [vertex_count, 3]. A message with a `refusal` must be refused.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensormass.v1 import gateway_pb2, scene_pb2, stream_pb2
from tensormass_gateway.choice import Choice, Codec
from tensormass_gateway.decoding import FrameDecoder, FrameError
from tensormass_gateway.encoding import Keyframe, SharedFrame, encode
from tensormass_gateway.normals import Triangles

GOLDEN = Path(__file__).parent / "encoded_frames.json"

# Corners of a box, without functions whose last bit depends on the machine.
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * [0.3, 0.2, 0.1] + [-0.1, 0.7, 0.01]
# More vertices than a block of meshoptimizer's vertex codec has.
LINE = np.array([[k, k * k % 97, k % 13] for k in range(600)]) * [1e-3, 1e-3, 1e-2]
TRIANGLES = np.array(
    [
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ],
    "<u4",
)


def topology() -> stream_pb2.Topology:
    body = stream_pb2.BodySurface(name="box", vertex_count=8, triangles=TRIANGLES.tobytes())
    return stream_pb2.Topology(scene="golden", version=1_800_000_000_000_000_001, bodies=[body])


def frame(sequence: int, positions: npt.NDArray[np.float64]) -> SharedFrame:
    message = stream_pb2.Frame(
        topology_version=1_800_000_000_000_000_001,
        sequence=sequence,
        step=16 * sequence,
        simulated_time_s=sequence / 64,
        server_time_ns=1_700_000_000_123_456_789 + sequence,
        positions=positions.astype("<f4").tobytes(),
        tools=[stream_pb2.ToolFeedback(tool="probe", force_n=scene_pb2.Vector3(y=1.5))],
    )
    raw = message.SerializeToString()
    return SharedFrame(b"frame\0" + raw, b"encoded_frame\0", message, Triangles(topology()))


@dataclass
class Connection:
    """The messages of one viewer, and what a decoder makes of them."""

    decoder: FrameDecoder = field(default_factory=FrameDecoder)
    held: Keyframe | None = None
    count: int = 0
    messages: list[dict[str, Any]] = field(default_factory=list)

    def send(self, name: str, shared: SharedFrame, choice: Choice) -> None:
        message, keyframe = encode(shared, choice, self.held, self.count + 1)
        if keyframe is not None:
            self.held, self.count = keyframe, keyframe.number
        self.write(name, message)

    def write(self, name: str, message: bytes) -> None:
        key, payload = message.split(b"\0", 1)
        entry: dict[str, Any] = {"name": name, "stream": key.decode(), "payload": _text(payload)}
        try:
            decoded = self.decoder.decode(key.decode(), payload)
        except FrameError as refusal:
            entry["refusal"] = str(refusal).split(":")[0]  # what follows is of the library that refused
        else:
            normals = None
            if decoded.normals is not None:
                normals = _text(np.rint(127 * decoded.normals).astype(np.int8).tobytes())
            entry |= {
                "sequence": decoded.head.sequence,
                "positions": _text(decoded.positions.astype("<f4").tobytes()),
                "error_m": decoded.error_m.tolist(),
                "normals": normals,
            }
        self.messages.append(entry | {"keyframe": self.decoder.keyframe})


def connection() -> Connection:
    made = Connection()
    moved = CORNERS.copy()
    delta = Choice(codec=Codec.DELTA)
    made.send("float32 from the bus", frame(1, CORNERS), Choice())
    made.send("float32 with normals", frame(2, CORNERS), Choice(normals=True))
    made.send("q16", frame(3, CORNERS / 3), Choice(codec=Codec.Q16, normals=True))
    made.send("q16 without extent along z", frame(4, CORNERS * [1, 1, 0]), Choice(codec=Codec.Q16))
    made.send("the first keyframe", frame(5, CORNERS), delta)
    moved += 1e-4
    made.send("small differences", frame(6, moved), delta)
    moved[7] += [0.01, -0.02, 0]
    made.send("two wide differences, outside of the box", frame(7, moved), delta)
    made.send("the second keyframe", frame(8, 2 * CORNERS), delta)
    made.held = Keyframe(1, made.held.grid, made.held.cells) if made.held is not None else None
    made.send("differences to a keyframe that is gone", frame(9, 2 * CORNERS), delta)
    made.held = None
    made.send("the keyframe that ends the gap", frame(10, 2 * CORNERS), delta)
    meshopt, packed = Choice(codec=Codec.MESHOPT, normals=True), LINE.copy()
    made.held = None
    made.send("meshopt of one block", frame(11, CORNERS / 3), meshopt)
    made.held = None
    made.send("meshopt of many blocks", frame(12, packed), meshopt)
    packed += 1e-5
    packed[300] += [0.1, -0.01, 0]
    made.send("meshopt of differences, two of them wide", frame(13, packed), meshopt)
    made.write("half a message", b"encoded_frame\0\xff\xff\xff")
    made.write("meshopt without its last byte", b"encoded_frame\0" + _cut(frame(14, CORNERS)))
    return made


def _cut(shared: SharedFrame) -> bytes:
    payload = encode(shared, Choice(codec=Codec.MESHOPT), None, 1)[0].split(b"\0", 1)[1]
    damaged = gateway_pb2.EncodedFrame.FromString(payload)
    damaged.positions = damaged.positions[:-1]
    return damaged.SerializeToString()


def content() -> str:
    return json.dumps({"vertex_count": len(CORNERS), "messages": connection().messages}, indent=1) + "\n"


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


if __name__ == "__main__":
    GOLDEN.write_text(content())
