"""Recordings in MCAP files: writing them so that a crash loses little, and reading what a crash left.

    magic, header | chunk | chunk | ...   | summary, footer, magic
                    schemas, channels,      only if the recording was ended properly
                    messages, compressed

A chunk is handed to the operating system in one go, at least once a second, so that a killed process loses that second.
A file that was cut off has no summary; its whole chunks are read from the front. recording.proto lists the channels.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from tensormass import InvalidArgumentError, ResourceExhaustedError
from tensormass.v1 import recording_pb2, scene_pb2
from tensormass_tools.recording.chunks import CHANNELS, DAMAGE, Channels, chunk_content, chunk_places, whole_bytes

#: A chunk ends at this size or age, whichever comes first.
CHUNK_BYTES = 256 << 10
CHUNK_S = 1.0


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
        self.close()

    @property
    def size(self) -> int:
        """Bytes that are in the file."""
        return self._file.tell()

    def close(self) -> None:
        """Ends the file, properly unless writing failed."""
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
        self.whole_bytes, self.cut_off = whole_bytes(path)
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
        """Yields the messages in the order of the file. Ends at the first damaged chunk.

        Raises ResourceExhaustedError if a chunk exceeds a limit of chunks.py.
        """
        channels = Channels()
        try:
            with self.path.open("rb") as file:
                for place in chunk_places(self.path, self.whole_bytes, cut_off=self.cut_off):
                    for found in channels.messages(chunk_content(file, place)):
                        yield Entry(found.channel, CHANNELS[found.channel].FromString(found.data))
        except DAMAGE:
            self.damaged = True
