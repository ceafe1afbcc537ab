"""Forces, displacements and initial states from arrays, and solver settings: in the message and in a real daemon."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import tensormass as tm
from tensormass._src.packing import body_mesh, middle_ends
from tensormass.v1 import scene_pb2

MESH = tm.grid([2, 1, 1], [0.2, 0.1, 0.1])
COUNT = len(MESH.nodes)  # 12
WALL = MESH.nodes[:, 0] == 0
NAN = float("nan")


def bar(**options: Any) -> tm.Scene:  # noqa: ANN401
    mesh = tm.VolumeMesh.from_arrays(MESH.nodes, [("tetrahedron", MESH.elements("tetrahedron"))], sets={"wall": WALL})
    return tm.Scene.from_mesh(mesh, name="bar", body="bar", **options)


def random_rows(width: int = 3, count: int = COUNT) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(count, width))


# --- messages ---------------------------------------------------------------------------------------------------------


def forces_of(body: scene_pb2.Body) -> np.ndarray:
    """Returns the force on each node of a mesh without added nodes, [node_count, 3] N, as the daemon reads it."""
    forces = np.zeros((COUNT, 3))
    for load in body.loads:
        nodes = list(load.region.nodes.indices)
        force = load.force_n
        forces[nodes] += np.array([force.x, force.y, force.z]) / len(nodes)
    return forces


def test_a_force_for_each_node_is_an_entry_for_each_different_force() -> None:
    scene = bar()
    forces = random_rows()
    forces[3] = forces[7] = forces[8]
    forces[5] = 0
    scene.add_nodal_forces("bar", forces)
    body = scene.body("bar")
    np.testing.assert_allclose(forces_of(body), forces, rtol=1e-15)
    assert len(body.loads) == COUNT - 3
    assert [3, 7, 8] in [list(load.region.nodes.indices) for load in body.loads]


def test_forces_on_the_same_node_add_up() -> None:
    scene = bar()
    scene.add_nodal_forces("bar", [[1, 0, 0], [0, 2, 0], [4, 0, 0]], [5, 5, 6])
    scene.add_nodal_forces("bar", [[0, 0, 8]], np.arange(COUNT) == 6)
    expected = np.zeros((COUNT, 3))
    expected[5], expected[6] = (1, 2, 0), (4, 0, 8)
    np.testing.assert_array_equal(forces_of(scene.body("bar")), expected)


def test_each_entry_of_forces_has_their_schedule() -> None:
    scene = bar()
    scene.add_nodal_forces("bar", [[1, 0, 0], [2, 0, 0]], [5, 6], schedule=[(0, 0), (1, 2)])
    scene.add_nodal_forces("bar", [[1, 0, 0]], [5])
    schedule = scene_pb2.Schedule(time_s=[0, 1], factor=[0, 2])
    first, second, constant = scene.body("bar").loads
    assert first.schedule == second.schedule == schedule == tm.schedule_message([(0, 0), (1, 2)])
    assert not constant.HasField("schedule")


def test_gravity_has_a_schedule() -> None:
    mesh = tm.grid([1, 1, 1], [1, 1, 1])
    scene = tm.Scene.from_mesh(mesh, gravity_m_per_s2=(0, 0, -9.81), gravity_schedule=[(0, 1), (2, 0)])
    assert scene.message.gravity_schedule == scene_pb2.Schedule(time_s=[0, 2], factor=[1, 0])
    assert not tm.Scene.from_mesh(mesh, gravity_m_per_s2=(0, 0, -1)).message.HasField("gravity_schedule")
    with pytest.raises(tm.InvalidArgumentError, match="gravity_schedule: given without gravity_m_per_s2"):
        tm.Scene.from_mesh(mesh, gravity_schedule=[(0, 1)])
    with pytest.raises(tm.InvalidArgumentError, match="gravity_schedule: time 0 s of row 1 does not come after 0 s"):
        tm.Scene.from_mesh(mesh, gravity_m_per_s2=(0, 0, -1), gravity_schedule=[(0, 1), (0, 0)])


def test_one_displacement_for_a_set_is_one_entry() -> None:
    scene = bar()
    scene.prescribe("bar", [0.01, 0], "wall", axes="xz", schedule=[(0, 0), (1, 2)])
    (entry,) = scene.body("bar").prescribed
    schedule = scene_pb2.Schedule(time_s=[0, 1], factor=[0, 2])
    assert entry == scene_pb2.PrescribedDisplacement(
        region=scene_pb2.Region(set="wall"), x_m=0.01, z_m=0, schedule=schedule
    )


def test_displacements_of_equal_rows_share_an_entry() -> None:
    scene = bar()
    scene.prescribe("bar", [[1, 2], [3, 4], [1, 2]], [7, 1, 4], axes="zx")
    entries = {tuple(entry.region.nodes.indices): entry for entry in scene.body("bar").prescribed}
    assert set(entries) == {(7, 4), (1,)}
    assert (entries[7, 4].z_m, entries[7, 4].x_m) == (1, 2)
    assert not entries[7, 4].HasField("y_m")
    assert not entries[7, 4].HasField("schedule")
    assert (entries[1,].z_m, entries[1,].x_m) == (3, 4)


def test_nodes_are_fixed_in_all_directions_or_some() -> None:
    scene = bar()
    scene.fix("bar", "wall")
    scene.fix("bar", [3, 4])
    scene.fix("bar", np.arange(COUNT) == 9, axes="y")
    body = scene.body("bar")
    nodes = scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=[3, 4]))
    assert list(body.fixed) == [scene_pb2.Region(set="wall"), nodes]
    partly = scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=[9]))
    assert list(body.prescribed) == [scene_pb2.PrescribedDisplacement(region=partly, y_m=0)]


def test_a_body_of_a_scene_file_takes_arrays_too() -> None:
    scene = tm.Scene.from_file("cantilever")
    count = 21 * 5 * 5
    scene.set_initial_state("beam", displacement_m=np.ones((count, 3)))
    assert len(scene.body("beam").initial_displacement_m) == 24 * count


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: s.fix("baz", [0]), "scene 'bar' has no body 'baz'; did you mean 'bar'"),
        (lambda s: s.fix("bar", [COUNT]), "bar.nodes: index 12, but nodes run from 0 to 11"),
        (lambda s: s.fix("bar", [-1]), "bar.nodes: index -1"),
        (lambda s: s.fix("bar", []), "bar.nodes: has no nodes"),
        (lambda s: s.fix("bar", np.zeros(COUNT, bool)), "bar.nodes: has no nodes"),
        (lambda s: s.fix("bar", np.ones(3, bool)), r"bar.nodes: a mask needs shape \[12\], got \[3\]"),
        (lambda s: s.fix("bar", "wal"), "bar.nodes: the body has no set 'wal'; did you mean 'wall'"),
        (lambda s: s.fix("bar", [0], axes="xw"), "bar.axes: expected some of 'x', 'y' and 'z', such as 'xz', got 'xw'"),
        (lambda s: s.fix("bar", [0], axes="xx"), "bar.axes"),
        (lambda s: s.fix("bar", [0], axes=""), "bar.axes"),
        (lambda s: s.add_nodal_forces("bar", [1, 2, 3]), r"forces_n: expected shape \[12, 3\], a row .*, got \[3\]"),
        (lambda s: s.add_nodal_forces("bar", [[1, 2, 3]], [0, 1]), r"expected shape \[2, 3\].*, got \[1, 3\]"),
        (lambda s: s.add_nodal_forces("bar", [[1, NAN, 3]], [0]), r"bar.forces_n: row 0 is not finite: \[1.0, nan, 3"),
        (lambda s: s.add_nodal_forces("bar", [["1 N", 0, 0]], [0]), "bar.forces_n: not an array of numbers"),
        (lambda s: s.add_nodal_forces("bar", [[1, 2, 3]], "wall"), "bar.nodes: expected .*, got the text 'wall'"),
        (
            lambda s: s.add_nodal_forces("bar", [[1, 2, 3]], [0], schedule=[0, 1]),
            "bar.schedule: expected pairs of time",
        ),
        (lambda s: s.prescribe("bar", [[1, 2, 3]], [0], axes="xy"), r"displacement_m: expected shape \[1, 2\]"),
        (lambda s: s.prescribe("bar", [[1, 2, 3]] * 2, [4, 4]), "bar.nodes: node 4 stands there twice"),
        (
            lambda s: s.prescribe("bar", [[1, 2, 3]], "wall"),
            r"displacement_m: expected shape \[3\], the same .*, got \[1, 3\]",
        ),
        (lambda s: s.prescribe("bar", [1, 2, NAN], [0]), "bar.displacement_m: row 0 is not finite"),
        (lambda s: s.prescribe("bar", [0, 0, 1], [0], schedule=[]), "bar.schedule: "),
        (lambda s: s.prescribe("bar", [0, 0, 1], [0], schedule=[0, 1]), "bar.schedule: expected pairs of time"),
        (lambda s: s.prescribe("bar", [0, 0, 1], [0], schedule=1.0), "bar.schedule: expected pairs of time"),
        (lambda s: s.prescribe("bar", [0, 0, 1], [0], schedule=[(0, NAN)]), "bar.schedule: row 0 is not finite"),
        (
            lambda s: s.prescribe("bar", [0, 0, 1], [0], schedule=[(0, 0), (2, 1), (2, 3)]),
            "bar.schedule: time 2 s of row 2 does not come after 2 s",
        ),
        (lambda s: s.set_initial_state("bar", displacement_m=[0, 0, 0]), r"bar.displacement_m: expected shape \[12, 3"),
        (
            lambda s: s.set_initial_state(
                "bar", displacement_m=np.zeros((COUNT, 3)), velocity_m_per_s=np.full((COUNT, 3), np.inf)
            ),
            "bar.velocity_m_per_s: row 0 is not finite",
        ),
        (lambda s: s.set_solver(integrator="bdf"), "set_solver: integrator: unknown value 'bdf'; did you mean 'bdf2'"),
        (lambda s: s.set_solver(precision=64), "set_solver: precision: unknown value 64"),
        (lambda s: s.set_solver(cg_tolerance=NAN), "set_solver: cg_tolerance: expected a finite number"),
        (lambda s: s.set_solver(cg_tolerance="1e-3"), "set_solver: cg_tolerance: expected a number, found '1e-3'"),
        (lambda s: s.set_solver(cg_tolerance=[1e-3]), "set_solver: cg_tolerance: expected one value"),
        (lambda s: s.set_solver(cg_max_iterations=1.5), "cg_max_iterations: expected a whole number, found 1.5"),
        (lambda s: s.set_solver(cpu_threads=-1), "cpu_threads: expected a whole number of 0 to"),
        (lambda s: s.set_solver(cpu_threads=True), "cpu_threads: expected a number, found true"),
        (lambda s: s.set_stepping(dt_s=NAN), "set_stepping: dt_s: expected a finite number"),
        (lambda s: s.set_stepping(dt_s="1 ms"), "set_stepping: dt_s: expected a number, found '1 ms'"),
    ],
)
def test_a_mistake_is_refused_by_the_name_of_its_argument(call: Callable[[tm.Scene], None], message: str) -> None:
    scene = bar()
    before = scene_pb2.Scene()
    before.CopyFrom(scene.message)
    with pytest.raises(tm.InvalidArgumentError, match=message):
        call(scene)
    assert scene.message == before, "a refused call must change nothing"


def test_solver_settings_are_fields_of_the_message() -> None:
    scene = bar()
    scene.set_solver(integrator="bdf2", precision="double", cg_tolerance=1e-6, newton_max_iterations=np.int64(5))  # type: ignore[arg-type]
    scene.set_solver(cg_tolerance=0)
    scene.set_stepping(dt_s=np.float64(0.01))
    expected = scene_pb2.Solver(
        integrator=scene_pb2.Solver.INTEGRATOR_BDF2,
        precision=scene_pb2.Solver.PRECISION_DOUBLE,
        cg_tolerance=0,
        newton_max_iterations=5,
    )
    assert scene.message.solver == expected
    assert scene.message.stepping == scene_pb2.Stepping(dt_s=0.01)


def test_every_solver_setting_has_an_argument() -> None:
    arguments = set(tm.Scene.set_solver.__annotations__) | set(tm.Scene.keep_to_budget.__annotations__)
    assert set(scene_pb2.Solver.DESCRIPTOR.fields_by_name) <= arguments


# --- with a daemon ----------------------------------------------------------------------------------------------------


def equilibrium(**options: Any) -> tm.Scene:  # noqa: ANN401
    scene = bar(law="hooke", **options)
    scene.set_solver(integrator="quasi_static", precision="double", cg_tolerance=1e-10, newton_tolerance=1e-9)
    return scene


@pytest.mark.parametrize("order", ["as_given", "quadratic"])
def test_each_node_feels_its_own_force(server: tm.Server, order: str) -> None:
    """Fixed nodes answer with the opposite force. The nodes that the daemon adds get none."""
    forces = random_rows()
    forces[3] = forces[7] = forces[8]
    scene = equilibrium(element_order=order, fixed_nodes=np.arange(COUNT))
    scene.add_nodal_forces("bar", forces)
    with server.load(scene, lockstep=True) as handle:
        handle.step()
        reaction = handle.fields("bar", ["reaction_force"])["reaction_force"]
    np.testing.assert_allclose(reaction[:COUNT], -forces, rtol=1e-12)
    assert not reaction[COUNT:].any()


@pytest.mark.parametrize("order", ["as_given", "quadratic"])
def test_each_node_takes_its_own_displacement_in_its_axes(server: tm.Server, order: str) -> None:
    moved = 0.01 * random_rows(2, int(WALL.sum()))
    scene = equilibrium(element_order=order)
    scene.prescribe("bar", moved, WALL, axes="xz", schedule=[(0, 0), (1, 0), (2, 1)])
    scene.fix("bar", WALL, axes="y")
    scene.set_stepping(dt_s=1.0)
    with server.load(scene, lockstep=True) as handle:
        still, moving, whole = (
            (handle.step(), handle.fields("bar", ["displacement"])["displacement"])[1] for _ in range(3)
        )
    assert np.abs(still).max() < 1e-12
    np.testing.assert_allclose(moving, whole, atol=1e-9)  # the factor is constant after its last point
    np.testing.assert_allclose(whole[:COUNT][WALL][:, [0, 2]], moved, rtol=1e-12)
    assert not whole[:COUNT][WALL][:, 1].any()
    assert np.abs(whole[:COUNT][~WALL]).min() > 0
    if order == "quadratic":
        ends = middle_ends(scene.body("bar"))
        inside = WALL[ends].all(axis=1)
        assert inside.sum() == 5
        middles = whole[COUNT:][inside]
        np.testing.assert_allclose(middles, whole[ends[inside]].mean(axis=1), atol=1e-12)


def test_middles_of_edges_have_the_ends_that_their_positions_say() -> None:
    body = bar(element_order="quadratic").body("bar")
    nodes = body_mesh(body).nodes
    np.testing.assert_allclose(nodes[COUNT:], MESH.nodes[middle_ends(body)].mean(axis=1))


def test_a_body_starts_as_its_arrays_say(server: tm.Server) -> None:
    displacement, velocity = 1e-3 * random_rows(), random_rows()[::-1]
    scene = bar()
    scene.set_solver(precision="double")
    scene.set_initial_state("bar", displacement_m=displacement, velocity_m_per_s=velocity)
    with server.load(scene, lockstep=True) as handle:
        fields = handle.fields("bar", ["displacement", "velocity"])
    np.testing.assert_allclose(fields["displacement"], displacement, atol=1e-12)
    np.testing.assert_allclose(fields["velocity"], velocity, atol=1e-12)
