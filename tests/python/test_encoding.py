"""Frames in each codec: errors, keyframes, and what a viewer may ask for."""

from __future__ import annotations

import contextlib
import re
from typing import Any

import meshopt
import numpy as np
import numpy.typing as npt
import pytest
from asynchronous import asynchronous

from tensormass.v1 import gateway_pb2, stream_pb2
from tensormass_gateway.choice import MAX_RATE_HZ, MIN_RATE_HZ, Choice, ChoiceError, Codec, choice_of
from tensormass_gateway.decoding import (
    MAX_VERTICES,
    MAX_VERTICES_PER_BYTE,
    DecodedFrame,
    FrameDecoder,
    FrameError,
)
from tensormass_gateway.encoding import GRID_CELLS, FrameEncoder, SharedFrame
from tensormass_gateway.normals import SCALE, Triangles
from tensormass_gateway.outbox import Pace

RANDOM = np.random.default_rng(1)
CLOUD = RANDOM.uniform(-0.1, 0.2, (500, 3))
DELTA = Choice(codec=Codec.DELTA)
WITH_KEYFRAMES = [DELTA, Choice(codec=Codec.MESHOPT)]


def shared(positions: npt.NDArray[np.float64], triangles: Triangles | None = None) -> SharedFrame:
    frame = stream_pb2.Frame(sequence=3, positions=positions.astype("<f4").tobytes())
    return SharedFrame(b"frame\0" + frame.SerializeToString(), b"encoded_frame\0", frame, triangles)


class Viewer:
    """One viewer and its encoder in the gateway."""

    def __init__(self, choice: Choice) -> None:
        self.encoder, self.decoder = FrameEncoder(choice), FrameDecoder()
        self.size = 0

    async def see(self, positions: npt.NDArray[np.float64], triangles: Triangles | None = None) -> DecodedFrame:
        """Gets a frame, decodes it and acknowledges."""
        key, payload = (await self.encoder.encode(shared(positions, triangles))).split(b"\0", 1)
        self.size = len(payload)
        try:
            return self.decoder.decode(key.decode(), payload)
        finally:
            self.encoder.acknowledge(self.decoder.keyframe)


def error_of(decoded: DecodedFrame, positions: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The largest error of each axis [m]."""
    exact = positions.astype(np.float32).astype(np.float64)
    return np.asarray(np.abs(decoded.positions.astype(np.float64) - exact).max(axis=0, initial=0))


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "positions",
    [
        pytest.param(CLOUD, id="a cloud"),
        pytest.param(CLOUD * [1, 1e-3, 1e3], id="a flat and long cloud"),
        pytest.param(1e-3 * CLOUD + 1000, id="far from the origin, where float32 has few steps"),
        pytest.param(np.full((7, 3), 0.1), id="one place"),
        pytest.param(CLOUD[:1], id="one vertex"),
        pytest.param(CLOUD[:0], id="no vertex"),
    ],
)
@pytest.mark.parametrize("codec", Codec)
@asynchronous
async def test_no_coordinate_is_further_off_than_the_message_says(
    codec: Codec, positions: npt.NDArray[np.float64]
) -> None:
    viewer = Viewer(Choice(codec=codec, normals=codec is Codec.FLOAT32))
    for shift in (0, 1e-3, -2e-3):
        moved = positions + shift
        decoded = await viewer.see(moved)
        assert decoded.positions.shape == positions.shape
        assert (error_of(decoded, moved) <= decoded.error_m).all()
        if codec is Codec.FLOAT32:
            assert not decoded.error_m.any()


@asynchronous
async def test_the_stated_error_is_half_a_cell_of_the_bounding_box() -> None:
    decoded = await Viewer(Choice(codec=Codec.Q16)).see(CLOUD)
    half_a_cell = (CLOUD.max(axis=0) - CLOUD.min(axis=0)) / GRID_CELLS / 2
    assert (decoded.error_m >= half_a_cell).all()
    assert (decoded.error_m <= half_a_cell + 2**-24).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("codec", Codec)
@asynchronous
async def test_a_frame_that_is_not_finite_passes_as_it_came(codec: Codec, value: float) -> None:
    positions = CLOUD.copy()
    positions[7, 1] = value
    frame = shared(positions)
    assert await FrameEncoder(Choice(codec=codec, normals=True)).encode(frame) == frame.message


# --- keyframes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("choice", WITH_KEYFRAMES)
@asynchronous
async def test_small_moves_take_half_the_bytes_of_a_keyframe(choice: Choice) -> None:
    viewer = Viewer(choice)
    await viewer.see(CLOUD)
    keyframe = viewer.size
    await viewer.see(CLOUD + 1e-4)
    assert viewer.decoder.keyframe == 1
    assert viewer.size < 0.6 * keyframe


@asynchronous
async def test_a_frame_far_from_its_keyframe_becomes_one() -> None:
    viewer = Viewer(DELTA)
    for number, factor in enumerate((1.0, 1.5, 100.0), start=1):
        await viewer.see(factor * CLOUD)
        assert viewer.decoder.keyframe == number


@asynchronous
async def test_one_vertex_beyond_sixteen_bits_makes_a_keyframe() -> None:
    viewer = Viewer(DELTA)
    await viewer.see(CLOUD)
    torn = CLOUD.copy()
    torn[3] += 1
    decoded = await viewer.see(torn)
    assert (error_of(decoded, torn) <= decoded.error_m).all()
    assert viewer.decoder.keyframe == 2


@asynchronous
async def test_another_number_of_vertices_starts_with_a_keyframe() -> None:
    viewer = Viewer(DELTA)
    await viewer.see(CLOUD)
    await viewer.see(CLOUD[:100])
    assert viewer.decoder.keyframe == 2


@pytest.mark.parametrize("choice", WITH_KEYFRAMES)
@asynchronous
async def test_a_viewer_that_lost_its_keyframe_gets_one_by_itself(choice: Choice) -> None:
    viewer = Viewer(choice)
    await viewer.see(CLOUD)
    viewer.decoder = FrameDecoder()  # as after a reload of the page
    with pytest.raises(FrameError, match="refers to keyframe 1, but none was kept"):
        await viewer.see(CLOUD)
    decoded = await viewer.see(CLOUD)
    assert (error_of(decoded, CLOUD) <= decoded.error_m).all()
    assert viewer.decoder.keyframe == 2


@asynchronous
async def test_a_viewer_that_acknowledges_no_keyframe_gets_only_keyframes() -> None:
    encoder = FrameEncoder(DELTA)
    for _ in range(3):
        payload = (await encoder.encode(shared(CLOUD))).split(b"\0", 1)[1]
        assert gateway_pb2.EncodedFrame.FromString(payload).codec == gateway_pb2.EncodedFrame.CODEC_Q16
        encoder.acknowledge(None)


@pytest.mark.parametrize("keyframe", [0, -1, 2, 10**30, True, 1.0, "1", [1]])
@asynchronous
async def test_a_keyframe_that_was_never_sent_is_refused_and_the_next_frame_is_one(keyframe: object) -> None:
    viewer = Viewer(DELTA)
    await viewer.see(CLOUD)
    with pytest.raises(ChoiceError, match=r"acknowledged keyframe .* 1 keyframes were sent; the next frame is a"):
        viewer.encoder.acknowledge(keyframe)
    await viewer.see(CLOUD)
    assert viewer.decoder.keyframe == 2


@asynchronous
async def test_a_codec_may_change_between_two_frames() -> None:
    viewer = Viewer(DELTA)
    for codec in (Codec.DELTA, Codec.Q16, Codec.MESHOPT, Codec.FLOAT32, Codec.DELTA):
        viewer.encoder.choice = Choice(codec=codec)
        decoded = await viewer.see(CLOUD)
        assert (error_of(decoded, CLOUD) <= decoded.error_m).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"codec": 9}, "codec 9 is unknown"),
        ({"positions": b"12345"}, "fraction of a vertex"),
        ({"vertex_count": 7}, "500 positions of 7 vertices"),
        ({"normals": b"1"}, "1 bytes of normals"),
        ({"cell_m": {"x": np.inf}}, "not finite or too large"),
        ({"origin_m": {"x": np.nan}}, "not finite or too large"),
        ({"codec": gateway_pb2.EncodedFrame.CODEC_DELTA, "keyframe": 1}, "refers to keyframe 1, but none was kept"),
    ],
)
@asynchronous
async def test_a_damaged_message_is_refused_with_what_is_wrong(change: dict[str, Any], said: str) -> None:
    message = await FrameEncoder(Choice(codec=Codec.Q16)).encode(shared(CLOUD))
    encoded = gateway_pb2.EncodedFrame.FromString(message.split(b"\0", 1)[1])
    damage = gateway_pb2.EncodedFrame(**change)
    for name in change:
        encoded.ClearField(name)
    encoded.MergeFrom(damage)
    with pytest.raises(FrameError, match=said):
        FrameDecoder().decode("encoded_frame", encoded.SerializeToString())


@pytest.mark.parametrize("packed", [False, True])
def test_differences_that_do_not_fit_their_keyframe_are_refused(packed: bool) -> None:
    codecs = gateway_pb2.EncodedFrame
    keyframe = codecs(codec=codecs.CODEC_Q16, keyframe=1, vertex_count=1, positions=bytes(6))
    for count, positions, wide, said in (
        (2, bytes(6), b"", "2 vertices differ from 1"),
        (1, b"\x80\0\0", b"", "0 bytes of wide differences"),
        (1, bytes(3), b"12", "2 bytes of wide differences"),
    ):
        decoder = FrameDecoder()
        decoder.decode("encoded_frame", keyframe.SerializeToString())
        codec = codecs.CODEC_DELTA
        if packed:
            codec, rows = codecs.CODEC_MESHOPT_DELTA, np.zeros((count, 4), np.int8)
            rows[:, :3] = np.frombuffer(positions, np.int8).reshape(-1, 3)
            positions = meshopt.encode_vertex_buffer(rows)
        damage = codecs(codec=codec, keyframe=1, vertex_count=count, positions=positions, wide_differences=wide)
        with pytest.raises(FrameError, match=said):
            decoder.decode("encoded_frame", damage.SerializeToString())
        assert decoder.keyframe is None


# --- meshopt ---------------------------------------------------------------------------------------------------------


@asynchronous
async def test_meshopt_is_smaller_than_q16_and_decodes_to_the_same_bits() -> None:
    around = np.linspace(0, 2 * np.pi, 5000)
    smooth = np.stack([np.cos(around), np.sin(around), 0.1 * np.cos(7 * around)], axis=1)
    plain, packed = Viewer(Choice(codec=Codec.Q16)), Viewer(Choice(codec=Codec.MESHOPT))
    expected, decoded = await plain.see(smooth), await packed.see(smooth)
    assert decoded.positions.tobytes() == expected.positions.tobytes()
    assert decoded.error_m.tolist() == expected.error_m.tolist()
    assert packed.size < 0.6 * plain.size


@asynchronous
async def test_meshopt_of_differences_is_smaller_than_delta_and_decodes_to_the_same_bits() -> None:
    around = np.linspace(0, 2 * np.pi, 5000)
    smooth = np.stack([np.cos(around), np.sin(around), 0.1 * np.cos(7 * around)], axis=1)
    plain, packed = Viewer(DELTA), Viewer(Choice(codec=Codec.MESHOPT))
    for moved in (smooth, smooth + 1e-3 * smooth[::-1], smooth + 2e-3 * smooth[::-1]):
        moved[7] += 0.1  # a wide difference
        expected, decoded = await plain.see(moved), await packed.see(moved)
        assert decoded.positions.tobytes() == expected.positions.tobytes()
        assert packed.decoder.keyframe == plain.decoder.keyframe == 1
    assert packed.size < 0.3 * plain.size


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"vertex_count": 501}, "not in meshoptimizer's vertex codec"),
        ({"vertex_count": 499}, "not in meshoptimizer's vertex codec"),
        ({"vertex_count": 0}, "bytes of positions without vertices"),
        ({"vertex_count": 2**32 - 1}, "bytes of positions claim 4294967295 vertices"),
        (
            {"vertex_count": MAX_VERTICES_PER_BYTE * 3 + 1, "positions": b"123"},
            "3 bytes of positions claim 769 vertices",
        ),
        ({"vertex_count": MAX_VERTICES + 1, "positions": bytes(1 << 20)}, "claim 44739243 vertices"),
        ({"positions": b""}, "0 bytes of positions claim 500 vertices"),
        ({"positions": bytes(100)}, "not in meshoptimizer's vertex codec"),
        ({"positions": b"\xa1" + bytes(100)}, "not in meshoptimizer's vertex codec"),
        ({"codec": gateway_pb2.EncodedFrame.CODEC_MESHOPT_DELTA}, "not in meshoptimizer's vertex codec"),
    ],
)
@asynchronous
async def test_damaged_meshopt_is_refused_before_it_takes_memory(change: dict[str, Any], said: str) -> None:
    message = await FrameEncoder(Choice(codec=Codec.MESHOPT)).encode(shared(CLOUD))
    encoded = gateway_pb2.EncodedFrame.FromString(message.split(b"\0", 1)[1])
    for name, value in change.items():
        setattr(encoded, name, value)
    with pytest.raises(FrameError, match=said):
        FrameDecoder().decode("encoded_frame", encoded.SerializeToString())


@asynchronous
async def test_no_flipped_bit_of_meshopt_crashes_the_decoder() -> None:
    message = await FrameEncoder(Choice(codec=Codec.MESHOPT)).encode(shared(CLOUD))
    encoded = gateway_pb2.EncodedFrame.FromString(message.split(b"\0", 1)[1])
    for at in RANDOM.integers(0, 8 * len(encoded.positions), 500):
        damaged = bytearray(encoded.positions)
        damaged[at // 8] ^= 1 << (at % 8)
        changed = gateway_pb2.EncodedFrame(positions=bytes(damaged))
        changed.MergeFrom(gateway_pb2.EncodedFrame(codec=encoded.codec, vertex_count=encoded.vertex_count))
        with contextlib.suppress(FrameError):
            assert FrameDecoder().decode("encoded_frame", changed.SerializeToString()).positions.shape == (500, 3)


# --- normals ---------------------------------------------------------------------------------------------------------


def sphere() -> tuple[npt.NDArray[np.float64], Triangles]:
    """An octahedron, divided: its vertices lie along their normals."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    body = stream_pb2.BodySurface(vertex_count=6, triangles=np.array(faces, "<u4").tobytes())
    return corners, Triangles(stream_pb2.Topology(bodies=[body, body]))


@pytest.mark.parametrize("scale", [1.0, 1e-12])
@asynchronous
async def test_normals_point_out_of_a_sphere(scale: float) -> None:
    corners, triangles = sphere()
    both = scale * np.concatenate([corners, corners + 3])
    decoded = await Viewer(Choice(codec=Codec.Q16, normals=True)).see(both, triangles)
    assert decoded.normals is not None
    assert np.abs(decoded.normals - np.concatenate([corners, corners])).max() <= 1 / SCALE


@asynchronous
async def test_a_vertex_without_a_triangle_with_an_area_has_no_normal() -> None:
    corners, triangles = sphere()
    decoded = await Viewer(Choice(normals=True)).see(np.zeros((12, 3)), triangles)
    assert decoded.normals is not None
    assert not decoded.normals.any()
    # Triangles of another topology make no normals.
    assert (await Viewer(Choice(normals=True)).see(corners, triangles)).normals is None


def test_a_triangle_of_a_vertex_that_is_not_there_is_refused() -> None:
    body = stream_pb2.BodySurface(vertex_count=2, triangles=np.array([0, 1, 2], "<u4").tobytes())
    with pytest.raises(ValueError, match="names a vertex"):
        Triangles(stream_pb2.Topology(bodies=[body]))


# --- choice ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        ({"codec": "draco"}, "codec 'draco' is unknown; take one of float32, q16, delta, meshopt"),
        ({"codec": ["q16"]}, "codec ['q16'] is unknown"),
        ({"codec": None}, "codec None is unknown"),
        ({"rate_hz": 0}, "rate_hz 0 is not a number from 0.1 to 1000"),
        ({"rate_hz": -5}, "rate_hz -5 is not"),
        ({"rate_hz": float("nan")}, "rate_hz nan is not"),
        ({"rate_hz": float("inf")}, "rate_hz inf is not"),
        ({"rate_hz": 1e9}, "rate_hz 1000000000.0 is not"),
        ({"rate_hz": 10**400}, "rate_hz 1000"),
        ({"rate_hz": "30"}, "rate_hz '30' is not"),
        ({"rate_hz": True}, "rate_hz True is not"),
        ({"normals": 1}, "normals 1 is not true or false"),
        ({"normals": None}, "normals None is not true or false"),
        ({"detail": 2}, "detail 2 is not a share of the triangles from 0.01 to 1"),
        ({"detail": 0}, "detail 0 is not"),
        ({"detail": 0.009}, "detail 0.009 is not"),
        ({"detail": float("nan")}, "detail nan is not"),
        ({"detail": None}, "detail None is not"),
        ({"detail": True}, "detail True is not"),
        ({"detail": "0.5"}, "detail '0.5' is not"),
        ({"level": 2}, "'level' is unknown; a viewer chooses codec, rate_hz, normals and detail"),
        ({"codec": "q16", "rate_hz": 0}, "rate_hz 0"),
    ],
)
def test_a_choice_that_there_is_not_is_refused(request_: dict[str, object], said: str) -> None:
    with pytest.raises(ChoiceError, match=re.escape(said)) as refusal:
        Choice().changed(request_)
    assert len(str(refusal.value)) < 120


def test_a_choice_keeps_what_it_does_not_change() -> None:
    choice = Choice().changed({"codec": "delta", "rate_hz": MAX_RATE_HZ}).changed({"normals": True})
    assert choice == Choice(Codec.DELTA, MAX_RATE_HZ, normals=True)
    assert choice.changed({"rate_hz": MIN_RATE_HZ}).rate_hz == MIN_RATE_HZ
    assert choice.changed({"rate_hz": None}).rate_hz is None
    assert choice.changed({}) == choice


def test_only_frames_of_the_whole_surface_are_those_of_the_bus() -> None:
    assert Choice().is_bus
    assert Choice(detail=1.0).is_bus
    assert not Choice(detail=0.99).is_bus
    assert Choice().changed({"detail": 0.996}).is_bus


def test_a_choice_in_an_address() -> None:
    assert choice_of({"token": "t"}) == Choice()
    query = {"token": "t", "codec": "q16", "rate_hz": "30", "normals": "true", "detail": "0.257"}
    assert choice_of(query) == Choice(Codec.Q16, 30.0, normals=True, detail=0.26)
    assert choice_of({"normals": "false"}) == Choice()
    for wrong in ({"codec": ""}, {"rate_hz": "nan"}, {"rate_hz": "fast"}, {"normals": "1"}, {"detail": "all"}):
        with pytest.raises(ChoiceError):
            choice_of(wrong)


# --- rate ------------------------------------------------------------------------------------------------------------


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_frames_leave_at_the_rate_however_unevenly_they_come() -> None:
    clock = Clock()
    pace = Pace(clock)
    pace.set_rate(10.0)
    left: list[float] = []
    for gap_s in RANDOM.uniform(0.001, 0.03, 2000):
        clock.now_s += gap_s
        if pace.wait_s() == 0:
            pace.leave()
            left.append(clock.now_s)
    assert len(left) == pytest.approx(10 * (left[-1] - left[0]), rel=0.02)
    assert min(np.diff(left)) > 0.1 - 0.03


def test_a_pause_is_not_made_up_for() -> None:
    clock = Clock()
    pace = Pace(clock)
    pace.set_rate(10.0)
    pace.leave()
    clock.now_s += 60
    pace.leave()
    assert pace.wait_s() == pytest.approx(0.1)


def test_without_a_rate_every_frame_leaves_and_a_higher_rate_holds_at_once() -> None:
    clock = Clock()
    pace = Pace(clock)
    pace.leave()
    assert pace.wait_s() == 0
    pace.set_rate(0.1)
    pace.leave()
    pace.leave()
    assert pace.wait_s() > 10
    pace.set_rate(100.0)
    assert pace.wait_s() == pytest.approx(0.01)
    pace.set_rate(None)
    assert pace.wait_s() == 0
