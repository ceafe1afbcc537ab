"""Strangers on the control plane: what they ask for is bounded, and others get their answers meanwhile."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator

import grpc
import pytest
from attack_parts import (
    DEADLINE_S,
    MIB,
    attacked,
    block,
    cpu_time_of,
    memory_of,
    restart_high_water_mark,
    wait_for,
)

import tensormass as tm
from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2


@pytest.fixture
def server() -> Iterator[tm.Server]:
    with attacked() as server:
        yield server


@pytest.fixture
def stub(server: tm.Server) -> Iterator[control_pb2_grpc.ControlStub]:
    """A client with a channel of its own."""
    assert server.process is not None
    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        yield control_pb2_grpc.ControlStub(channel)


@pytest.mark.attack("70 unary StepScene(1e6) calls", "RESOURCE_EXHAUSTED for everybody else")
def test_long_calls_leave_threads_for_others(
    server: tm.Server, stub: control_pb2_grpc.ControlStub, record_property: Callable[[str, object], None]
) -> None:
    scene, other = server.load(block(), lockstep=True), server.load(block("other"))
    request = control_pb2.StepSceneRequest(scene="block", count=1_000_000)
    steps = [stub.StepScene.future(request, timeout=DEADLINE_S) for _ in range(70)]
    wait_for("steps", lambda: scene.status().step > 0)
    wait_for("the refusals", lambda: sum(call.done() for call in steps) == 30)
    refused = [call for call in steps if call.done()]
    assert {call.code() for call in refused} == {grpc.StatusCode.RESOURCE_EXHAUSTED}
    assert "limits::kMaxLongCalls = 40 calls of this kind run already" in refused[0].details()
    record_property("now", f"{len(refused)} of them refused")

    with grpc.insecure_channel(server.address, options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        health: Callable[..., bytes] = channel.unary_unary("/grpc.health.v1.Health/Check")
        assert health(b"", timeout=DEADLINE_S) == b"\x08\x01", "SERVING"
        victim = control_pb2_grpc.ControlStub(channel)
        assert len(victim.ListScenes(control_pb2.ListScenesRequest(), timeout=DEADLINE_S).scenes) == 2
        victim.GetStatus(control_pb2.GetStatusRequest(scene="block"), timeout=DEADLINE_S)
        victim.GetFrame(control_pb2.GetFrameRequest(scene="other"), timeout=DEADLINE_S)
        victim.ResetScene(control_pb2.ResetSceneRequest(scene="block"), timeout=DEADLINE_S)
        victim.UnloadScene(control_pb2.UnloadSceneRequest(scene="other"), timeout=DEADLINE_S)
        victim.UnloadScene(control_pb2.UnloadSceneRequest(scene="block"), timeout=DEADLINE_S)
    wait_for("the end of the steps", lambda: all(call.done() for call in steps))
    with pytest.raises(tm.NotFoundError):
        other.status()
    server.load(block(), lockstep=True).step(2)


def grid(cells: int, shape: str = "tetrahedron", name: str = "block") -> scene_pb2.Scene:
    """A scene of a few bytes that asks for many elements."""
    scene = block(name).message
    source = scene.bodies[0].mesh.grid
    source.cells_x = source.cells_y = source.cells_z = cells
    source.shape = getattr(scene_pb2, f"SHAPE_{shape.upper()}")
    del scene.bodies[0].fixed[:]
    return scene


def refusal(stub: control_pb2_grpc.ControlStub, scene: scene_pb2.Scene) -> str:
    for call, request in (
        (stub.LoadScene, control_pb2.LoadSceneRequest(scene=scene)),
        (stub.InspectScene, control_pb2.InspectSceneRequest(scene=scene)),
    ):
        with pytest.raises(grpc.RpcError) as refused:
            call(request, timeout=DEADLINE_S)
        assert refused.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED, refused.value.details()
    return str(refused.value.details())


@pytest.mark.attack("a scene of 153 bytes that asks for a grid of 100³", "3.2 GB and 41 s")
def test_a_load_is_refused_before_anything_is_allocated(record_property: Callable[[str, object], None]) -> None:
    with attacked("--max-scene-mib", "1000", "--max-memory-mib", "2000", "--max-load-s", "40") as server:
        with grpc.insecure_channel(server.address) as channel:
            stub = control_pb2_grpc.ControlStub(channel)
            restart_high_water_mark(server)
            before = memory_of(server, "VmHWM")
            said = refusal(stub, grid(100))
            assert "scene 'block' has about 6000000 elements" in said
            assert "needs about 3" in said
            assert "more than --max-scene-mib 1000; use a coarser mesh" in said
            assert "more than --max-load-s 40; use a coarser mesh" in refusal(stub, grid(200))
            grown = memory_of(server, "VmHWM") - before
        record_property("now", f"refused, +{grown / MIB:.1f} MiB")
        assert grown < 16 * MIB


@pytest.mark.attack("UnloadScene in a first step that takes minutes", "hangs until the step ends")
def test_a_scene_is_unloaded_in_the_middle_of_a_step(
    server: tm.Server, stub: control_pb2_grpc.ControlStub, record_property: Callable[[str, object], None]
) -> None:
    message = grid(24)
    message.solver.integrator = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC
    message.bodies[0].fixed.add().box.CopyFrom(block().message.bodies[0].fixed[0].box)
    # Soft and nearly incompressible, so that no iteration settles.
    law = message.bodies[0].law.st_venant_kirchhoff
    law.young_modulus_pa, law.poisson_ratio = 100, 0.499
    message.gravity_m_per_s2.z = -9.81
    message.solver.cg_max_iterations = 100_000
    message.solver.cg_tolerance = 0
    message.solver.newton_max_iterations = 10_000
    message.solver.newton_tolerance = 1e-12
    server.load(tm.Scene(message=message), lockstep=True)
    before = cpu_time_of(server)
    step = stub.StepScene.future(control_pb2.StepSceneRequest(scene="block", count=1), timeout=DEADLINE_S)
    wait_for("the middle of the step", lambda: cpu_time_of(server) > before + 0.5)
    begin = time.monotonic()
    stub.UnloadScene(control_pb2.UnloadSceneRequest(scene="block"), timeout=DEADLINE_S)
    record_property("now", f"returns after {time.monotonic() - begin:.2f} s")
    assert step.exception(timeout=DEADLINE_S) is not None
    assert step.code() == grpc.StatusCode.UNAVAILABLE, step.details()
    assert "is being unloaded" in step.details()


def test_loads_that_fit_one_by_one_do_not_pass_the_limit_of_all() -> None:
    with attacked("--max-memory-mib", "200") as server:
        loaded, said = 0, ""
        while not said:
            try:
                server.load(tm.Scene(message=grid(28, name=f"block-{loaded}")), lockstep=True)
                loaded += 1
            except tm.ResourceExhaustedError as refused:
                said = str(refused)
        assert 1 <= loaded < 20
        assert re.search(r"needs about \d+ MiB, but \d+ MiB of --max-memory-mib 200 are taken; unload a scene", said)
        assert memory_of(server) < 200 * MIB
        server.scene("block-0").step(1)
        server.scene("block-0").unload()


@pytest.mark.parametrize(
    ("shape", "cells"),
    [
        ("tetrahedron", 24),
        ("pyramid", 16),
        ("wedge", 20),
        ("hexahedron", 20),
        ("quadratic_tetrahedron", 10),
        ("quadratic_hexahedron", 10),
    ],
)
def test_the_estimate_of_a_load_bounds_what_it_takes(shape: str, cells: int) -> None:
    with attacked("--max-scene-mib", "1") as server, grpc.insecure_channel(server.address) as channel:
        said = refusal(control_pb2_grpc.ControlStub(channel), grid(cells, shape))
        estimated = int(said.partition("needs about ")[2].partition(" MiB")[0]) * MIB
    with attacked() as server:
        restart_high_water_mark(server)
        before = memory_of(server, "VmHWM")
        server.load(tm.Scene(message=grid(cells, shape)), lockstep=True)
        taken = memory_of(server, "VmHWM") - before
    assert taken < estimated + 4 * MIB
    assert estimated < 3 * taken
