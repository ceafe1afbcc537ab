"""Commands find the daemon that `tensormass run` keeps."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Recorder

import tensormass as tm
from tensormass.v1 import control_pb2
from tensormass_tools import running
from tensormass_tools.cli import main
from tensormass_tools.running import Running, announced, find_server, running_daemons


@pytest.fixture(autouse=True)
def nothing_at_the_default_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_answers", lambda _address: False)


@pytest.fixture
def other_run(runtime_folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that keeps a daemon, as it says, at 127.0.0.1:2222."""
    program = (
        "import sys; from tensormass_tools.running import announced\n"
        "with announced('127.0.0.1:2222', 'beam'):\n    print('ready', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process
        process.kill()


def test_without_a_run_the_default_address_is_asked(runtime_folder: Path) -> None:
    assert find_server(None) == tm.DEFAULT_ADDRESS
    assert find_server("trainer:1") == "trainer:1"
    assert not runtime_folder.exists()


def test_a_run_is_found_while_it_lasts(runtime_folder: Path) -> None:
    with announced("127.0.0.1:1111", "demo"):
        assert running_daemons() == [Running("127.0.0.1:1111", "demo", os.getpid())]
        assert find_server(None) == "127.0.0.1:1111"
        assert find_server("trainer:1") == "trainer:1"
        (file,) = runtime_folder.iterdir()
        assert stat.S_IMODE(runtime_folder.stat().st_mode) == 0o700
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert running_daemons() == []
    assert list(runtime_folder.iterdir()) == []


def test_several_runs_are_named_and_none_is_chosen(other_run: subprocess.Popen[str]) -> None:
    assert find_server(None) == "127.0.0.1:2222"
    refusal = pytest.raises(tm.InvalidArgumentError, match=r"choose one with --server$")
    with announced("127.0.0.1:1111", "demo"), refusal as refused:
        find_server(None)
    for part in ("127.0.0.1:1111 (scene 'demo', process ", "127.0.0.1:2222 (scene 'beam', process "):
        assert part in str(refused.value)


def test_a_daemon_at_the_default_address_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(running, "_answers", lambda address: address == tm.DEFAULT_ADDRESS)
    assert find_server(None) == tm.DEFAULT_ADDRESS
    refusal = pytest.raises(tm.InvalidArgumentError, match=f"several daemons run: .*, {tm.DEFAULT_ADDRESS}; choose")
    with announced("127.0.0.1:1111", "demo"), refusal:
        find_server(None)
    with announced(tm.DEFAULT_ADDRESS, "demo"):  # the same one
        assert find_server(None) == tm.DEFAULT_ADDRESS


def test_a_run_that_was_killed_leaves_nothing(other_run: subprocess.Popen[str], runtime_folder: Path) -> None:
    other_run.kill()
    # Not waited for yet: it is a zombie, and still has its process id.
    os.waitid(os.P_PID, other_run.pid, os.WEXITED | os.WNOWAIT)
    assert len(list(runtime_folder.iterdir())) == 1
    assert running_daemons() == []
    assert list(runtime_folder.iterdir()) == []


def test_a_process_id_that_is_used_again_is_not_that_run(runtime_folder: Path) -> None:
    with announced("127.0.0.1:1111", "demo"):
        (file,) = runtime_folder.iterdir()
        file.write_text(json.dumps({**json.loads(file.read_text()), "started": "1"}))
        assert running_daemons() == []


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"pid": "x"}', "\xff"])
def test_a_file_that_no_run_wrote_is_removed(content: str, runtime_folder: Path) -> None:
    runtime_folder.mkdir(mode=0o700)
    (runtime_folder / "1.json").write_text(content, "latin-1")
    assert running_daemons() == []
    assert not (runtime_folder / "1.json").exists()


def test_a_folder_that_others_may_write_to_is_not_used(runtime_folder: Path) -> None:
    runtime_folder.mkdir()
    runtime_folder.chmod(0o777)
    with announced("127.0.0.1:1111", "demo"):
        assert list(runtime_folder.iterdir()) == []
    (runtime_folder / "1.json").write_text("{}")
    assert running_daemons() == []
    assert (runtime_folder / "1.json").exists()


def test_list_asks_the_running_daemon(recorder: tuple[Recorder, tm.Server], capsys: pytest.CaptureFixture[str]) -> None:
    fake, server = recorder
    fake.replies["ListScenes"] = control_pb2.ListScenesResponse()
    with announced(server.address, "demo"):
        assert main(["list"]) == 0
    assert capsys.readouterr().out == f"server {server.address}\nno scene is loaded\n"
