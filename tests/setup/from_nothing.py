"""Measures what a newcomer waits for: a clone in a bare Debian 12, from `make run` to the page's first frame, and more.

    cd tests && python -m setup.from_nothing [--cuda ON] [--seconds T] [--out FILE] [MEASUREMENT ...]

    run      make run, up to the first frame that the page draws (first_frame.py); nothing is cached
    again    the same once more: nothing is missing now
    test     make test after it
    cpp      one changed .cpp of server/world, up to the result of its tests
    cu       one changed .cu other than elements.cu, compiled (with --cuda ON)
    law      one law of elements.cu, compiled (with --cuda ON)

They run in this order. Each gives a JSON line: seconds, commit, machine, and how far a run got that the limit ended.
Root and mmdebstrap are needed. The bare root (bare_root.sh) has git and make, as README says, and shares the network of
this machine.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MEASUREMENTS = ("run", "again", "test", "cpp", "cu", "law")
_CUDA_ONLY = ("cu", "law")
_CHECKOUT = "/tensormass"
_PYTHON = f"{_CHECKOUT}/.venv/bin/python"
_BARE_ROOT = ROOT / "tests" / "setup" / "bare_root.sh"


class Bare:
    """A bare Debian with a clone of this repository, and a limit for all that runs in it."""

    def __init__(self, root: Path, cuda: str, deadline: float) -> None:
        self._root = root
        self._deadline = deadline
        self._settings = f"export CUDA={cuda}; " if cuda else ""

    def prepare(self) -> None:
        subprocess.run([_BARE_ROOT, "make", self._root, "bookworm", "git,make"], check=True)
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(self._root) + _CHECKOUT], check=True)

    def command(self, script: str) -> list[str]:
        return [str(_BARE_ROOT), "run", str(self._root), "root", "sh", "-c", self._settings + script]

    @contextlib.contextmanager
    def start(self, script: str) -> Iterator[subprocess.Popen[str]]:
        """Runs a shell script in the root. It is ended with the block, or when the limit is over."""
        process = subprocess.Popen(
            self.command(f"cd {_CHECKOUT} && {script}"),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        timer = threading.Timer(max(0.0, self._deadline - time.monotonic()), _end, [process])
        timer.start()
        try:
            yield process
        finally:
            timer.cancel()
            if process.poll() is None:
                _end(process)
            process.wait()

    def lines(self, process: subprocess.Popen[str], log: Path) -> Iterator[str]:
        """The lines that the process prints; each is also written to the log."""
        assert process.stdout is not None
        with log.open("a") as file:
            for line in process.stdout:
                file.write(line)
                file.flush()
                yield line.rstrip("\n")

    def change(self, name: str) -> None:
        """Changes a file of the clone as an edit would: its text differs, and so does its time."""
        path = Path(str(self._root) + _CHECKOUT) / name
        path.write_text(path.read_text() + f"// {time.time_ns()}\n")


def _end(process: subprocess.Popen[str]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def to_the_first_frame(bare: Bare, log: Path) -> dict[str, object]:
    """Runs `make run` up to the first frame. Returns seconds in all and at the end of set-up and build."""
    row: dict[str, object] = {}
    started = time.monotonic()
    with bare.start("make run RUN_ARGS=--json") as process:
        for line in bare.lines(process, log):
            since = round(time.monotonic() - started, 1)
            if line.startswith("set-up: everything is in place"):
                row["set_up_s"] = since
            elif line.startswith("build: ") and "is complete" in line:
                row["build_s"] = since
                row["last_line"] = line
            elif line.startswith("{") and "viewer" in (where := json.loads(line)):
                ran = subprocess.run(
                    bare.command(f"{_PYTHON} {_CHECKOUT}/tests/setup/first_frame.py '{where['viewer']}'"),
                    capture_output=True,
                    text=True,
                )
                if ran.returncode != 0:
                    return {**row, "unfinished": ran.stderr[-500:]}
                return {"seconds": round(time.monotonic() - started, 1), **row}
            elif not line.startswith("{"):
                row["last_line"] = line
    return {**row, "unfinished": row.get("last_line", "printed nothing")}


def to_the_end(bare: Bare, log: Path, script: str) -> dict[str, object]:
    """Runs a script to its end. Returns seconds, or how far it got."""
    last = "printed nothing"
    started = time.monotonic()
    with bare.start(script) as process:
        for line in bare.lines(process, log):
            last = line or last
    seconds = round(time.monotonic() - started, 1)
    return {"seconds": seconds} if process.returncode == 0 else {"after_s": seconds, "unfinished": last}


def measure(bare: Bare, what: str, log: Path) -> dict[str, object]:
    match what:
        case "run" | "again":
            return to_the_first_frame(bare, log)
        case "test":
            return to_the_end(bare, log, "make test")
        case "cpp":
            compiled = to_the_end(bare, log, "make tests")  # only what is missing: the change alone is measured
            if "unfinished" in compiled:
                return compiled
            bare.change("server/world/guard.cpp")
            return to_the_end(bare, log, "make test-folder FOLDER=world TESTS=Guard")
        case "cu":
            bare.change("server/backend/cuda/stage_kernels.cu")
            return to_the_end(bare, log, "make build")
        case "law":
            objects = "server/backend/CMakeFiles/tensormass_elements_4.dir/cuda/elements.cu.o"
            return to_the_end(bare, log, f"rm build/{objects} && make build")
    raise AssertionError(what)


def machine() -> str:
    names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return f"{os.cpu_count()} x {names[0] if names else platform.machine()}"


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("measurements", nargs="*", metavar="MEASUREMENT", help=f"default: {' '.join(MEASUREMENTS)}")
    parser.add_argument("--cuda", default="", choices=("", "AUTO", "ON", "OFF"), help="default: the Makefile's")
    parser.add_argument("--seconds", type=float, default=5400.0, metavar="T", help="limit of all; default: %(default)g")
    parser.add_argument("--out", type=Path, help="append the lines to a file, too")
    parser.add_argument("--log", type=Path, default=Path("from-nothing.log"), help="default: %(default)s")
    args = parser.parse_args()
    chosen = args.measurements or [name for name in MEASUREMENTS if args.cuda == "ON" or name not in _CUDA_ONLY]
    if unknown := sorted(set(chosen) - set(MEASUREMENTS)):
        parser.error(f"{unknown[0]}: not a measurement; there are {', '.join(MEASUREMENTS)}")
    if os.geteuid() != 0:
        parser.error("root is needed to make a bare Debian")
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()
    if commit.endswith("-dirty"):
        print("from nothing: what is not committed is not measured", file=sys.stderr)
    failed = False
    with tempfile.TemporaryDirectory(prefix="tensormass-bare-") as folder:
        root = Path(folder) / "root"
        bare = Bare(root, args.cuda, time.monotonic() + args.seconds)
        bare.prepare()
        for what in sorted(chosen, key=MEASUREMENTS.index):
            row = {
                "measurement": what,
                "cuda": args.cuda or "AUTO",
                **measure(bare, what, args.log),
                "commit": commit,
                "machine": machine(),
                "date": datetime.date.today().isoformat(),
                "command": f"python -m setup.from_nothing{f' --cuda {args.cuda}' if args.cuda else ''} {what}",
            }
            line = json.dumps(row)
            print(line, flush=True)
            if args.out is not None:
                with args.out.open("a") as file:
                    file.write(line + "\n")
            if "unfinished" in row:
                failed = True
                break
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
