"""Reads files with the SDK's errors, and replaces them in one step: if the disk is full, the old file stays."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tensormass._shared.errors import InvalidArgumentError, NotFoundError

# Folders whose files are streams, such as standard output.
_SYSTEM_FOLDERS = ("dev", "proc")


def read_bytes(path: Path, count: int = -1) -> bytes:
    """Reads the first bytes of a file; all of them by default.

    Raises:
        NotFoundError: no such file.
        InvalidArgumentError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(count)
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such file") from None
    except OSError as error:
        raise InvalidArgumentError(f"{path}: cannot be read: {error.strerror}") from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields the path to write instead of `path`, and moves the result to `path` at the end.

    It is a file of the same name in a temporary folder, because writers choose the format by the name and may write a
    second file. If the body raises, the old file stays.

    A link keeps naming the same file. A pipe, or a file that cannot be replaced, is written directly; the writer then
    reports the error.
    """
    target = Path(os.path.realpath(path))
    if not _is_replaceable(path, target):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix=".tensormass-", dir=target.parent) as folder:
        aside = Path(folder) / path.name
        yield aside
        if target.exists():
            shutil.copymode(target, aside)
        for file in sorted(
            Path(folder).iterdir(), key=lambda file: file == aside
        ):  # `path` last, because it refers to the others
            os.replace(file, target if file == aside else path.with_name(file.name))


def _is_replaceable(path: Path, target: Path) -> bool:
    """Tells whether a new file can replace `target`, or be created there."""
    if path.absolute().parts[1:2] in [(folder,) for folder in _SYSTEM_FOLDERS]:
        return False
    if target.exists() and not (target.is_file() and os.access(target, os.W_OK)):
        return False
    return os.access(target.parent, os.W_OK | os.X_OK)
