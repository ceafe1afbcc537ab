"""The daemon's wall clock is set back: arrivals and counts decide, not times of day."""

from __future__ import annotations

import shutil
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from attack_parts import attacked, block

import tensormass as tm

# A wall clock of its own for one process: the machine's, moved by the seconds in a file.
SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

int clock_gettime(clockid_t id, struct timespec* time) {
  static int (*real)(clockid_t, struct timespec*);
  static volatile long long* moved_s;
  if (!real) {
    moved_s = mmap(0, 8, PROT_READ, MAP_SHARED, open(getenv("MOVED_CLOCK"), O_RDONLY), 0);
    real = dlsym(RTLD_NEXT, "clock_gettime");
  }
  int result = real(id, time);
  if (id == CLOCK_REALTIME) time->tv_sec += *moved_s;
  return result;
}
"""


@pytest.fixture
def move_clock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Daemons that are started get a wall clock that the test moves [s]."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no cc to compile a clock for the daemon")
    source, library, moved = tmp_path / "clock.c", tmp_path / "clock.so", tmp_path / "moved"
    source.write_text(SHIM)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)

    def move(seconds: int) -> None:
        # In place: the daemon has mapped the file.
        with moved.open("r+b" if moved.exists() else "wb") as file:
            file.write(struct.pack("<q", seconds))

    move(0)
    monkeypatch.setenv("MOVED_CLOCK", str(moved))
    monkeypatch.setenv("LD_PRELOAD", str(library))
    return move


@pytest.mark.attack("the daemon's wall clock is set back 25 s", "next(frames) hung for 23.6 s; topology version fell")
def test_a_clock_that_is_set_back_stops_no_reader(move_clock: Callable[[int], None]) -> None:
    with attacked() as server:
        scene: tm.SceneHandle = server.load(block())
        with scene.frames() as frames:
            first = next(frames)
            move_clock(-25)
            # Not the frames that were under way.
            while (frame := next(frames)).server_time_ns >= first.server_time_ns:
                assert frame.server_time_ns - first.server_time_ns < 20e9, "the clock has caught up"
            assert frame.sequence > first.sequence
            assert next(frames).sequence > frame.sequence
        assert server.load(block("other")).topology().version > scene.topology().version


@pytest.mark.attack("the daemon's wall clock is set back between load and reload", "an older topology version")
def test_a_scene_that_is_loaded_again_has_a_newer_topology(move_clock: Callable[[int], None]) -> None:
    with attacked() as server:
        versions = []
        for seconds in (0, -25, -3600):
            move_clock(seconds)
            scene = server.load(block())
            versions.append(scene.topology().version)
            next(scene.frames())
            scene.unload()
        assert versions == sorted(set(versions))
