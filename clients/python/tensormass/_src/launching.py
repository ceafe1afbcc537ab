"""Starts a daemon for this process and waits until it answers."""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tensormass._shared import errors
from tensormass._shared.client_keys import KeysSource
from tensormass._shared.processes import ChildProcess, find_program
from tensormass._src.server import Server


def launch(
    *,
    backend: str = "auto",
    cpu_threads: int | None = None,
    gpu_scenes: int | None = None,
    control: str = "127.0.0.1:0",
    zenoh: bool = True,
    options: Sequence[str] = (),
    keys: KeysSource | None = None,
    timeout_s: float = 20.0,
) -> Server:
    """Starts a daemon on free loopback ports. It ends with the `Server`, or with this process.

    Args:
        backend: "auto", "cpu" or "cuda".
        cpu_threads: threads of each scene that sets none itself; None leaves it to the daemon.
        gpu_scenes: number of concurrent scenes that must keep their rates on one GPU; None makes each scene as fast as
            it can be alone.
        control: host:port of the control plane; port 0 takes a free one. A fixed port lets clients find a daemon that
            was restarted.
        zenoh: True publishes the streams over zenoh as well as ZeroMQ.
        options: further flags of `tensormassd`.
        keys: of this client, for a daemon whose options have --keys.

    Raises:
        NotFoundError: `tensormassd` is not in $TENSORMASSD, the installed wheel, the checkout's build/bin or PATH.
        UnavailableError: the daemon ended or was not ready in time; the message has the end of its log.
    """
    program = find_program("tensormassd", "TENSORMASSD")
    with contextlib.ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix="tensormass-")))
        ready_file, log_file = folder / "ready.json", folder / "tensormassd.log"
        args: list[str | Path] = [program, "--backend", backend, "--control", control]
        args += ["--zeromq-publish", "tcp://127.0.0.1:*", "--zeromq-pose", "tcp://127.0.0.1:*"]
        args += ["--zenoh-listen", "tcp/127.0.0.1:0" if zenoh else "off", "--ready-file", ready_file]
        if cpu_threads is not None:
            args += ["--cpu-threads", str(cpu_threads)]
        if gpu_scenes is not None:
            args += ["--gpu-scenes", str(gpu_scenes)]
        with log_file.open("wb") as log:
            process = ChildProcess([*args, *options], output=log)
        undo.callback(process.stop)
        address = _wait_until_ready(process, ready_file, log_file, timeout_s)
        server = Server(address, timeout_s=timeout_s, process=process, log_file=log_file, keys=keys)
        server.at_close(undo.pop_all())
        return server


def _wait_until_ready(process: ChildProcess, ready_file: Path, log_file: Path, timeout_s: float) -> str:
    deadline = time.monotonic() + timeout_s
    while True:
        with contextlib.suppress(FileNotFoundError, json.JSONDecodeError):  # missing, or half written
            return str(json.loads(ready_file.read_text())["control"])
        ended = not process.running
        if ended or time.monotonic() > deadline:
            tail = "\n".join(log_file.read_text(errors="replace").splitlines()[-15:])
            what = f"ended with status {process.process.poll()}" if ended else f"was not ready in {timeout_s:g} s"
            raise errors.UnavailableError(f"tensormassd {what}; its log ends:\n{tail}")
        time.sleep(0.005)
