"""Tries a clone as a newcomer would: in a bare Debian, by `make run` alone, until its page comes. Needs root.

    python tests/wheel/clone.py [--suite bookworm] [--seconds 3600]

The bare Debian holds git, make and ca-certificates (tests/setup/bare_root.sh). The clone is of HEAD. `make run` starts
twice: the second time, everything is in place. The check fails if a page or steps do not come within the given time, or
if a process outlives Ctrl-C.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from check import check_page, step_rate, until

REPOSITORY = Path(__file__).resolve().parents[2]
BARE_ROOT = REPOSITORY / "tests" / "setup" / "bare_root.sh"
PACKAGES = "git,make"
CLONE = "tensormass"
_END_S = 60.0
# The shell outlives `make`: the first process of a root takes all others with it. It ends with its standard input.
_RUN = 'trap : INT; make -C "$1" run RUN_ARGS=--json; echo "{\\"ended\\": $?}"; read -r _'


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", default="bookworm", help="Debian release, or the tar file of a root")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time limit of each `make run`")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tensormass-clone-") as folder:
        root = Path(folder) / "root"
        print(f"clone: making a bare {args.suite}", flush=True)
        subprocess.run([BARE_ROOT, "make", root, args.suite, PACKAGES], check=True)
        subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", REPOSITORY, root / CLONE], check=True)
        for name in ("first", "second"):
            page_s, steps_hz = try_run(root, args.seconds)
            print(f"clone: {name} `make run`: page after {page_s:.1f} s, {steps_hz:.0f} steps a second", flush=True)
    print("clone: works")


def try_run(root: Path, limit_s: float) -> tuple[float, float]:
    """Starts `make run` in the clone, and ends it with Ctrl-C. Returns the time to the page [s] and steps a second."""
    command: list[str | Path] = [BARE_ROOT, "run", root, "root", "sh", "-c", _RUN, "sh", f"/{CLONE}"]
    started = time.monotonic()
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    limit = threading.Timer(limit_s, process.kill)  # takes all that it started with it
    limit.start()
    try:
        told = messages(process.stdout)
        check_page(until(told, "viewer")["viewer"])
        page_s = time.monotonic() - started
        steps_hz = step_rate(told)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal's Ctrl-C
        until(told, "ended")
        left = [words for words in processes_in(root) if not words.startswith("sh ")]
        assert not left, f"processes outlive Ctrl-C: {left}"
        process.stdin.close()
        process.wait(_END_S)
    finally:
        limit.cancel()
        process.kill()
        process.wait(_END_S)
    return page_s, steps_hz


def messages(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    """What `tensormass run --json` says; prints the lines of the set-up and the build."""
    for line in lines:
        if line.startswith("{"):
            yield json.loads(line)
        else:
            print(line, end="", flush=True)


def processes_in(root: Path) -> list[str]:
    """Command lines of the processes that run in a root."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if (folder / "root").readlink().is_relative_to(root):
                found.append((folder / "cmdline").read_text().replace("\0", " "))
        except OSError:  # ended meanwhile
            continue
    return found


if __name__ == "__main__":
    main()
