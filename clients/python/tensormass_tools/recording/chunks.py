"""The chunks of a recording, one after the other: what a stranger's file may take of this machine.

    file    | header | chunk | indices | chunk | ...   | data end, summary, footer
    chunk     size, sum, packed content -> schemas, channels, messages

A chunk states what it holds before it is unpacked. That must be within the limits, and what comes out must be what it
stated. Only one chunk is unpacked at a time, and its messages are read one by one.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from google.protobuf.message import DecodeError, Message
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.records import Message as McapMessage

from tensormass import InvalidArgumentError, NotFoundError, ResourceExhaustedError
from tensormass.v1 import changes_pb2, event_pb2, recording_pb2, scene_pb2, stream_pb2

#: Message of each channel.
CHANNELS: dict[str, type[Message]] = {
    "/scene": scene_pb2.Scene,
    "/start": recording_pb2.RecordingStart,
    "/edits": recording_pb2.RecordedEdit,
    "/inputs": recording_pb2.RecordedStep,
    "/checks": recording_pb2.StateCheck,
    "/lost": recording_pb2.LostSteps,
    "/status": stream_pb2.SceneStatus,
    "/topology": stream_pb2.Topology,
    "/changes": changes_pb2.SurfaceChanges,
    "/events": event_pb2.SceneEvents,
    "/frames": stream_pb2.Frame,
}
#: A larger chunk is refused. One frame has at most 512 MiB on the bus.
MAX_CHUNK_BYTES = 576 << 20
#: A chunk that holds more than so many times its size in the file is refused, if it holds more than MAX_SMALL_BYTES.
MAX_RATIO = 1000
MAX_SMALL_BYTES = 16 << 20
#: Bytes of a message in channels whose messages are small; a longer one is damage. Read, a message takes more memory.
MAX_MESSAGE_BYTES = {"/inputs": 1 << 20, "/checks": 64 << 10, "/lost": 1 << 10, "/status": 1 << 20, "/events": 1 << 20}
#: Edits between two steps (kMaxEditsOfStep): a recording has those on which the next step depends.
MAX_EDITS_OF_STEP = 67
#: Schemas and channels of a file. We write eleven of each.
MAX_CHANNELS = 1000

#: Failures of a chunk whose bytes are not those that were written. ValueError: also a wrong checksum.
DAMAGE = (McapError, zstandard.ZstdError, DecodeError, struct.error, ValueError, OverflowError)

MAGIC = b"\x89MCAP0\r\n"
#: In front of each record: an opcode and a length.
RECORD = struct.Struct("<BQ")

# Size of the content of packed data whose head does not say it.
_UNKNOWN = -1
# In front of the data of a message.
_MESSAGE_HEAD_BYTES = 22


class ChunkPlace(NamedTuple):
    """The place of a chunk's record in the file."""

    at: int
    size: int


class Found(NamedTuple):
    """A message in a chunk."""

    channel: str
    at: int
    data: bytes


class Channels:
    """The channels of a file that are ours. A chunk may use those of an earlier one."""

    def __init__(self) -> None:
        self._topics: dict[int, str] = {}
        self._schemas: dict[int, str] = {}

    def messages(self, content: bytes) -> Iterator[Found]:
        """Yields the messages of a chunk in our channels, in their order. Raises an error of DAMAGE."""
        stream = ReadDataStream(io.BytesIO(content))
        while stream.count < len(content):
            opcode, length = stream.read1(), stream.read8()
            end = stream.count + length
            if end > len(content) or (opcode == Opcode.MESSAGE and length < _MESSAGE_HEAD_BYTES):
                raise ValueError("a record is longer than its chunk, or too short")
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                self._take_channel(Channel.read(stream))
            elif opcode == Opcode.MESSAGE:
                message = McapMessage.read(stream, length)
                if found := self._found(message, end):
                    yield found
            if stream.count > end:
                raise ValueError("a record is longer than it says")
            stream.read(end - stream.count)

    def _take_channel(self, channel: Channel) -> None:
        kind = CHANNELS.get(channel.topic)
        if kind is not None and self._schemas.get(channel.schema_id) == kind.DESCRIPTOR.full_name:
            self._topics[channel.id] = channel.topic
        if len(self._topics) + len(self._schemas) > MAX_CHANNELS:
            raise ValueError(f"more than {MAX_CHANNELS} channels")

    def _found(self, message: McapMessage, end: int) -> Found | None:
        topic = self._topics.get(message.channel_id)
        if topic is None:
            return None
        if len(message.data) > MAX_MESSAGE_BYTES.get(topic, MAX_CHUNK_BYTES):
            raise ValueError(f"a message of {topic} has {len(message.data)} bytes")
        return Found(topic, end - len(message.data), message.data)


def chunk_places(path: Path, whole_bytes: int, *, cut_off: bool) -> Iterator[ChunkPlace]:
    """Yields place and size of each chunk. Raises ValueError where there is something else than a record."""
    with path.open("rb") as file:
        at = len(MAGIC)
        while at + RECORD.size <= whole_bytes:
            file.seek(at)
            opcode, size = RECORD.unpack(file.read(RECORD.size))
            if Opcode(opcode) is Opcode.DATA_END:  # raises ValueError for an unknown one
                return
            if at + RECORD.size + size > whole_bytes:
                raise ValueError("a record is longer than the file")
            if opcode == Opcode.CHUNK:
                yield ChunkPlace(at + RECORD.size, size)
            at += RECORD.size + size
    if not cut_off:
        raise ValueError("the file has no end")


def chunk_content(file: IO[bytes], place: ChunkPlace) -> bytes:
    """Reads a chunk and returns what it holds, unpacked and checked.

    Raises:
        ResourceExhaustedError: it holds more than a limit of this file.
        DAMAGE: one of these errors, if its bytes are not those that were written.
    """
    if place.size > MAX_CHUNK_BYTES:
        raise ResourceExhaustedError(f"{file.name}: a chunk has {place.size} bytes, the limit is {MAX_CHUNK_BYTES}")
    file.seek(place.at)
    chunk = Chunk.read(ReadDataStream(io.BytesIO(file.read(place.size))))
    holds = chunk.uncompressed_size
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"a chunk is packed by {chunk.compression[:20]!r}, not by zstd")
    # The head of the packed data decides how much is allocated, whatever the chunk says.
    says = zstandard.frame_content_size(chunk.data) if chunk.compression else len(chunk.data)
    if says not in (_UNKNOWN, holds):
        raise ValueError(f"a chunk holds {says} bytes, not {holds}")
    most = min(MAX_CHUNK_BYTES, max(MAX_SMALL_BYTES, MAX_RATIO * place.size))
    if holds > most:
        raise ResourceExhaustedError(f"{file.name}: a chunk of {place.size} bytes holds {holds}, the limit is {most}")
    content = chunk.data
    if chunk.compression:
        content = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=holds)
    if len(content) != holds or chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise ValueError("a chunk holds other bytes than were written")
    return content


def whole_bytes(path: Path) -> tuple[int, bool]:
    """Returns how many bytes whole records take, and whether the file was cut off.

    Raises NotFoundError without a file, and InvalidArgumentError for one of another kind.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise InvalidArgumentError(f"{path}: is not an MCAP file")
            if size >= 2 * len(MAGIC):
                file.seek(size - len(MAGIC))
                if file.read() == MAGIC:
                    return size, False
            at = len(MAGIC)
            while at + RECORD.size <= size:
                file.seek(at)
                _, length = RECORD.unpack(file.read(RECORD.size))
                if at + RECORD.size + length > size:
                    break
                at += RECORD.size + length
            return at, True
    except FileNotFoundError as error:
        raise NotFoundError(f"{path}: {error.strerror}") from error
