"""docs/security.md's five commands, between two network namespaces that this test makes."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("cryptography", reason="needs the extra `keys`")

from attack_parts import wait_for

from tensormass._shared.processes import find_program

PAGE = Path(__file__).parents[2] / "docs/security.md"
TRAINER, CONSOLE = "192.0.2.1", "192.0.2.2"
TIMEOUT_S = 300


def commands() -> list[str]:
    section = PAGE.read_text().split("## Two machines in five commands")[1].split("\n## ")[0]
    return re.findall(r"^    (.+)$", section, re.MULTILINE)


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=60)


@contextlib.contextmanager
def two_machines() -> Iterator[tuple[str, str]]:
    """Makes two network namespaces with a cable between them; skips where that is not allowed."""
    if shutil.which("ip") is None:
        pytest.skip("no `ip`, which Debian has in iproute2")
    names = f"tm-a-{os.getpid()}", f"tm-b-{os.getpid()}"
    with contextlib.ExitStack() as undo:
        try:
            for name in names:
                run("ip", "netns", "add", name)
                undo.callback(subprocess.run, ["ip", "netns", "delete", name], capture_output=True)
            run("ip", "link", "add", "cable", "netns", names[0], "type", "veth", "peer", "cable", "netns", names[1])
            for name, address in zip(names, (TRAINER, CONSOLE), strict=True):
                run("ip", "-n", name, "address", "add", f"{address}/24", "dev", "cable")
                run("ip", "-n", name, "link", "set", "cable", "up")
                run("ip", "-n", name, "link", "set", "lo", "up")
                run("ip", "netns", "exec", name, "true")  # mounts /sys, which needs more rights
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired, OSError) as error:
            pytest.skip(f"network namespaces are not allowed here: {getattr(error, 'stderr', b'') or error}")
        yield names


def test_the_five_commands(tmp_path: Path) -> None:
    page = [line.replace("trainer.example", TRAINER) for line in commands()]
    assert len(page) == 5
    programs = {
        "tensormass": f"{sys.executable} -m tensormass",
        "tensormassd": f"{find_program('tensormassd', 'TENSORMASSD')} --backend cpu --ready-file ready.json",
        "tensormass-haptic": f"{find_program('tensormass-haptic', 'TENSORMASS_HAPTIC')} --seconds 2",
    }
    lines = []
    for line in page:
        program, _, rest = line.partition(" ")
        lines.append(shlex.split(f"{programs[program]} {rest}"))
    init, add, daemon, load, haptic = lines
    with two_machines() as (trainer, console), contextlib.ExitStack() as undo:

        def on(machine: str, command: list[str]) -> subprocess.CompletedProcess[str]:
            done = subprocess.run(
                ["ip", "netns", "exec", machine, *command],
                cwd=tmp_path,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=TIMEOUT_S,
            )
            assert done.returncode == 0, f"{command}: {done.stdout}"
            return done

        on(trainer, init)
        on(trainer, add)
        with (tmp_path / "log").open("wb") as log:
            process = subprocess.Popen(["ip", "netns", "exec", trainer, *daemon], cwd=tmp_path, stdout=log, stderr=log)
        undo.callback(process.wait, 30)
        undo.callback(process.terminate)
        wait_for("the daemon", lambda: (tmp_path / "ready.json").exists() or process.poll() is not None)
        assert process.poll() is None, (tmp_path / "log").read_text()
        os.replace(tmp_path / "keys/clients/console.json", tmp_path / "console.json")
        on(console, load)
        for transport in ("zeromq", "zenoh"):
            on(console, [*haptic, "--transport", transport])
        # Without keys, nothing.
        refused = subprocess.run(
            [
                "ip",
                "netns",
                "exec",
                console,
                *shlex.split(programs["tensormass"]),
                "list",
                "--server",
                f"{TRAINER}:50051",
            ],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
        assert refused.returncode == 1
        assert "give your file of keys" in refused.stderr
