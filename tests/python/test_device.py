"""A GPU that fails, that is full, and that is in the middle of a step. What needs a GPU is skipped without one."""

from __future__ import annotations

import contextlib
import ctypes
import os
import time
from collections.abc import Iterator
from pathlib import Path

import grpc
import pytest
from trainer import DEADLINE_S, PROGRAM, Trainer, ended, wait_until

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc, finding_pb2, scene_pb2, stream_pb2

LOST = 75
"""Status of a daemon whose process lost its GPU (docs/operation.md)."""
BACK_S = 10.0
UNLOADED_S = 0.5
FAULTS = {"illegal address": b"0", "misaligned address": b"1", "assert": b"2", "trap": b"3"}
"""What tests/backend/lose_device.cpp reads."""


@pytest.fixture(autouse=True)
def one_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails or is full is the only GPU of a daemon, also on a machine with several."""
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", first)


@pytest.fixture
def trainer(tmp_path: Path) -> Iterator[Trainer]:
    """A daemon on a GPU with a state folder."""
    made = Trainer(tmp_path, backend="cuda", zenoh=False)
    try:
        made.start()
    except AssertionError as no_device:
        pytest.skip(str(no_device))
    made.stop()
    yield from ended(made)


def long_step(cells: tuple[int, int, int], precision: scene_pb2.Solver.Precision) -> tm.Scene:
    """A beam whose first step takes minutes: long, soft and nearly incompressible, so that no iteration settles."""
    message = scene_pb2.Scene(name="long")
    body = message.bodies.add(name="beam", density_kg_per_m3=1000)
    grid = body.mesh.grid
    grid.cells_x, grid.cells_y, grid.cells_z = cells
    grid.size_m.x, grid.size_m.y, grid.size_m.z = (0.002 * count for count in cells)
    law = body.law.st_venant_kirchhoff
    law.young_modulus_pa, law.poisson_ratio = 1000, 0.499
    box = body.fixed.add().box
    box.min_m.x = box.min_m.y = box.min_m.z = -1
    box.max_m.x, box.max_m.y, box.max_m.z = 0.0001, 1, 1
    message.accepted_findings.add(code=finding_pb2.FINDING_CODE_LOCKING, reason="nobody sees a result")
    message.gravity_m_per_s2.z = -9.81
    message.stepping.dt_s = 0.01
    message.stepping.lockstep = True
    solver = message.solver
    solver.integrator = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
    solver.precision = precision
    solver.cg_max_iterations = 100_000
    solver.cg_tolerance = 0
    solver.newton_max_iterations = 10_000
    solver.newton_tolerance = 1e-12
    return tm.Scene(message=message)


FLOAT, DOUBLE = scene_pb2.Solver.PRECISION_FLOAT, scene_pb2.Solver.PRECISION_DOUBLE


@pytest.mark.parametrize(
    ("backend", "cells", "precision"),
    [
        pytest.param("cpu", (60, 4, 4), FLOAT, id="cpu"),
        pytest.param("cuda", (60, 4, 4), FLOAT, id="cuda-resident"),
        pytest.param("cuda", (200, 22, 22), FLOAT, id="cuda-streamed"),
        pytest.param("cuda", (60, 8, 8), DOUBLE, id="cuda-double"),
    ],
)
def test_a_scene_is_unloaded_in_the_middle_of_a_solve(
    backend: str, cells: tuple[int, int, int], precision: scene_pb2.Solver.Precision
) -> None:
    """A solve of 100,000 iterations alone takes up to seconds, so that the step must end within one."""
    try:
        server = tm.launch(backend=backend, cpu_threads=1, zenoh=False)
    except tm.UnavailableError as no_device:
        pytest.skip(str(no_device))
    with server, grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        server.load(long_step(cells, precision))
        stub = control_pb2_grpc.ControlStub(channel)
        step = stub.StepScene.future(control_pb2.StepSceneRequest(scene="long", count=1), timeout=DEADLINE_S)
        with pytest.raises(grpc.FutureTimeoutError):
            step.result(timeout=1)
        begin = time.monotonic()
        stub.UnloadScene(control_pb2.UnloadSceneRequest(scene="long"), timeout=DEADLINE_S)
        took_s = time.monotonic() - begin
        print(f"unloaded after {took_s:.3f} s")
        assert isinstance(step.exception(timeout=DEADLINE_S), grpc.RpcError)
        assert step.code() == grpc.StatusCode.UNAVAILABLE, step.details()
        assert "is being unloaded" in step.details()
    # A busy machine gets more.
    assert took_s < UNLOADED_S + 5 * (os.getloadavg()[0] > 1), f"{took_s:.2f} s"


def fault_maker() -> Path:
    """The library that takes a GPU from the daemon into which it is loaded."""
    for folder in (PROGRAM.parent.parent / "tests", PROGRAM.parent):
        if (folder / "lose_device.so").exists():
            return folder / "lose_device.so"
    pytest.skip("tests/lose_device.so is not built")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_daemon_that_lost_its_gpu_ends_and_its_scenes_are_back(trainer: Trainer, tmp_path: Path, fault: str) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    trainer.start(environment={"LD_PRELOAD": str(fault_maker()), "TENSORMASS_LOSE_DEVICE": str(fifo)})
    with tm.connect(trainer.endpoints["control"]) as server, contextlib.ExitStack() as streams:
        demo = server.load("demo")
        held = server.load("demo", name="held", lockstep=True)
        held.step(3)
        frames = streams.enter_context(demo.frames(timeout_s=DEADLINE_S))
        before = next(frames)
        wait_until(lambda: all(trainer.snapshots(name) for name in ("demo", "held")))
        assert trainer.child is not None
        begin = time.monotonic()
        fifo.write_bytes(FAULTS[fault])
        status = trainer.child.process.wait(DEADLINE_S)
        ended_s = time.monotonic() - begin
        trainer.child.stop()
        assert status == LOST, trainer.log.read_text()
        trainer.start()
        back_s = time.monotonic() - begin
        print(f"{fault}: the daemon ended after {ended_s:.2f} s, and its scenes were back after {back_s:.2f} s")
        frame = next(frames)
        while frame.topology.version == before.topology.version:  # was on its way
            frame = next(frames)
        assert demo.status().step > 0
        assert held.status().step == 3
        held.step(1)
        assert back_s < BACK_S
    assert "the process lost its device" in trainer.log.read_text()


class DeviceMemory:
    """Device memory that this process takes from others, through CUDA's driver."""

    def __init__(self) -> None:
        self._cuda = ctypes.CDLL("libcuda.so.1")
        self._taken: list[ctypes.c_void_p] = []
        context = ctypes.c_void_p()
        self._call("cuInit", 0)
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(context), 0)
        self._call("cuCtxSetCurrent", context)

    def take_all(self) -> None:
        size = self.free_bytes()
        while size >= 1 << 16:
            place = ctypes.c_void_p()
            if self._cuda.cuMemAlloc_v2(ctypes.byref(place), ctypes.c_size_t(size)) == 0:
                self._taken.append(place)
            else:
                size //= 2

    def give_back(self) -> None:
        while self._taken:
            self._call("cuMemFree_v2", self._taken.pop())

    def free_bytes(self) -> int:
        free, total = ctypes.c_size_t(), ctypes.c_size_t()
        self._call("cuMemGetInfo_v2", ctypes.byref(free), ctypes.byref(total))
        return free.value

    def _call(self, function: str, *arguments: object) -> None:
        assert getattr(self._cuda, function)(*arguments) == 0, function


def test_without_device_memory_a_load_and_a_call_are_refused_and_others_go_on(trainer: Trainer) -> None:
    trainer.start()
    with tm.connect(trainer.endpoints["control"]) as server:
        running = server.load("demo")
        held = server.load("demo", name="held", lockstep=True)
        held.step(3)
        memory = DeviceMemory()
        memory.take_all()
        try:
            print(f"{memory.free_bytes() >> 10} KiB of device memory are free")
            for _ in range(3):  # also what a refusal left must do for nobody
                with pytest.raises(tm.ResourceExhaustedError, match="of device memory are free; unload a scene"):
                    server.load("demo", name="another")
                with pytest.raises(tm.ResourceExhaustedError, match="of device memory are free"):
                    held.adjust(gravity_m_per_s2=(0, 0, -5))
            assert held.step(2).step == 5
            assert held.status().state == stream_pb2.SceneStatus.STATE_LOCKSTEP
            step = running.status().step
            wait_until(lambda: running.status().step > step + 10)
            assert [status.scene for status in server.scenes()] == ["demo", "held"]
        finally:
            memory.give_back()
        server.load("demo", name="another").unload()
        held.adjust(gravity_m_per_s2=(0, 0, -5))
        held.step(1)
        assert trainer.stop() == 0
