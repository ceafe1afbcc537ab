"""What the tests of `--state` share: a daemon that is ended and started again. Without a build they are skipped."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import tensormass as tm
from tensormass._shared import processes

DEADLINE_S = 60.0
"""Only ends a test that hangs."""

try:
    PROGRAM = processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Trainer:
    """A daemon with a state folder, which starts again on the endpoints that it had."""

    def __init__(self, folder: Path, backend: str = "cpu", zenoh: bool = True) -> None:
        self.state = folder / "state"
        self.log = folder / "log"
        self._ready = folder / "ready.json"
        self._backend = backend
        self.endpoints = {
            "control": "127.0.0.1:0",
            "zeromq_publish": "tcp://127.0.0.1:*",
            "zeromq_pose": "tcp://127.0.0.1:*",
            "zenoh": "tcp/127.0.0.1:0" if zenoh else "off",
        }
        self.child: processes.ChildProcess | None = None

    def start(self, *options: str, environment: dict[str, str] | None = None) -> None:
        self._ready.unlink(missing_ok=True)
        names = {"zenoh": "zenoh-listen"}
        flags = [
            f"--{names.get(name, name.replace('_', '-'))}={where or 'off'}" for name, where in self.endpoints.items()
        ]
        args: list[str | Path] = [
            PROGRAM,
            "--backend",
            self._backend,
            "--cpu-threads",
            "1",
            "--state",
            self.state,
            "--ready-file",
            self._ready,
        ]
        with self.log.open("ab") as log:
            self.child = child = processes.ChildProcess([*args, *flags, *options], output=log, environment=environment)
        wait_until(lambda: self._ready.exists() or not child.running)
        assert child.running, self.log.read_text()
        ready = json.loads(self._ready.read_text())
        self.endpoints = {name: ready[name] for name in self.endpoints}

    def kill(self) -> None:
        assert self.child is not None
        self.child.process.kill()
        self.child.process.wait()
        self.child.stop()

    def stop(self) -> int:
        assert self.child is not None
        return self.child.stop(timeout_s=DEADLINE_S)

    def snapshots(self, scene: str) -> list[Path]:
        return sorted(self.state.glob(f"{scene}.*.snapshot"), key=lambda path: int(path.name.split(".")[1]))


def ended(made: Trainer) -> Iterator[Trainer]:
    """Yields the trainer, and ends its daemon at last."""
    try:
        yield made
    finally:
        if made.child is not None and made.child.running:
            made.child.stop()
