"""Finds the daemons that `tensormass run` started, so that other commands need no --server.

Each `run` keeps a file with its daemon's address in a folder of the user. A run that is killed leaves its file behind.
Such a file is recognized by the process it names: that process is gone, or started later (process ids are reused).
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tensormass import DEFAULT_ADDRESS, InvalidArgumentError

# A daemon at the default address is on this machine and answers at once.
_CONNECT_S = 0.25


@dataclass(frozen=True)
class Running:
    """A daemon that a `tensormass run` of this user keeps."""

    #: host:port
    control: str
    scene: str
    #: Process of the command, not of the daemon.
    pid: int

    def __str__(self) -> str:
        return f"{self.control} (scene {self.scene!r}, process {self.pid})"


def find_server(given: str | None) -> str:
    """The address that a command asks: the given one, else that of the only daemon that runs here.

    A daemon runs here if `tensormass run` keeps it, or if something answers at the default address. Without any, the
    default address is returned, and connecting to it says that nobody answers.

    Raises:
        InvalidArgumentError: several run; the message names them.
    """
    if given is not None:
        return given
    found = running_daemons()
    addresses = [str(each) for each in found]
    if DEFAULT_ADDRESS not in [each.control for each in found] and _answers(DEFAULT_ADDRESS):
        addresses.append(DEFAULT_ADDRESS)
    if len(addresses) > 1:
        raise InvalidArgumentError(f"several daemons run: {', '.join(addresses)}; choose one with --server")
    return found[0].control if found else DEFAULT_ADDRESS


@contextlib.contextmanager
def announced(control: str, scene: str) -> Iterator[None]:
    """Lets other commands of this user find the daemon at `control` while the body runs.

    An unusable folder is not a failure, because --server still works.
    """
    file = _folder() / f"{os.getpid()}.json"
    content = {"control": control, "scene": scene, "pid": os.getpid(), "started": _started(os.getpid())}
    try:
        _write(file, json.dumps(content))
    except OSError:
        yield
        return
    try:
        yield
    finally:
        file.unlink(missing_ok=True)


def running_daemons() -> list[Running]:
    """The daemons that runs of this user keep, by address. Removes the files of runs that were killed."""
    folder = _folder()
    if not _is_ours(folder):
        return []
    found = []
    for file in sorted(folder.glob("*.json")):
        try:
            content = json.loads(file.read_text("utf-8"))
            daemon = Running(str(content["control"]), str(content["scene"]), int(content["pid"]))
            alive = _started(daemon.pid) == content["started"] is not None
        except FileNotFoundError:  # that run ended meanwhile
            continue
        except (OSError, ValueError, KeyError, TypeError):  # not written by `announced`
            alive = False
        if alive:
            found.append(daemon)
        else:
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)
    return sorted(found, key=lambda each: each.control)


def _folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "tensormass" if runtime else Path(tempfile.gettempdir()) / f"tensormass-{os.getuid()}"


def _is_ours(folder: Path) -> bool:
    """Whether nobody else can put files into the folder: others may create it first under a shared /tmp."""
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022


def _write(file: Path, content: str) -> None:
    """Writes in one step: a reader finds the whole file or none."""
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_ours(file.parent):
        raise PermissionError(f"{file.parent} belongs to somebody else, or others may write to it")
    with tempfile.NamedTemporaryFile("w", dir=file.parent, prefix=".", delete=False) as aside:
        aside.write(content)
    os.replace(aside.name, file)


def _started(pid: int) -> str | None:
    """When a process started, in the kernel's clock ticks; None if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    # The name in brackets, which may hold anything, is the second field; the start is the 22nd. A process that has
    # ended and was not yet waited for is a zombie, Z.
    return None if fields[0] == "Z" else fields[19]


def _answers(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        with socket.create_connection((host, int(port)), _CONNECT_S):
            return True
    except OSError:
        return False
