"""A headless Chromium without a driver, for benches."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
#: Draws in software.
SOFTWARE_FLAGS = "--use-angle=swiftshader --enable-unsafe-swiftshader"
#: Until Chromium has started.
_START_S = 30.0
#: Until a process has ended.
_END_S = 20.0


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
            end(process)


def end(process: subprocess.Popen[Any]) -> None:
    """Ends a process, by force if it does not end by itself."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


async def debugging_address(profile: Path) -> str:
    """Returns the address of a browser's debugging port, once it is there."""
    file = profile / "DevToolsActivePort"  # the port, then a path
    async with asyncio.timeout(_START_S):
        while not file.exists() or len(file.read_text().splitlines()) < 2:
            await asyncio.sleep(0.1)
    return f"http://127.0.0.1:{file.read_text().splitlines()[0]}"


async def ask(page: aiohttp.ClientWebSocketResponse, method: str, **parameters: str | bool | int) -> dict[str, Any]:
    """Sends a command to a page over its debugging port, and returns its result."""
    await page.send_json({"id": 1, "method": method, "params": parameters})
    while True:
        message = await page.receive_json()
        if message.get("id") == 1:
            return dict(message["result"])
