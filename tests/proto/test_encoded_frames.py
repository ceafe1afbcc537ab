"""The gateway's messages are those of encoded_frames.json, and Python decodes them to the same bits as TypeScript."""

from __future__ import annotations

import base64
import json

import encoded_frames
import numpy as np
import pytest

from tensormass.v1 import gateway_pb2
from tensormass_gateway.decoding import FrameDecoder, FrameError


def test_the_encoder_still_writes_the_golden_messages() -> None:
    assert encoded_frames.GOLDEN.read_text() == encoded_frames.content(), "run `python tests/proto/encoded_frames.py`"


def test_the_decoder_reads_the_golden_messages_to_the_last_bit() -> None:
    decoder = FrameDecoder()
    golden = json.loads(encoded_frames.GOLDEN.read_text())
    for entry in golden["messages"]:
        payload = base64.b64decode(entry["payload"])
        if "refusal" in entry:
            with pytest.raises(FrameError):
                decoder.decode(entry["stream"], payload)
        else:
            decoded = decoder.decode(entry["stream"], payload)
            assert decoded.head.sequence == entry["sequence"]
            assert decoded.positions.astype("<f4").tobytes() == base64.b64decode(entry["positions"])
            assert decoded.error_m.tolist() == entry["error_m"]
            if entry["normals"] is None:
                assert decoded.normals is None
            else:
                assert decoded.normals is not None
                bytes_of_normals = np.frombuffer(base64.b64decode(entry["normals"]), np.int8).reshape(-1, 3)
                assert np.array_equal(decoded.normals * 127, bytes_of_normals)
        assert decoder.keyframe == entry["keyframe"], entry["name"]


def test_the_golden_messages_have_every_codec_and_a_refusal() -> None:
    entries = {entry["name"]: entry for entry in encoded_frames.connection().messages}
    assert sum("refusal" in entry for entry in entries.values()) == 3
    assert entries["small differences"]["keyframe"] == 1
    assert entries["two wide differences, outside of the box"]["keyframe"] == 1
    wide = gateway_pb2.EncodedFrame.FromString(
        base64.b64decode(entries["two wide differences, outside of the box"]["payload"])
    )
    assert len(wide.wide_differences) == 4
    packed = gateway_pb2.EncodedFrame.FromString(
        base64.b64decode(entries["meshopt of differences, two of them wide"]["payload"])
    )
    assert packed.codec == gateway_pb2.EncodedFrame.CODEC_MESHOPT_DELTA
    assert len(packed.wide_differences) == 4
