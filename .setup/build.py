#!/usr/bin/env python3
"""Runs Ninja and says how far it is: one line at least every ten seconds, and what compilers print.

    .setup/build.py FOLDER [-j JOBS] [TARGET ...]

Ninja alone prints a line for each step, and none while a long step runs. cargo compiles zenoh's crates in one step, so
they are counted from the log that server/bus/CMakeLists.txt lets it write.
"""

from __future__ import annotations

import argparse
import os
import queue
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

PERIOD_S = 8.0
_STATUS = re.compile(r"\[(\d+)/(\d+)\] ")
_CRATE = re.compile(r"^ *Compiling ", re.MULTILINE)


class Progress:
    """How much of a build is done, from the lines that Ninja prints and the log that cargo writes."""

    def __init__(self, folder: Path) -> None:
        self._cargo = folder / "server" / "bus" / "zenoh"
        self._logged_before = self._log_time()
        self.done = self.total = 0

    def take(self, line: str) -> bool:
        """Returns whether the line only says how far Ninja is."""
        found = _STATUS.match(line)
        if found is None:
            return False
        self.done, self.total = int(found[1]), int(found[2])
        return True

    def text(self) -> str:
        return f"{self.done} of {self.total or '?'} steps{self._crates()}"

    def _log_time(self) -> float:
        try:
            return (self._cargo / "cargo.log").stat().st_mtime
        except OSError:
            return 0.0

    def _crates(self) -> str:
        """Returns how many of zenoh's crates are compiled; empty unless cargo runs in this build."""
        if self._log_time() <= self._logged_before:
            return ""
        try:
            started = len(_CRATE.findall((self._cargo / "cargo.log").read_text(errors="replace")))
            total = int((self._cargo / "crates.txt").read_text())
        except (OSError, ValueError):
            return ""
        return f", {min(started, total)} of {total} crates of zenoh" if started else ""


def run(
    command: list[str],
    progress: Progress,
    say: Callable[[str], None],
    *,
    period_s: float = PERIOD_S,
) -> int:
    """Runs a command and returns its exit status.

    say(line): is called with each line that the command prints besides its status lines, and with the progress: after
    each period, and at the end if there was anything to do.
    """
    lines: queue.Queue[str | None] = queue.Queue()

    def read(output: IO[str]) -> None:
        for line in output:
            lines.put(line.rstrip("\n"))
        lines.put(None)

    environment = {**os.environ, "NINJA_STATUS": "[%f/%t] "}
    start = time.monotonic()
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env=environment,
    ) as process:
        assert process.stdout is not None
        reader = threading.Thread(target=read, args=(process.stdout,), daemon=True)
        reader.start()
        due = start + period_s
        while True:
            try:
                line = lines.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                say(f"build: {progress.text()}, {time.monotonic() - start:.0f} s")
                due += period_s
                continue
            if line is None:
                break
            if not progress.take(line) and not line.startswith(("ninja: Entering directory", "ninja: no work to do")):
                say(line)
        status = process.wait()
    if progress.total > 0:
        say(f"build: {progress.text()}, {time.monotonic() - start:.0f} s" + ("" if status == 0 else ": FAILED"))
    return status


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="a folder that CMake has configured")
    parser.add_argument(
        "-j",
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="default: %(default)s",
    )
    parser.add_argument("targets", nargs="*", help="default: all")
    args = parser.parse_intermixed_args()
    command = ["ninja", "-C", str(args.folder), "-j", str(args.jobs), *args.targets]
    try:
        return run(command, Progress(args.folder), lambda line: print(line, flush=True))
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
