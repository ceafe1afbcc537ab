"""Child processes that end when their parent does, however the parent ends."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

from tensormass._src.errors import InternalError, NotFoundError, UnavailableError

# In a checkout: clients/python/tensormass/_src/processes.py -> build/bin.
BUILD_BIN = Path(__file__).resolve().parents[4] / "build" / "bin"
# Reads until the parent's end of the pipe is gone, then ends the child, woken if it was stopped. The kernel closes that
# end whatever happens to the parent; PR_SET_PDEATHSIG would also fire when only the thread ends that started the child.
_WATCHDOG = 'read -r _; kill -TERM "$0" 2>/dev/null; kill -CONT "$0" 2>/dev/null'
# A connection breaks shortly before the process that held it can be seen to have ended.
_END_S = 0.5


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


def log_tail(file: Path) -> str:
    """The last lines of a log; empty if there is none."""
    with contextlib.suppress(OSError):
        return "\n".join(file.read_text(errors="replace").splitlines()[-15:])
    return ""


@contextlib.contextmanager
def end_explained(daemon: ChildProcess | None, log_file: Path | None) -> Iterator[None]:
    """While a command uses a daemon: if it is the command's own and ended, a failure within says how, with its log.

    The call that was under way knows only that its connection broke.
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
