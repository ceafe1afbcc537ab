"""Limits of the process that reads a file."""

from __future__ import annotations

import resource
from pathlib import Path

#: Memory that a reader may use, as a multiple of its files' sizes ...
MEMORY_FACTOR = 4
#: ... and in any case [bytes].
MEMORY_FLOOR = 256 << 20
#: Compressed data count with their full size, up to this multiple of their file's.
MAX_EXPANSION = 16
#: Time that a reader may take in any case [s], and for each byte of the file.
TIME_FLOOR_S = 60.0
TIME_PER_BYTE_S = 2e-6


def time_limit_s(size: int) -> float:
    """Returns the time that a file of this size may take."""
    return TIME_FLOOR_S + size * TIME_PER_BYTE_S


def limit_memory(path: Path) -> None:
    """Limits the memory of this process for reading a file, counted from what it has now."""
    _set(_used() + max(MEMORY_FLOOR, MEMORY_FACTOR * path.stat().st_size))


def allow_file(path: Path) -> None:
    """Allows the memory for a further file that belongs to the first one. Without a limit, nothing changes."""
    allow(MEMORY_FACTOR * path.stat().st_size)


def allow(size: int) -> None:
    """Allows further memory [bytes]. Without a limit, nothing changes."""
    soft, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if soft != resource.RLIM_INFINITY:
        _set(soft + size)


def _set(size: int) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    soft = size if hard == resource.RLIM_INFINITY else min(size, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _used() -> int:
    """Returns the size of this process's own memory [bytes]; 0 where the system does not tell."""
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmData:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return 0
