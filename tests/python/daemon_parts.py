"""What fixtures of several folders share: a daemon that is skipped without a build, and a folder like the viewer's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes


@contextlib.contextmanager
def small_daemon(*, zenoh: bool = False) -> Iterator[tm.Server]:
    """A daemon on one thread. Tests that need it are skipped without a build."""
    try:
        processes.find_program("tensormassd", "TENSORMASSD")
    except tm.NotFoundError as not_built:
        pytest.skip(str(not_built))
    with tm.launch(backend="cpu", cpu_threads=1, zenoh=zenoh) as server:
        yield server


def make_viewer(folder: Path) -> Path:
    """Makes a folder like that of the built viewer."""
    (folder / "assets").mkdir(parents=True)
    (folder / "index.html").write_text("<title>viewer</title>")
    (folder / "assets" / "main.js").write_text("1;")
    return folder
