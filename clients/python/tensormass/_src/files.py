"""Files that are replaced when all of the new one is there: a full disk leaves what was there before."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

# What is there is open elsewhere, as standard output is.
_SYSTEM_FOLDERS = ("dev", "proc")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write what is to be found at `path`: a file of the same name in a folder beside it, as writers take the
    format from a name and may make a second file of it. In the end it takes its place; if something is raised, what
    was there stays.

    A link goes on naming the same file. What is no plain file, such as a pipe, is written to directly; so is what
    cannot be replaced, whose writer then says why.
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
        for file in sorted(Path(folder).iterdir(), key=lambda file: file == aside):  # what names the others last
            os.replace(file, target if file == aside else path.with_name(file.name))


def _is_replaceable(path: Path, target: Path) -> bool:
    """Whether a file can take the place of what is there, if anything is."""
    if path.absolute().parts[1:2] in [(folder,) for folder in _SYSTEM_FOLDERS]:
        return False
    if target.exists() and not (target.is_file() and os.access(target, os.W_OK)):
        return False
    return os.access(target.parent, os.W_OK | os.X_OK)
