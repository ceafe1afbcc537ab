"""Recordings as files: what public readers see, and what is left of a file that was cut off or damaged."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import full_disk
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import tensormass as tm
from tensormass.v1 import recording_pb2, scene_pb2
from tensormass_tools.recording.chunks import CHANNELS
from tensormass_tools.recording.file import RecordingReader, RecordingWriter

STEPS = 60
A_CHUNK = 10  # steps


def write(path: Path, steps: int = STEPS) -> None:
    """Writes a recording whose chunks have A_CHUNK steps."""
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="block"), 1000)
        writer.add("/start", recording_pb2.RecordingStart(scene="block", backend="cpu"))
        writer.flush()
        for index in range(1, steps + 1):
            pose = recording_pb2.RecordedPose(tool="probe", position_m=scene_pb2.Vector3(x=index / 7))
            writer.add("/inputs", recording_pb2.RecordedStep(index=index, step=index, poses=[pose]), 1000 + index)
            if index % A_CHUNK == 0:
                writer.add("/checks", recording_pb2.StateCheck(index=index, hash=index))
                writer.flush()


def indices(reader: RecordingReader) -> list[int]:
    return [entry.message.index for entry in reader.entries() if entry.channel == "/inputs"]


def test_public_readers_open_a_recording_without_our_code(tmp_path: Path) -> None:
    path = tmp_path / "block.mcap"
    write(path)
    with path.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 2 + STEPS + STEPS // A_CHUNK
    assert {channel.topic for channel in summary.channels.values()} == set(CHANNELS)
    with path.open("rb") as file:
        # Decodes by the schemas in the file.
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        steps = list(reader.iter_decoded_messages(topics=["/inputs"]))
    assert [step.decoded_message.index for step in steps] == list(range(1, STEPS + 1))
    assert [step.message.sequence for step in steps] == list(range(1, STEPS + 1))
    assert [step.message.log_time for step in steps] == list(range(1001, 1001 + STEPS))
    assert steps[7 - 1].decoded_message.poses[0].position_m.x == 1.0
    assert not isinstance(steps[0].decoded_message, recording_pb2.RecordedStep)


def test_a_file_that_was_cut_off_opens_up_to_its_last_whole_chunk(tmp_path: Path) -> None:
    path, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    write(path)
    whole = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    # The first chunk has the scene, each other one A_CHUNK steps.
    ends = [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]
    assert len(ends) == 1 + STEPS // A_CHUNK
    edges = [edge + by for edge in (8, *ends) for by in (-9, -1, 0, 1, 9)]
    for size in sorted({0, *edges[1:], *range(1, len(whole) - 1, len(whole) // 40)}):
        cut.write_bytes(whole[:size])
        if size < ends[0]:
            with pytest.raises(tm.InvalidArgumentError, match=r"cut\.mcap: (is not an MCAP file|has no scene)"):
                RecordingReader(cut)
            continue
        reader = RecordingReader(cut)
        chunks = sum(end <= size for end in ends) - 1
        assert indices(reader) == list(range(1, chunks * A_CHUNK + 1)), size
        assert reader.cut_off
        assert not reader.damaged
    assert not RecordingReader(path).cut_off


def test_a_damaged_chunk_ends_the_reading(tmp_path: Path) -> None:
    path, damaged = tmp_path / "whole.mcap", tmp_path / "damaged.mcap"
    write(path)
    whole = path.read_bytes()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    begins = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
    for at in range(begins[1], begins[-1], 31):
        damaged.write_bytes(whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :])
        read = indices(RecordingReader(damaged))
        # A damaged opcode hides a whole chunk; a replay sees the gap.
        chunks = sorted({(index - 1) // A_CHUNK for index in read})
        assert read == [A_CHUNK * chunk + i for chunk in chunks for i in range(1, A_CHUNK + 1)], at
    inside = begins[2] + 60
    damaged.write_bytes(whole[:inside] + b"\0\0\0\0" + whole[inside + 4 :])
    reader = RecordingReader(damaged)
    assert indices(reader) == list(range(1, A_CHUNK + 1))
    assert reader.damaged


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "text.mcap"
    with pytest.raises(tm.NotFoundError, match=r"text\.mcap: No such file"):
        RecordingReader(path)
    path.write_text("not a recording")
    with pytest.raises(tm.InvalidArgumentError, match="is not an MCAP file"):
        RecordingReader(path)


def test_a_full_disk_ends_a_recording_that_still_opens(tmp_path: Path) -> None:
    path = tmp_path / "block.mcap"
    write(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    with (
        full_disk(summary.chunk_indexes[4].chunk_start_offset + 20),
        pytest.raises(tm.ResourceExhaustedError, match=r"block\.mcap: File too large; the recording ends here"),
    ):
        write(path)
    reader = RecordingReader(path)
    assert indices(reader) == list(range(1, 3 * A_CHUNK + 1))
    assert reader.cut_off
