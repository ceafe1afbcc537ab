"""Attachments pass through the gateway: every codec and every detail has the ends of springs and which are broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon
from gateway_parts import Page, browse, options
from surfaces import attached, frame_at, two_balls

import tensormass as tm
from tensormass.v1 import stream_pb2
from tensormass_gateway.choice import Codec
from tensormass_gateway.decoding import DecodedTopology, FrameDecoder, decode_topology
from tensormass_gateway.gateway import serve

PLAIN, PLACES = two_balls()
TOPOLOGY = attached(PLAIN)
POINTS = np.linspace(0.0, 1.0, 39, dtype="<f4").reshape(13, 3)
#: Springs 1 and 9: the second one of "ligament" and the first one of "vein".
BROKEN = bytes([0b0000_0010, 0b0000_0010])


def sent(sequence: int, broken: bytes = b"") -> stream_pb2.Frame:
    frame = frame_at(TOPOLOGY, sequence, PLACES)
    frame.attachment_points = POINTS.tobytes()
    frame.broken_springs = broken
    return frame


async def taken(page: Page, decoder: FrameDecoder) -> tuple[DecodedTopology | None, stream_pb2.Frame]:
    """The next frame without its positions, and the topology that came before it."""
    topology = None
    while True:
        name, payload = await page.binary()
        if name in ("topology", "simplified_topology"):
            topology = decode_topology(name, payload)
            await page.send(type="ack", stream="topology")
        elif name in ("frame", "encoded_frame"):
            head = decoder.decode(name, payload).head
            await page.send(type="ack", stream="frame", keyframe=decoder.keyframe)
            return topology, head


@pytest.mark.parametrize("detail", [1, 0.25])
@pytest.mark.parametrize("codec", Codec)
@asynchronous
async def test_springs_pass_in_every_codec_and_detail(viewer: Path, codec: Codec, detail: float) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        daemon.topologies["balls"] = TOPOLOGY
        daemon.frames["balls"] = sent(1)
        async with browse(gateway, "balls", choice=f"codec={codec}&detail={detail}") as page:
            decoder = FrameDecoder()
            topology, head = await taken(page, decoder)
            assert topology is not None
            assert (topology.topology.version == TOPOLOGY.version) == (detail == 1)
            assert topology.topology.attachments == TOPOLOGY.attachments
            assert topology.topology.attachment_point_count == 13
            assert (head.attachment_points, head.broken_springs) == (POINTS.tobytes(), b"")
            await daemon.wait_subscribed("balls", "frame")
            for sequence in (2, 3):  # a keyframe or its difference
                await daemon.publish("balls", "frame", sent(sequence, BROKEN).SerializeToString())
                _, head = await taken(page, decoder)
                assert (head.sequence, head.attachment_points) == (sequence, POINTS.tobytes())
                assert head.broken_springs == BROKEN


@asynchronous
async def test_a_late_browser_knows_the_springs_that_broke_before(viewer: Path) -> None:
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        daemon.topologies["balls"] = TOPOLOGY
        daemon.frames["balls"] = sent(7, BROKEN)  # the scene stands still
        async with browse(gateway, "balls", choice="codec=meshopt") as page:
            _, head = await taken(page, FrameDecoder())
            assert head.broken_springs == BROKEN


def test_frames_sort_springs_by_attachment() -> None:
    frame = tm.Frame.from_message(sent(1, BROKEN), TOPOLOGY)
    ligament, vein = frame.springs("ligament"), frame.springs("vein")
    assert np.flatnonzero(ligament.broken).tolist() == [1]
    assert np.flatnonzero(vein.broken).tolist() == [0]
    assert ligament.ends_m[3].tolist() == POINTS[[3, 12]].tolist()
    assert vein.ends_m.shape == (2, 2, 3)
    lengths_m = np.linalg.norm(ligament.ends_m[:, 0] - ligament.ends_m[:, 1], axis=1)
    np.testing.assert_allclose(ligament.lengths_m, lengths_m, rtol=1e-6)
    np.testing.assert_allclose(
        ligament.tensions_n[[0, 1, 2]], 100 * (lengths_m[[0, 1, 2]] - 0.05) * [1, 0, 1], rtol=1e-5
    )
    assert (ligament.stiffness_n_per_m, ligament.breaking_force_n, vein.breaking_force_n) == (100, 3, None)
    assert "9 springs, 1 broken" in frame._repr_html_()
    with pytest.raises(tm.NotFoundError, match="no attachment 'artery'; it has: ligament, vein"):
        frame.springs("artery")


def test_springs_without_tension_are_slack() -> None:
    message = sent(1)
    message.attachment_points = np.zeros((13, 3), "<f4").tobytes()
    assert tm.Frame.from_message(message, TOPOLOGY).springs("ligament").tensions_n.tolist() == [0.0] * 9


def test_a_scene_without_attachments_has_no_springs() -> None:
    frame = tm.Frame.from_message(frame_at(PLAIN, 1, PLACES), PLAIN)  # as in recordings of earlier versions
    assert (frame.attachment_points.shape, frame.broken_springs.shape) == ((0, 3), (0,))


def test_damaged_springs_are_refused() -> None:
    for name, value, said in (
        ("attachment_points", b"", "has 0 bytes of attachment points; its topology needs 156"),
        ("broken_springs", b"\1\0\0", "3 bytes of broken springs do not fit 11 springs"),
    ):
        message = sent(1)
        setattr(message, name, value)
        with pytest.raises(tm.InternalError, match=said):
            tm.Frame.from_message(message, TOPOLOGY)
    for name, value, said in (
        ("springs", np.array([[0, 13]], "<u4").tobytes(), "a spring names point 13, but there are 13"),
        ("springs", b"1234", "4 bytes are a fraction of a spring"),
        ("rest_lengths_m", b"", "1 springs do not each have a length at rest"),
    ):
        topology = stream_pb2.Topology()
        topology.CopyFrom(TOPOLOGY)
        del topology.attachments[1]
        ligament = topology.attachments[0]
        ligament.springs, ligament.rest_lengths_m = np.array([[0, 1]], "<u4").tobytes(), b"0000"
        setattr(ligament, name, value)
        with pytest.raises(tm.InternalError, match=said):
            tm.Frame.from_message(sent(1), topology).springs("ligament")
