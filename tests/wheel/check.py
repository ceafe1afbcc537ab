"""Tries a wheel: install, `tensormass run`, page, step rate, Ctrl-C. Needs the standard library only.

    python3 check.py WHEEL

`tensormass run` gets no arguments but those that make its output readable, so it chooses the backend itself. The check
fails if the page takes longer than LIMIT_S from the start of the installation, or if a process outlives Ctrl-C.
"""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# From the start of `pip install` to the page.
LIMIT_S = 60.0
_STATUSES = 10
_END_S = 20.0


def main(wheel: Path) -> None:
    found = [name for name in ("gcc", "g++", "cc", "nvcc", "cmake", "cargo", "node") if shutil.which(name)]
    assert not found, f"not a bare machine: {found} are on PATH"
    assert os.environ.get("LD_LIBRARY_PATH") is None
    assert os.geteuid() != 0, "must not run as root"
    with tempfile.TemporaryDirectory(prefix="tensormass-wheel-") as folder:
        environment = Path(folder) / "venv"
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        bin_folder = environment / "bin"
        started = time.monotonic()
        subprocess.run([bin_folder / "pip", "install", "--quiet", "--no-cache-dir", wheel], check=True)
        installed_s = time.monotonic() - started
        check_programs(bin_folder, wheel)
        run_started = time.monotonic()
        page_s, steps_hz, device = check_run(bin_folder / "tensormass")
        total_s = installed_s + page_s
        size = sum(path.stat().st_size for path in environment.rglob("*") if not path.is_symlink() and path.is_file())
        rows = {
            "system": f"{system()}, Python {platform.python_version()}, {os.cpu_count()} CPUs",
            "backend": device,
            "wheel": f"{wheel.stat().st_size / 1e6:.1f} MB",
            "installed, with dependencies": f"{size / 1e6:.0f} MB",
            "pip install": f"{installed_s:.1f} s",
            "tensormass run to the page": f"{page_s:.1f} s",
            "both": f"{total_s:.1f} s",
            "steps a second": f"{steps_hz:.0f}",
            "whole check of the run": f"{time.monotonic() - run_started:.1f} s",
        }
        for name, value in rows.items():
            print(f"wheel: {name:30} {value}")
        assert total_s < LIMIT_S, f"{total_s:.1f} s from installation to page; the limit is {LIMIT_S:g} s"
    print("wheel: works")


def check_programs(bin_folder: Path, wheel: Path) -> None:
    """Checks that the programs are commands, and that daemon and wheel have the same version."""
    version = wheel.name.split("-")[1]
    told = output_of(bin_folder / "tensormassd", "--version")
    assert told.split() == ["tensormassd", version], told
    subprocess.run([bin_folder / "tensormass-haptic", "--help"], check=True, stdout=subprocess.DEVNULL)


def output_of(*command: str | Path) -> str:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout


def check_run(command: Path) -> tuple[float, float, str]:
    """Returns time to the page [s], steps a second, and backend with device. Asserts that all processes end."""
    before = set(processes())
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen([command, "run", "--json"], stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            assert process.stdout is not None
            lines = (json.loads(line) for line in process.stdout)
            where = until(lines, "viewer")
            check_page(where["viewer"])
            page_s = time.monotonic() - started
            steps_hz = step_rate(lines)
            server = json.loads(output_of(command, "status", "--json"))["server"]
            running = set(processes()) - before
            assert {"tensormassd", "tensormass-haptic"} <= {Path(name).name for _, name in running}, running
            process.send_signal(signal.SIGINT)
            status = process.wait(_END_S)
        except BaseException:
            process.terminate()
            process.wait(_END_S)
            errors.seek(0)
            print(errors.read(), file=sys.stderr)
            raise
        assert status == 0, f"tensormass run ended with status {status} after Ctrl-C"
    left = gone(before)
    assert not left, f"processes outlive Ctrl-C: {left}"
    return page_s, steps_hz, f"{server['backend']} ({server['device']})"


def until(lines: Iterator[dict[str, Any]], key: str) -> dict[str, Any]:
    for line in lines:
        if key in line:
            return line
    raise AssertionError(f"tensormass run ended without telling its {key}")


def check_page(url: str) -> None:
    """Fetches the page and everything that it names."""
    page = fetch(url)
    names = re.findall(r'(?:src|href)="([^":]+)"', page)
    assert any(name.endswith(".js") for name in names), page
    for name in names:
        fetch(urllib.parse.urljoin(url, name))


def fetch(url: str) -> str:
    # Without a proxy, which could not reach the loopback of this machine.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=10) as answer:
        assert answer.status == 200
        return str(answer.read().decode(errors="replace"))


def step_rate(lines: Iterator[dict[str, Any]]) -> float:
    """Returns the steps a second over the next _STATUSES statuses. Asserts that the scene is not stopped."""
    first = int(until(lines, "status")["status"]["step"])
    started = time.monotonic()
    for _ in range(_STATUSES):
        status = until(lines, "status")["status"]
    steps = int(status["step"]) - first
    assert steps > 0, status
    assert not status.get("fault"), status
    return steps / (time.monotonic() - started)


def processes() -> Iterator[tuple[int, str]]:
    """Id and program of each process of this user."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.stat().st_uid == os.getuid():
                yield int(folder.name), (folder / "cmdline").read_bytes().split(b"\0")[0].decode()
        except OSError:  # ended meanwhile
            continue


def gone(before: set[tuple[int, str]]) -> set[tuple[int, str]]:
    """Waits until no process but those of `before` is left. Returns those that stay."""
    deadline = time.monotonic() + _END_S
    while (left := set(processes()) - before) and time.monotonic() < deadline:
        time.sleep(0.05)
    return left


def system() -> str:
    about = dict(re.findall(r'^(\w+)="?([^"\n]*)', Path("/etc/os-release").read_text(), re.MULTILINE))
    return f"{about['PRETTY_NAME']}, glibc {platform.libc_ver()[1]}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
