"""Fixtures of several tests."""

from __future__ import annotations

import contextlib
import resource
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path
from typing import Any

import grpc
import pytest
from daemon_parts import make_viewer, small_daemon

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc


@contextlib.contextmanager
def full_disk(free_bytes: int = 2000) -> Iterator[None]:
    """Limits the size of files, which a writer sees as a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture(autouse=True)
def runtime_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sets the folder in which `tensormass run` announces its daemon: one for each test."""
    folder = tmp_path_factory.mktemp("runtime")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder / "tensormass"


class Recorder(control_pb2_grpc.ControlServicer):
    """Answers with the test's `replies`, or fails with `failure`; records the requests in `asked`."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        #: Time-out of the last call [s].
        self.time_left_s = 0.0
        self.failure: tuple[grpc.StatusCode, str] | None = None
        self.replies: dict[str, Any] = {"GetVersion": control_pb2.GetVersionResponse(server="s", version="1")}

    def __getattribute__(self, name: str) -> Any:  # noqa: ANN401
        if name[0].isupper():
            return lambda request, context: self.answer(name, request, context)
        return super().__getattribute__(name)

    def answer(self, method: str, request: Any, context: grpc.ServicerContext) -> Any:  # noqa: ANN401
        self.asked.append(request)
        self.time_left_s = context.time_remaining()
        if self.failure is not None:
            context.abort(*self.failure)
        return self.replies[method]


@pytest.fixture
def recorder() -> Iterator[tuple[Recorder, tm.Server]]:
    recorder = Recorder()
    server = grpc.server(futures.ThreadPoolExecutor(2))
    control_pb2_grpc.add_ControlServicer_to_server(recorder, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with tm.connect(f"127.0.0.1:{port}") as client:
        yield recorder, client
    server.stop(grace=None)


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    """Makes a folder like that of the built viewer."""
    return make_viewer(tmp_path / "dist")


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    """A daemon on one thread, for the tests of a file; they are skipped without a build."""
    with small_daemon() as server:
        yield server
