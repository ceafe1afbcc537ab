"""Recordings of strangers that would take the memory of the machine: refused by a named limit while they are read."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from collections.abc import Iterable
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode

import tensormass as tm
from tensormass.v1 import recording_pb2, scene_pb2
from tensormass_tools.recording import chunks
from tensormass_tools.recording.chunks import MAGIC, MAX_MESSAGE_BYTES, MAX_SMALL_BYTES
from tensormass_tools.recording.file import RecordingReader, RecordingWriter

BOMB_BYTES = 4 << 30
MEMORY_BYTES = 400 << 20
"""Address space that a reader of a bomb may take beyond its own: far less than the bomb, and than its allocation."""

READ = """
import resource, sys
from pathlib import Path
import numpy, tensormass
from tensormass_tools.recording import index, file
own = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (own + int(sys.argv[2]),) * 2)
try:
    for entry in file.RecordingReader(Path(sys.argv[1])).entries():
        pass
    index.RecordingIndex(Path(sys.argv[1]))
except tensormass.TensormassError as error:
    print(type(error).__name__, error)
"""


def record(opcode: Opcode, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk(packed: bytes, holds: int, compression: bytes = b"zstd", crc: int = 0) -> bytes:
    head = struct.pack("<QQQII", 0, 0, holds, crc, len(compression)) + compression
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def zeros(count: int) -> bytes:
    """Packs zeros without holding them. The head of the frame says how many there are."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=count)
    block = bytes(1 << 20)
    return b"".join([*(packer.compress(block) for _ in range(count >> 20)), packer.flush()])


def unknown_zeros(count: int) -> bytes:
    """Packs zeros, and leaves their number out of the head."""
    packer = zstandard.ZstdCompressor(level=1, write_content_size=False).compressobj()
    block = bytes(1 << 20)
    return b"".join([*(packer.compress(block) for _ in range(count >> 20)), packer.flush()])


def begin(path: Path) -> bytes:
    """The bytes of a recording up to the end of its first chunk."""
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="block"))
        writer.add("/start", recording_pb2.RecordingStart(scene="block"))
        writer.flush()
        at = writer._file.tell()
    return path.read_bytes()[:at]


def read(path: Path, parts: Iterable[bytes]) -> str:
    """What a reader in a process with little memory says."""
    first = begin(path)
    path.write_bytes(b"".join([first, *parts]))
    done = subprocess.run(
        [sys.executable, "-c", READ, str(path), str(MEMORY_BYTES)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.strip()


@pytest.mark.parametrize("holds", [BOMB_BYTES, chunks.MAX_CHUNK_BYTES], ids=["4-GiB", "largest-chunk"])
def test_bomb_is_refused_by_its_limit(tmp_path: Path, holds: int) -> None:
    packed = zeros(holds)
    assert len(packed) < holds / 1000
    said = read(tmp_path / "bomb.mcap", [chunk(packed, holds)])
    assert said.startswith("ResourceExhaustedError ")
    assert f"holds {holds}, the limit is " in said


@pytest.mark.parametrize("claimed", [64, MAX_SMALL_BYTES])
@pytest.mark.parametrize("pack", [zeros, unknown_zeros])
def test_bomb_that_claims_to_be_small_is_damage(tmp_path: Path, pack: object, claimed: int) -> None:
    assert callable(pack)
    said = read(tmp_path / "bomb.mcap", [chunk(pack(1 << 30), claimed)])
    assert said == "" or "has no frames" in said
    path = tmp_path / "bomb.mcap"
    reader = RecordingReader(path)
    assert [entry.channel for entry in reader.entries()] == ["/scene", "/start"]
    assert reader.damaged


def test_chunk_that_claims_to_be_large_takes_no_memory_for_it(tmp_path: Path) -> None:
    said = read(tmp_path / "bomb.mcap", [chunk(unknown_zeros(1 << 20), BOMB_BYTES)])
    assert f"holds {BOMB_BYTES}, the limit is " in said


def test_message_that_is_too_long_for_its_channel_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    with RecordingWriter(path) as writer:
        writer.add("/scene", scene_pb2.Scene(name="block"))
        writer.add("/start", recording_pb2.RecordingStart(scene="block"))
        writer.flush()
        step = recording_pb2.RecordedStep(index=1)
        step.poses.extend([recording_pb2.RecordedPose()] * MAX_MESSAGE_BYTES["/inputs"])
        writer.add("/inputs", step)
    reader = RecordingReader(path)
    assert [entry.channel for entry in reader.entries()] == ["/scene", "/start"]
    assert reader.damaged


def test_other_compressions_are_damage_and_plain_chunks_are_read(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    first = begin(path)
    content = b"\x0f" + struct.pack("<Q", 3) + b"xyz"  # a record that nobody knows
    for compression, crc, damaged in ((b"", zlib.crc32(content), False), (b"", 1, True), (b"lz4", 0, True)):
        path.write_bytes(first + chunk(content, len(content), compression, crc))
        reader = RecordingReader(path)
        assert [entry.channel for entry in reader.entries()] == ["/scene", "/start"]
        assert reader.damaged == damaged


def test_channels_without_end_are_damage(tmp_path: Path) -> None:
    schemas = b"".join(
        record(Opcode.SCHEMA, struct.pack("<HIIII", number, 0, 0, 0, 0)[:14]) for number in range(1, 1100)
    )
    path = tmp_path / "channels.mcap"
    first = begin(path)
    channel = struct.pack("<HHI", 1, 1, 0) + struct.pack("<I", 0) + struct.pack("<I", 0)
    content = schemas + record(Opcode.CHANNEL, channel)
    path.write_bytes(first + chunk(content, len(content), b""))
    reader = RecordingReader(path)
    list(reader.entries())
    assert reader.damaged


def test_a_reader_without_a_recording_says_so(tmp_path: Path) -> None:
    path = tmp_path / "only.mcap"
    path.write_bytes(MAGIC + chunk(zeros(BOMB_BYTES), BOMB_BYTES))
    with pytest.raises(tm.ResourceExhaustedError, match="the limit is"):
        RecordingReader(path)
