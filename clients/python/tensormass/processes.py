"""Child processes that end when their parent does, however the parent ends."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from tensormass.errors import NotFoundError

# In a checkout: clients/python/tensormass/processes.py -> build/bin.
BUILD_BIN = Path(__file__).resolve().parents[3] / "build" / "bin"

# Reads until the parent's end of the pipe is gone, then ends the child, woken if it was stopped. The kernel closes that
# end whatever happens to the parent; PR_SET_PDEATHSIG would also fire when only the thread ends that started the child.
_WATCHDOG = 'read -r _; kill -TERM "$0" 2>/dev/null; kill -CONT "$0" 2>/dev/null'


def find_program(name: str, variable: str) -> Path:
    """Finds a built program: $`variable`, then the checkout's build/bin, then PATH.

    Raises:
        NotFoundError: saying where it was looked for.
    """
    named = os.environ.get(variable)
    if named:
        if not os.access(named, os.X_OK):
            raise NotFoundError(f"${variable} names {named}, which is not an executable file")
        return Path(named)
    if os.access(BUILD_BIN / name, os.X_OK):
        return BUILD_BIN / name
    found = shutil.which(name)
    if found is None:
        raise NotFoundError(f"{name} is not built: not in {BUILD_BIN} nor on PATH; run `make build` or set ${variable}")
    return Path(found)


class ChildProcess:
    """A process in a session of its own (Ctrl-C reaches the parent only) that is stopped when the parent is gone."""

    def __init__(
        self,
        args: Sequence[str | Path],
        *,
        output: IO[bytes] | int,
        environment: Mapping[str, str] | None = None,
        folder: str | Path | None = None,
    ) -> None:
        self.process = subprocess.Popen(
            [str(arg) for arg in args],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={**os.environ, **(environment or {})},
            cwd=folder,
            start_new_session=True,
        )
        try:
            self._watchdog = subprocess.Popen(
                ["/bin/sh", "-c", _WATCHDOG, str(self.process.pid)], stdin=subprocess.PIPE, start_new_session=True
            )
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, timeout_s: float = 5.0) -> int:
        """Asks it to end (SIGTERM), insists after `timeout_s` (SIGKILL), and returns its exit status."""
        # The watchdog goes first: the child's id is its own only until it is reaped.
        self._watchdog.kill()
        self._watchdog.wait()
        assert self._watchdog.stdin is not None
        self._watchdog.stdin.close()
        if self.running:
            self.process.send_signal(signal.SIGTERM)
            # A stopped process (SIGSTOP) does not see SIGTERM until it goes on.
            self.process.send_signal(signal.SIGCONT)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()
