"""A headless Chromium without a driver, for benches."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
#: Draws in software.
SOFTWARE_FLAGS = "--use-angle=swiftshader --enable-unsafe-swiftshader"


@contextlib.contextmanager
def chromium(url: str, flags: str, program: str = CHROMIUM) -> Iterator[Path]:
    """Shows a page. Yields the profile's folder, where `DevToolsActivePort` names the debugging port."""
    fixed = ["--headless", "--no-sandbox", "--disable-background-networking", "--no-first-run"]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        own = ["--remote-debugging-port=0", f"--user-data-dir={profile}", "--window-size=1280,800"]
        command = [program, *fixed, *own, *flags.split(), url]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            yield Path(profile)
            if process.poll() is not None:
                sys.exit(f"{program} ended by itself with status {process.returncode}")
        finally:
            process.terminate()
            process.wait()
