"""Reads a mesh file or a label map in a child process with limits of time and memory: files come from strangers."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._src.label_formats import content
from tensormass._src.mesh_formats import finish, limits, reading
from tensormass._src.mesh_formats.raw import FormatError

# Longest first line of a child [bytes]: names of sets and notes.
_MAX_HEAD = 1 << 24
_TYPES = ("<f8", "<u4", "<f4", "<u2")
# Imports the readers without the rest of the SDK, which would take longer than reading.
_BOOT = """
import sys, types
package = types.ModuleType("tensormass")
package.__path__ = [sys.argv[1]]
sys.modules["tensormass"] = package
from tensormass._src.mesh_formats import child
child.main(*sys.argv[2:])
"""
_PACKAGE = Path(__file__).resolve().parents[1]


def volume(path: Path, *, trusted: bool = False) -> finish.Volume:
    """Reads a volume.

    Args:
        trusted: reads it in this process, because this package has written the file.

    Raises:
        InvalidArgumentError: not readable; the message names file, line and remedy.
    """
    if trusted:
        return _here(reading.read_volume, path)
    head, arrays = _read("volume", path)
    out = finish.Volume(np.empty((0, 3)), [], {}, {}, head["notes"])
    for name, array in arrays:
        if name[0] == "points":
            out.points = array
        elif name[0] == "block":
            out.blocks.append((name[1], array))
        elif name[0] == "set":
            out.sets[name[1]] = array
        else:
            out.fields[name[1]] = array
    return out


def surface(path: Path, *, trusted: bool = False) -> finish.Surface:
    """Reads a surface like `volume`."""
    if trusted:
        return _here(reading.read_surface, path)
    head, arrays = _read("surface", path)
    found = {name[0]: array for name, array in arrays}
    return finish.Surface(found["points"], found["triangles"], found.get("texture"), head["notes"])


def labels(path: Path) -> content.Labels:
    """Reads a label map like `volume`."""
    head, arrays = _read("labels", path, 2 * content.MAX_VOXELS + _MAX_HEAD)
    found = {name[0]: array for name, array in arrays}
    segments = [
        content.Segment(**{**of, "color": None if of["color"] is None else tuple(of["color"])})
        for of in head["segments"]
    ]
    return content.Labels(found["voxels"], found["affine"], segments, head["notes"], head["unit_m"])


def _here(read: Any, path: Path) -> Any:  # noqa: ANN401
    try:
        return read(path)
    except FormatError as error:
        raise InvalidArgumentError(str(error)) from error
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be read: {error.strerror}") from error


def _read(
    kind: str, path: Path, most: int | None = None
) -> tuple[dict[str, Any], list[tuple[list[str], npt.NDArray[Any]]]]:
    """Returns the first line of a child, and its arrays by name. `most` bytes of them are taken; None: by the size of
    the file."""
    size = path.stat().st_size
    limit_s = limits.time_limit_s(size)
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _BOOT, str(_PACKAGE), kind, str(path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # Reading solves no linear system, so threads of a linear algebra library would only take memory.
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
        start_new_session=True,
    )
    late = threading.Event()

    def end() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(limit_s, end)
    timer.daemon = True
    timer.start()
    try:
        assert process.stdout is not None
        line = process.stdout.readline(_MAX_HEAD)
        head = json.loads(line) if line.endswith(b"\n") else None
        if head is None:
            raise InvalidArgumentError(f"{path}: {_why_ended(process, late.is_set(), limit_s)}")
        if "error" in head:
            raise InvalidArgumentError(str(head["error"]))
        if most is None:
            most = max(limits.MEMORY_FLOOR, limits.MAX_EXPANSION * size)
        return head, list(_arrays(process.stdout, head["arrays"], most, path))
    finally:
        timer.cancel()
        process.kill()
        process.wait()
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()


def _why_ended(process: subprocess.Popen[bytes], late: bool, limit_s: float) -> str:
    assert process.stderr is not None
    words = process.stderr.read(1 << 16).decode(errors="replace").strip()
    status = process.wait()
    if late or -status in (9, 24):  # SIGKILL, SIGXCPU
        return f"was not read within {limit_s:.0f} s, the limit for its size; it is damaged, or save it as binary .vtu"
    return f"its reader ended with status {status}: {words.splitlines()[-1] if words else 'nothing was said'}"


def _arrays(
    pipe: IO[bytes], listed: list[dict[str, Any]], most: int, path: Path
) -> Iterator[tuple[list[str], npt.NDArray[Any]]]:
    total = 0
    for entry in listed:
        if entry["dtype"] not in _TYPES:
            raise InvalidArgumentError(f"{path}: its reader answered with numbers of type {entry['dtype']}")
        shape = tuple(int(length) for length in entry["shape"])
        dtype = np.dtype(entry["dtype"])
        total += int(np.prod(shape, dtype=object)) * dtype.itemsize
        if total > most:
            raise InvalidArgumentError(f"{path}: has more than {most >> 20} MiB of numbers, the limit for its size")
        array = np.empty(shape, dtype)
        view = array.reshape(-1).view(np.uint8).data
        done = 0
        while done < len(view):
            count = pipe.readinto(view[done:])  # type: ignore[attr-defined]
            if not count:
                raise InvalidArgumentError(f"{path}: its reader ended before all numbers were there")
            done += count
        yield entry["name"], array
