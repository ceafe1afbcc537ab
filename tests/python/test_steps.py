"""A scene as a context manager, and the records of its steps: against a fake control plane and a real daemon."""

from __future__ import annotations

import grpc
import pytest
from conftest import Recorder

import tensormass as tm
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

Fake = tuple[Recorder, tm.Server]


class SpoiltError(Exception):
    """An error of the caller's own."""


@pytest.fixture
def loaded(recorder: Fake) -> tuple[Recorder, tm.SceneHandle]:
    fake, server = recorder
    fake.replies |= {"LoadScene": control_pb2.LoadSceneResponse(), "UnloadScene": control_pb2.UnloadSceneResponse()}
    return fake, server.load(tm.Scene("s"))


def unloads(fake: Recorder) -> int:
    return fake.asked.count(control_pb2.UnloadSceneRequest(scene="s"))


def test_the_end_of_a_block_unloads_the_scene(loaded: tuple[Recorder, tm.SceneHandle]) -> None:
    fake, scene = loaded
    with scene as handle:
        assert handle is scene
        assert unloads(fake) == 0
    assert unloads(fake) == 1


def test_an_exception_unloads_the_scene_too(loaded: tuple[Recorder, tm.SceneHandle]) -> None:
    fake, scene = loaded
    with pytest.raises(SpoiltError), scene:
        raise SpoiltError
    assert unloads(fake) == 1


def test_a_scene_that_is_gone_at_the_end_of_its_block_is_not_an_error(loaded: tuple[Recorder, tm.SceneHandle]) -> None:
    fake, scene = loaded
    with scene:
        fake.failure = (grpc.StatusCode.NOT_FOUND, "no scene 's'")
    assert unloads(fake) == 1


def test_a_scene_that_cannot_be_unloaded_is_an_error(loaded: tuple[Recorder, tm.SceneHandle]) -> None:
    fake, scene = loaded
    with pytest.raises(tm.UnavailableError, match="shutting down"), scene:
        fake.failure = (grpc.StatusCode.UNAVAILABLE, "shutting down")


@pytest.mark.parametrize("code", [grpc.StatusCode.NOT_FOUND, grpc.StatusCode.UNAVAILABLE])
def test_a_failed_unload_does_not_hide_the_error_of_the_block(
    loaded: tuple[Recorder, tm.SceneHandle], code: grpc.StatusCode
) -> None:
    fake, scene = loaded
    fake.failure = (code, "gone")
    with pytest.raises(SpoiltError), scene:
        raise SpoiltError
    assert unloads(fake) == 1


def stepping(recorder: Fake, statuses: list[stream_pb2.SceneStatus]) -> Recorder:
    """Makes the fake answer each step with the next status, and GetStatus with the last one."""
    fake, _ = recorder
    fake.replies["LoadScene"] = control_pb2.LoadSceneResponse()
    fake.replies["GetStatus"] = control_pb2.GetStatusResponse(status=statuses[0])
    left = iter(statuses[1:])
    answer = fake.answer

    def step_first(method: str, request: object, context: grpc.ServicerContext) -> object:
        if method == "StepScene":
            status = next(left)
            fake.replies["StepScene"] = control_pb2.StepSceneResponse(status=status)
            fake.replies["GetStatus"] = control_pb2.GetStatusResponse(status=status)
        return answer(method, request, context)

    fake.answer = step_first  # type: ignore[method-assign]
    return fake


def test_counters_of_the_scene_become_those_of_each_step(recorder: Fake) -> None:
    status = stream_pb2.SceneStatus
    fake = stepping(
        recorder,
        [
            status(step=7, unconverged_steps=2, guard_events=5),
            status(step=8, unconverged_steps=2, guard_events=5, newton_iterations=3, newton_residual=2e-6),
            status(
                step=9,
                unconverged_steps=3,
                guard_events=7,
                newton_iterations=4,
                kinetic_energy_j=0.5,
                recovering=True,
            ),
            status(step=10, unconverged_steps=3, guard_events=7, newton_iterations=2),
        ],
    )
    records = list(recorder[1].scene("s").steps(3))
    assert [record.step for record in records] == [8, 9, 10]
    assert [record.converged for record in records] == [True, False, True]
    assert [record.rejected_attempts for record in records] == [0, 2, 0]
    assert [record.recovering for record in records] == [False, True, False]
    assert [record.newton_iterations for record in records] == [3, 4, 2]
    assert records[0].newton_residual == 2e-6
    assert records[1].kinetic_energy_j == 0.5
    assert records[1].status.unconverged_steps == 3
    assert fake.asked.count(control_pb2.StepSceneRequest(scene="s", count=1)) == 3


@pytest.mark.parametrize(
    ("solver", "residual", "converged"),
    [
        (scene_pb2.Solver(), 9e-4, True),
        (scene_pb2.Solver(), 2e-3, False),
        (scene_pb2.Solver(cg_tolerance=1e-2), 2e-3, True),
        (scene_pb2.Solver(cg_tolerance=0), 2e-3, True),
        (scene_pb2.Solver(), float("nan"), False),
        (None, 0.0, None),
    ],
)
def test_one_linear_solve_converges_at_the_tolerance_of_the_scene(
    recorder: Fake, solver: scene_pb2.Solver | None, residual: float, converged: bool | None
) -> None:
    stepping(recorder, [stream_pb2.SceneStatus(), stream_pb2.SceneStatus(step=1, cg_relative_residual=residual)])
    server = recorder[1]
    scene = server.scene("s") if solver is None else server.load(scene_pb2.Scene(name="s", solver=solver))
    assert [record.converged for record in scene.steps(1)] == [converged]


def test_a_step_is_made_when_its_record_is_asked_for(recorder: Fake) -> None:
    fake = stepping(recorder, [stream_pb2.SceneStatus(step=step) for step in range(4)])
    records = recorder[1].scene("s").steps(3)
    asked = len(fake.asked)
    assert next(records).step == 1
    assert len(fake.asked) == asked + 2
    assert list(recorder[1].scene("s").steps(0)) == []


def test_a_negative_number_of_steps_is_refused_at_once(recorder: Fake) -> None:
    stepping(recorder, [stream_pb2.SceneStatus()])
    with pytest.raises(tm.InvalidArgumentError, match="count: expected 0 or more steps, got -1"):
        recorder[1].scene("s").steps(-1)


def test_a_daemon_that_does_not_count_step_times_is_named(recorder: Fake) -> None:
    fake, server = recorder
    times = stream_pb2.DurationHistogram(buckets=[500], counts=[3], max_s=1.0)
    for status, count in ((stream_pb2.SceneStatus(), 0), (stream_pb2.SceneStatus(step=3, step_times=times), 3)):
        fake.replies["GetStatus"] = control_pb2.GetStatusResponse(status=status)
        assert server.scene("s").step_times().count == count
    fake.replies["GetStatus"] = control_pb2.GetStatusResponse(status=stream_pb2.SceneStatus(step=3))
    with pytest.raises(tm.FailedPreconditionError, match="does not count step times"):
        server.scene("s").step_times()


# --- with a daemon ----------------------------------------------------------------------------------------------------


def swinging(newton_max_iterations: int = 1) -> tm.Scene:
    """Makes a bar that starts to swing under gravity, clamped at one end."""
    mesh = tm.grid([4, 1, 1], [0.2, 0.05, 0.05], shape="hexahedron")
    scene = tm.Scene.from_mesh(mesh, name="bar", fixed_nodes=mesh.nodes[:, 0] == 0, gravity_m_per_s2=(0, 0, -9.81))
    scene.message.solver.newton_max_iterations = newton_max_iterations
    return scene


def test_steps_are_those_of_step(server: tm.Server) -> None:
    with server.load(swinging(), lockstep=True) as scene:
        records = list(scene.steps(5))
        energies = [record.kinetic_energy_j for record in records]
        scene.reset()
        assert energies == [scene.step().kinetic_energy_j for _ in range(5)]
    assert [record.step for record in records] == [1, 2, 3, 4, 5]
    assert [record.simulated_time_s for record in records] == pytest.approx([step / 60 for step in range(1, 6)])
    assert all(record.converged and record.cg_relative_residual <= 1e-3 for record in records)
    assert min(record.cg_iterations for record in records) > 0
    with pytest.raises(tm.NotFoundError):
        scene.status()


def test_a_step_that_newtons_method_does_not_finish_has_not_converged(server: tm.Server) -> None:
    scene = swinging(newton_max_iterations=2)
    scene.message.solver.newton_tolerance = 1e-12
    with server.load(scene, lockstep=True) as handle:
        records = list(handle.steps(3))
    assert [record.newton_iterations for record in records] == [2, 2, 2]
    assert not any(record.converged for record in records)


def test_the_loop_raises_the_fault_after_the_records_before_it(server: tm.Server) -> None:
    scene = swinging()
    scene.message.solver.cg_max_iterations = 1
    scene.message.solver.cg_tolerance = scene.message.solver.floor_tolerance = 1e-9
    with server.load(scene, lockstep=True) as handle, pytest.raises(tm.FailedPreconditionError, match="left its bound"):
        list(handle.steps(10))


# A block under a probe, for steps that follow a path.
PRESSED = """
name: pressed
gravity_m_per_s2: {z: -9.81}
stepping: {dt_s: 0.005}
bodies:
  - name: block
    mesh: {grid: {size_m: {x: 0.08, y: 0.08, z: 0.04}, cells_x: 4, cells_y: 4, cells_z: 2}}
    law: {neo_hookean: {young_modulus_pa: 5000, poisson_ratio: 0.4}}
    density_kg_per_m3: 1000
    fixed: [{box: {min_m: {x: -1, y: -1, z: -1}, max_m: {x: 1, y: 1, z: 0.001}}}]
tools:
  - {name: probe, spherical_probe: {radius_m: 0.02}, position_m: {x: 0.04, y: 0.04, z: 0.065}}
"""


def test_following_poses_is_stepping_with_each_of_them(server: tm.Server) -> None:
    poses = [((0.04, 0.04 + 1e-5 * step, 0.065 - 2e-5 * step), None, ()) for step in range(600)]
    with server.load(tm.Scene.from_yaml(PRESSED), lockstep=True) as scene:
        for position_m, _, _ in poses:
            scene.move_tool("probe", position_m)
            stepped = scene.step()
        one_by_one, force = scene.positions("block"), stepped.tools[0].force_n
        scene.reset()
        before = scene.step_times()
        scene.step(3)
        scene.reset()
        followed = scene.follow("probe", poses)
        assert followed.step == 600
        assert followed.tools[0].force_n == force
        assert force.z > 0.01
        assert (scene.positions("block") == one_by_one).all()
        assert (scene.step_times() - before).count == 603
        # The next poses go on from there.
        assert scene.follow("probe", poses[:2]).step == 602
        scene.adjust(stiffness_factor={"block": 2.0})
        assert scene.follow("probe", poses[:2]).step == 604


def test_poses_to_follow_are_checked(server: tm.Server) -> None:
    with server.load(tm.Scene.from_yaml(PRESSED), lockstep=True) as scene:
        with pytest.raises(tm.InvalidArgumentError, match="expected one or more"):
            scene.follow("probe", [])
        with pytest.raises(tm.InvalidArgumentError, match="three finite numbers"):
            scene.follow("probe", [((0, 0), None, ())])
        with pytest.raises(tm.NotFoundError, match="needle"):
            scene.follow("needle", [((0, 0, 1), None, ())])
        assert scene.status().step == 0
    with (
        server.load(tm.Scene.from_yaml(PRESSED), name="running", lockstep=False) as scene,
        pytest.raises(tm.FailedPreconditionError, match="runs by the clock"),
    ):
        scene.follow("probe", [((0, 0, 1), None, ())])
