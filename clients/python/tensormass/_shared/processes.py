"""Child processes that end with their parent, however the parent ends."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from tensormass._shared.errors import InternalError, NotFoundError, UnavailableError

# Programs and viewer inside a wheel of `make wheel`. A checkout has no such folder.
BUNDLE = Path(__file__).resolve().parents[1] / "_bundle"
# In a checkout: clients/python/tensormass/_src/processes.py -> build/bin.
BUILD_BIN = Path(__file__).resolve().parents[4] / "build" / "bin"
# Reads until the parent's end of the pipe is closed, then ends the child and wakes it if it was suspended. The kernel
# closes that end however the parent ends. PR_SET_PDEATHSIG would also fire when only the thread that started the child
# ends.
_WATCHDOG = 'read -r _; kill -TERM "$0" 2>/dev/null; kill -CONT "$0" 2>/dev/null'
# Time between a broken connection and the visible end of its process [s].
_END_S = 0.5


def find_program(name: str, variable: str) -> Path:
    """Finds a program in $`variable`, the installed wheel, the checkout's build/bin, or PATH, in this order.

    Raises:
        NotFoundError: the message names the searched places.
    """
    named = os.environ.get(variable)
    if named:
        if not os.access(named, os.X_OK):
            raise NotFoundError(f"${variable} names {named}, which is not an executable file")
        return Path(named)
    for folder in (BUNDLE, BUILD_BIN):
        if os.access(folder / name, os.X_OK):
            return folder / name
    found = shutil.which(name)
    if found is None:
        searched = f"not in {BUILD_BIN} nor on PATH, and the installed package holds no programs"
        raise NotFoundError(
            f"{name} is not built: {searched}; run `make build`, install a wheel of `make wheel` or set ${variable}"
        )
    return Path(found)


class ChildProcess:
    """A process that is stopped when its parent is gone. It has its own session, so Ctrl-C reaches only the parent."""

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
        """Sends SIGTERM, after `timeout_s` SIGKILL, and returns the exit status."""
        # Ends the watchdog first, because the child's id may be reused once it is reaped.
        self._watchdog.kill()
        self._watchdog.wait()
        assert self._watchdog.stdin is not None
        self._watchdog.stdin.close()
        if self.running:
            self.process.send_signal(signal.SIGTERM)
            # A suspended process (SIGSTOP) handles SIGTERM only after it continues.
            self.process.send_signal(signal.SIGCONT)
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


def log_tail(file: Path) -> str:
    """Returns the last lines of a log; empty without a log."""
    with contextlib.suppress(OSError):
        return "\n".join(file.read_text(errors="replace").splitlines()[-15:])
    return ""


@contextlib.contextmanager
def end_explained(daemon: ChildProcess | None, log_file: Path | None) -> Iterator[None]:
    """Adds to a failure in the body how the command's own daemon ended, with the end of its log.

    The failed call itself knows only that its connection broke. `daemon` must be None if somebody else started it.
    """
    try:
        yield
    except (UnavailableError, InternalError) as error:
        if daemon is None:
            raise
        try:
            status = daemon.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            raise error from None
        how = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        log = log_tail(log_file) if log_file is not None else ""
        raise UnavailableError(f"the daemon ended, {how}; its log ends:\n{log}") from error
