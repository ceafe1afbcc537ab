"""Recordings in MCAP files: writing them so that a crash loses little, and reading what a crash left.

    magic, header | chunk | chunk | ...   | summary, footer, magic
                    schemas, channels,      only if the recording was ended properly
                    messages, compressed

A chunk is handed to the operating system in one go, at least once a second, so that a killed process loses that second.
A file that was cut off has no summary; its whole chunks are read from the front. recording.proto lists the channels.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any, NamedTuple, Self

import zstandard
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from tensormass._src.errors import InvalidArgumentError, NotFoundError, ResourceExhaustedError
from tensormass.v1 import recording_pb2, scene_pb2, stream_pb2

#: Message of each channel.
CHANNELS: dict[str, type[Message]] = {
    "/scene": scene_pb2.Scene,
    "/start": recording_pb2.RecordingStart,
    "/inputs": recording_pb2.RecordedStep,
    "/checks": recording_pb2.StateCheck,
    "/lost": recording_pb2.LostSteps,
    "/status": stream_pb2.SceneStatus,
    "/topology": stream_pb2.Topology,
    "/frames": stream_pb2.Frame,
}
#: A chunk ends at this size or age, whichever comes first.
CHUNK_BYTES = 256 << 10
CHUNK_S = 1.0

_MAGIC = b"\x89MCAP0\r\n"
#: The first record follows.
MAGIC_BYTES = len(_MAGIC)
#: In front of each record: an opcode and a length.
RECORD = struct.Struct("<BQ")


class _Unbuffered:
    """A file without a buffer of this process: what was written survives its end."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._size = 0

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            written = os.write(self._file, left)
            self._size += written
            left = left[written:]
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        pass

    def close(self) -> None:
        os.close(self._file)


class RecordingWriter:
    """Writes a recording. As a context manager, it ends the file properly unless writing failed.

    Raises ResourceExhaustedError if the disk takes no more. The file then opens up to its last whole chunk.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = _Unbuffered(path)
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._channels: dict[str, int] = {}
        self._sequence = dict.fromkeys(CHANNELS, 0)
        self._last_flush_s = time.monotonic()
        self._last_time_ns = 0
        self._failed = False
        self._attempt(self._start)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if not self._failed:
                self._attempt(self._writer.finish)
        finally:
            self._file.close()

    def add(self, channel: str, message: Message, time_ns: int = 0) -> None:
        """Adds a message. time_ns: on the server's clock; 0 takes the time of the message before."""
        self._last_time_ns = max(time_ns, self._last_time_ns)
        self._sequence[channel] += 1

        def write() -> None:
            self._writer.add_message(
                self._channels[channel],
                self._last_time_ns,
                message.SerializeToString(),
                self._last_time_ns,
                self._sequence[channel],
            )

        self._attempt(write)

    def flush_if_due(self) -> None:
        """Ends the chunk if it is older than CHUNK_S. Call it often."""
        if time.monotonic() - self._last_flush_s > CHUNK_S:
            self.flush()

    def flush(self) -> None:
        """Ends the chunk."""
        self._attempt(self._writer.flush)
        self._last_flush_s = time.monotonic()

    def _start(self) -> None:
        self._writer.start(profile="", library="tensormass")
        for channel, kind in CHANNELS.items():
            schema = register_schema(self._writer, kind)
            self._channels[channel] = self._writer.register_channel(channel, "protobuf", schema)

    def _attempt(self, write: Any) -> None:  # noqa: ANN401
        try:
            write()
        except OSError as error:
            self._failed = True
            raise ResourceExhaustedError(
                f"{self._path}: {error.strerror}; the recording ends here, and opens up to its last whole chunk"
            ) from error


class Entry(NamedTuple):
    """A message of a recording."""

    channel: str
    message: Any


class RecordingReader:
    """Reads a recording, also one that was cut off.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: the file is not a recording.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        #: Bytes up to the end of the last whole record; what follows is not read.
        self.whole_bytes, self.cut_off = _whole_bytes(path)
        #: A damaged chunk ended the reading.
        self.damaged = False
        self.scene = scene_pb2.Scene()
        self.start = recording_pb2.RecordingStart()
        seen = set()
        for entry in self.entries():
            if entry.channel in ("/scene", "/start"):
                (self.scene if entry.channel == "/scene" else self.start).CopyFrom(entry.message)
                seen.add(entry.channel)
            if len(seen) == 2:
                return
        raise InvalidArgumentError(
            f"{path}: has no scene; it is not a recording, or was cut off before its first chunk"
        )

    def entries(self) -> Iterator[Entry]:
        """Yields the messages in the order of the file. Ends at the first damaged chunk."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self.path.open("rb") as file:
            reader = StreamReader(_Limited(file, self.whole_bytes), validate_crcs=True)  # type: ignore[arg-type]
            records = reader.records
            while True:
                try:
                    record = next(records, None)
                    if record is None:
                        return
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, McapMessage):
                        entry = _entry(record, channels, schemas)
                        if entry is not None:
                            yield entry
                except (McapError, CRCValidationError, zstandard.ZstdError, DecodeError, struct.error, ValueError):
                    # EndOfFile is one of them: a file without a footer ends so.
                    self.damaged = self.damaged or file.tell() < self.whole_bytes
                    return


class _Limited:
    """A file that ends after so many bytes."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file = file
        self._left = size

    def read(self, count: int) -> bytes:
        data = self._file.read(min(count, self._left))
        self._left -= len(data)
        return data


def _entry(record: McapMessage, channels: dict[int, Channel], schemas: dict[int, Schema]) -> Entry | None:
    """Returns None for a channel of others."""
    channel = channels.get(record.channel_id)
    kind = CHANNELS.get(channel.topic) if channel is not None else None
    schema = schemas.get(channel.schema_id) if channel is not None else None
    if channel is None or kind is None or schema is None or schema.name != kind.DESCRIPTOR.full_name:
        return None
    return Entry(channel.topic, kind.FromString(record.data))


def _whole_bytes(path: Path) -> tuple[int, bool]:
    """Returns how many bytes whole records take, and whether the file was cut off."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC:
                raise InvalidArgumentError(f"{path}: is not an MCAP file")
            if size >= 2 * len(_MAGIC):
                file.seek(size - len(_MAGIC))
                if file.read() == _MAGIC:
                    return size, False
            at = len(_MAGIC)
            while at + RECORD.size <= size:
                file.seek(at)
                _, length = RECORD.unpack(file.read(RECORD.size))
                if at + RECORD.size + length > size:
                    break
                at += RECORD.size + length
            return at, True
    except FileNotFoundError as error:
        raise NotFoundError(f"{path}: {error.strerror}") from error
