"""Calls without memory: each allocation of the daemon's own code and of protobuf fails in turn, one in a call."""

from __future__ import annotations

import contextlib
import mmap
import os
import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import pytest
from attack_parts import DEADLINE_S, block, wait_for

import tensormass as tm
from tensormass._shared import processes
from tensormass.v1 import control_pb2, control_pb2_grpc

ALL = os.environ.get("TENSORMASS_ATTACK") == "all"
"""`make attack` sets it. Otherwise a few allocations fail, chosen at random, but the same ones each time."""

Call = Callable[[], object]


class Allocations:
    """Those of a daemon into which tests/control/no_memory.cpp is loaded."""

    MOST = 1 << 40

    def __init__(self, file: Path) -> None:
        file.write_bytes(bytes(8))
        with file.open("r+b") as opened:
            self._map = mmap.mmap(opened.fileno(), 8)

    def set(self, countdown: int) -> None:
        """The allocation of this number fails, counted from 1; 0: none does."""
        self._map[:] = struct.pack("<q", countdown)

    def countdown(self) -> int:
        return int(struct.unpack("<q", self._map[:])[0])

    def count(self, call: Call) -> int:
        """Returns how many allocations a call makes."""
        self.set(self.MOST)
        call()
        made = self.MOST - self.countdown()
        self.set(0)
        return made


@pytest.fixture
def starved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[tm.Server, Allocations]]:
    program = processes.find_program("tensormassd", "TENSORMASSD")
    library = program.parent.parent / "tests" / "no_memory.so"
    if not library.exists():
        pytest.skip("tests/no_memory.so is not built: make test-folder FOLDER=control")
    allocations = Allocations(tmp_path / "countdown")
    monkeypatch.setenv("LD_PRELOAD", str(library))
    monkeypatch.setenv("TENSORMASS_NO_MEMORY", str(tmp_path / "countdown"))
    with contextlib.ExitStack() as undo:
        server = undo.enter_context(tm.launch(backend="cpu", cpu_threads=1, zenoh=False))
        monkeypatch.undo()
        yield server, allocations
        allocations.set(0)


def refusal(call: Call) -> tuple[grpc.StatusCode, str]:
    """Makes a call. Returns OK, or the code and the text of its refusal."""
    try:
        call()
    except grpc.RpcError as refused:
        return refused.code(), refused.details() or ""
    return grpc.StatusCode.OK, ""


@pytest.mark.attack("`bad_alloc` in a call, at every allocation", "SIGABRT")
@pytest.mark.parametrize("name", ["block", "demo"])
def test_a_call_without_memory_is_refused_and_others_go_on(
    starved: tuple[tm.Server, Allocations], name: str, record_property: Callable[[str, object], None]
) -> None:
    server, allocations = starved
    beside = block("other")
    # What it publishes would be counted, too, and shift the numbers from call to call.
    beside.message.streams.frame_rate_hz = beside.message.streams.status_rate_hz = 0
    other = server.load(beside)
    scene = (block("victim") if name == "block" else tm.Scene.from_file("demo")).message
    scene.name = "victim"
    scene.stepping.lockstep = True
    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = control_pb2_grpc.ControlStub(channel)

        def load() -> None:
            stub.LoadScene(control_pb2.LoadSceneRequest(scene=scene), timeout=DEADLINE_S)

        def unload() -> None:
            stub.UnloadScene(control_pb2.UnloadSceneRequest(scene="victim"), timeout=DEADLINE_S)

        def snapshot() -> None:
            stub.SnapshotScene(control_pb2.SnapshotSceneRequest(scene="victim"), timeout=DEADLINE_S)

        def status() -> None:
            stub.GetStatus(control_pb2.GetStatusRequest(scene="victim"), timeout=DEADLINE_S)

        load()
        unload()
        chance = random.Random(name)
        refused = 0
        for call in (load, snapshot, status):
            made = allocations.count(call)
            if name == "demo":
                count = 260 if call is load else 20  # 300 in all
                which = [chance.randrange(1, made + 1) for _ in range(count if ALL else 2)]
            else:
                which = list(range(1, made + 1))
                which = which if ALL else chance.sample(which, min(20, made))
            if call is load:
                unload()
            for n in which:
                allocations.set(n)
                code, said = refusal(call)
                allocations.set(0)
                what = f"{call.__name__}, allocation {n} of {made}: {code} {said}"
                assert code in {grpc.StatusCode.OK, grpc.StatusCode.RESOURCE_EXHAUSTED}, what
                refused += code != grpc.StatusCode.OK
                if call is load:
                    loaded = refusal(unload)[0] == grpc.StatusCode.OK
                    assert loaded == (code == grpc.StatusCode.OK), f"{what}, and the scene is loaded: {loaded}"
            if call is load:
                load()
        step = other.status().step
        wait_for("steps of the other scene", lambda: other.status().step > step)
        stub.StepScene(control_pb2.StepSceneRequest(scene="victim", count=1), timeout=DEADLINE_S)
    assert refused > 0
    record_property("now", f"{refused} calls refused")
