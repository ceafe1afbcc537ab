"""The SDK and a real daemon together. Without build/bin/tensormassd these are skipped."""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlparse

import grpc
import numpy as np
import pytest
import zmq
from service_parts import DEADLINE_S, block
from test_mesh_files import shared_mesh

import tensormass as tm
from tensormass._src import mesh_files, mesh_geometry, meshes, tetwild
from tensormass._src.fields import FIELD_NAMES
from tensormass._src.packing import pack_mesh
from tensormass._src.shapes import SHAPES
from tensormass._src.streams import Transport, stream_key
from tensormass.v1 import scene_pb2, stream_pb2
from tensormass_tools.output import state_name

TRANSPORTS: tuple[Transport, ...] = ("zeromq", "zenoh")

PRESS_M = (0.05, 0.05, 0.055)  # the sphere's lowest point is 10 mm below the top


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1) as server:
        yield server


@pytest.fixture
def load(server: tm.Server) -> Iterator[Callable[..., tm.SceneHandle]]:
    """Loads under a name of its own and unloads afterwards."""
    handles: list[tm.SceneHandle] = []

    def load(scene: tm.Scene | str, lockstep: bool | None = None) -> tm.SceneHandle:
        handles.append(server.load(scene, name=f"test-{next(_NUMBER)}", lockstep=lockstep))
        return handles[-1]

    yield load
    for handle in handles:
        with contextlib.suppress(tm.NotFoundError):  # a test may have done so
            handle.unload()


_NUMBER = itertools.count()


def tetrahedron_scene(**options: object) -> tm.Scene:
    nodes = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.1, 0.1, 0.1]])
    return tm.Scene.from_arrays(nodes, [[0, 1, 2, 3], [1, 2, 3, 4]], **options)


def wait_for(what: str, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited {DEADLINE_S:g} s for {what}"
        time.sleep(0.005)


# --- control ----------------------------------------------------------------------------------------------------------


def test_a_free_body_falls_as_implicit_euler_says(load: Callable[..., tm.SceneHandle]) -> None:
    scene = tetrahedron_scene(gravity_m_per_s2=(0, 0, -9.81))
    scene.message.stepping.dt_s = 0.01
    handle = load(scene, lockstep=True)
    rest = handle.positions("body")
    assert rest.dtype == np.float64
    assert handle.step(10).step == 10
    fallen = -9.81 * 0.01**2 * 10 * 11 / 2
    np.testing.assert_allclose(handle.positions("body") - rest, [[0, 0, fallen]] * 5, atol=2e-5)
    handle.reset()
    np.testing.assert_allclose(handle.positions("body"), rest, atol=1e-7)
    assert handle.status().step == 0


def test_the_probe_presses_and_feels_it(load: Callable[..., tm.SceneHandle]) -> None:
    handle = load(block(), lockstep=True)
    handle.step(20)
    assert handle.feedback("probe").force_n[2] == 0
    before = handle.positions("tissue")
    handle.move_tool("probe", PRESS_M)
    handle.step(60)
    feedback = handle.feedback("probe")
    np.testing.assert_allclose(feedback.position_m, PRESS_M, atol=1e-6)
    assert feedback.force_n[2] > 0.05
    assert abs(feedback.force_n[0]) < 0.2 * feedback.force_n[2]
    assert np.linalg.eigvalsh(feedback.stiffness_n_per_m).min() > -1e-3
    assert feedback.valid_for_s > 0
    moved = handle.positions("tissue") - before
    deepest = np.argmin(moved[:, 2])
    assert moved[deepest, 2] < -0.003
    assert np.linalg.norm(before[deepest, :2] - PRESS_M[:2]) < 0.02


def test_a_jump_is_followed_at_the_tools_speed(load: Callable[..., tm.SceneHandle]) -> None:
    scene = block()
    scene.message.tools[0].max_speed_m_per_s = 0.1
    handle = load(scene, lockstep=True)
    handle.move_tool("probe", (0.05, 0.05, 0.58))
    handle.step(10)
    assert handle.feedback("probe").position_m[2] == pytest.approx(0.08 + 10 * 0.1 * 0.005, abs=1e-6)


def test_jaws_follow_the_pose_and_stay_without_one(load: Callable[..., tm.SceneHandle]) -> None:
    scene = block()
    above_m = (0.05, 0.05, 0.2)
    scene.add_tool("grasper", "grasper", position_m=above_m, joint_values=[1.0], radius_m=0.004, jaw_length_m=0.03)
    handle = load(scene, lockstep=True)
    assert handle.feedback("grasper").joint_values == [1.0]
    handle.move_tool("grasper", above_m, joint_values=[1.01])
    handle.step()
    assert handle.feedback("grasper").joint_values == [1.01]
    handle.move_tool("grasper", (0.05, 0.05, 0.201))
    handle.step()
    feedback = handle.feedback("grasper")
    assert feedback.joint_values == [1.01]
    assert feedback.joint_loads == [0.0]
    np.testing.assert_allclose(feedback.position_m, (0.05, 0.05, 0.201))
    for wrong, why in (
        ([-0.1], r"joint_values\[0\] \(opening_rad\): -0.1 is not within"),
        ([1, 1], "2 values for a tool"),
    ):
        with pytest.raises(tm.InvalidArgumentError, match=why):
            handle.move_tool("grasper", above_m, joint_values=wrong)
        scene.message.tools[-1].joint_values[:] = wrong
        with pytest.raises(tm.InvalidArgumentError, match=why):
            load(scene)


def test_surface_is_the_meshs_boundary_at_its_nodes(load: Callable[..., tm.SceneHandle]) -> None:
    handle = load(block(), lockstep=True)
    handle.step(5)
    vertices, triangles = handle.surface("tissue")
    body = handle.topology().bodies[0]
    nodes = np.frombuffer(body.nodes, "<u4")
    np.testing.assert_allclose(vertices, handle.positions("tissue")[nodes], atol=1e-6)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(0.1 * 0.1 * 0.05, rel=0.05)


def test_a_skin_is_seen_instead_and_carried_along(load: Callable[..., tm.SceneHandle]) -> None:
    nodes = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    mesh = meshes.VolumeMesh.from_tetrahedra(nodes, [[0, 1, 2, 3]])
    shell = mesh_geometry.boundary_surface(mesh)
    centre = nodes.mean(axis=0)
    skin = meshes.TriangleSurface(centre + 0.8 * (shell.vertices - centre), shell.triangles)
    scene = tm.Scene.from_mesh(mesh, gravity_m_per_s2=(0, 0, -9.81), skin=skin)
    scene.message.bodies[0].mesh.scale = 2.0
    scene.message.bodies[0].mesh.translation_m.x = 1.0
    handle = load(scene, lockstep=True)
    placed = 2.0 * skin.vertices + [1.0, 0.0, 0.0]
    np.testing.assert_allclose(handle.surface("body")[0], placed, atol=1e-6)
    handle.step(10)
    fall = (handle.positions("body") - (2.0 * nodes + [1.0, 0.0, 0.0])).mean(axis=0)
    assert fall[2] < -0.01
    np.testing.assert_allclose(handle.surface("body")[0] - placed, [fall] * 4, atol=1e-4)


def test_states_and_refusals(server: tm.Server, load: Callable[..., tm.SceneHandle]) -> None:
    running = load(block())
    assert state_name(running.status()) == "running"
    with pytest.raises(tm.FailedPreconditionError, match="lockstep"):
        running.step()
    assert state_name(running.pause()) == "paused"
    at = running.status().step
    assert running.status().step == at
    running.resume()
    wait_for("steps after resume", lambda: running.status().step > at)
    with pytest.raises(tm.AlreadyExistsError, match=running.name):
        server.load(block(), name=running.name)
    assert running.name in [status.scene for status in server.scenes()]
    running.unload()
    for call in (running.status, running.frame, running.unload):
        with pytest.raises(tm.NotFoundError, match=running.name):
            call()
    lockstep = load(block(), lockstep=True)
    with pytest.raises(tm.NotFoundError, match="needle"):
        lockstep.move_tool("needle", (0, 0, 0))
    with pytest.raises(tm.NotFoundError, match="spleen"):
        lockstep.positions("spleen")
    with pytest.raises(tm.InvalidArgumentError):
        lockstep.step(0)


def test_several_scenes_step_side_by_side(load: Callable[..., tm.SceneHandle]) -> None:
    first, second = load(block()), load(block())
    wait_for("both scenes", lambda: min(first.status().step, second.status().step) > 20)


# --- meshes -----------------------------------------------------------------------------------------------------------


def test_the_shared_liver_loads_and_steps(load: Callable[..., tm.SceneHandle]) -> None:
    mesh = mesh_files.read_mesh(shared_mesh("liver.msh"))
    nodes = 0.03 * mesh.nodes
    scene = tm.Scene.from_mesh(
        replace(mesh, nodes=nodes),
        young_modulus_pa=40_000.0,  # stiff enough to stay near its shape, hung up by a fifth of it
        fixed_nodes=nodes[:, 1] < np.quantile(nodes[:, 1], 0.2),
        gravity_m_per_s2=(0, -9.81, 0),
    )
    handle = load(scene, lockstep=True)
    assert handle.report is not None
    assert (handle.report.bodies[0].node_count, handle.report.bodies[0].element_count) == (181, 596)
    status = handle.step(50)
    assert status.fault == ""
    moved = np.linalg.norm(handle.positions("body") - nodes, axis=1)
    assert np.isfinite(moved).all()
    assert 1e-4 < moved.max() < 0.05


def test_a_scene_file_of_the_shared_liver_scales_mesh_and_skin(
    load: Callable[..., tm.SceneHandle], tmp_path: Path
) -> None:
    mesh_file, skin_file = shared_mesh("liver.msh"), shared_mesh("liver-smooth.obj")
    scene_file = tmp_path / "scene.yaml"
    scene_file.write_text(
        f"""
        name: liver
        bodies:
          - name: liver
            mesh: {{file: {os.path.relpath(mesh_file, tmp_path)}, scale: 0.03}}
            skin: {{file: {os.path.relpath(skin_file, tmp_path)}}}
            law: {{hooke: {{young_modulus_pa: 4000, poisson_ratio: 0.45}}}}
            density_kg_per_m3: 1060
        """
    )
    handle = load(str(scene_file), lockstep=True)
    handle.step(3)
    vertices, triangles = handle.surface("liver")
    skin = mesh_files.read_surface(skin_file)
    np.testing.assert_array_equal(triangles, skin.triangles)
    np.testing.assert_allclose(vertices, 0.03 * skin.vertices, atol=1e-5)


def test_the_shared_liver_surface_becomes_a_volume_that_steps(load: Callable[..., tm.SceneHandle]) -> None:
    surface = mesh_files.read_surface(shared_mesh("liver-smooth.obj"))
    volume = tetwild.tetrahedralize(meshes.TriangleSurface(0.03 * surface.vertices, surface.triangles), 0.03)
    handle = load(tm.Scene.from_mesh(volume, gravity_m_per_s2=(0, 0, -9.81)), lockstep=True)
    status = handle.step(10)
    assert (status.fault, status.step) == ("", 10)


def packed_scene(nodes: np.ndarray, tetrahedra: np.ndarray) -> tm.Scene:
    """Past the SDK's own checks."""
    scene = tetrahedron_scene()
    scene.message.bodies[0].mesh.packed.node_positions = nodes.astype("<f8").tobytes()
    scene.message.bodies[0].mesh.packed.elements[0].nodes = tetrahedra.astype("<u4").tobytes()
    return scene


NODES = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1], [0.1, 0.1, 0.1]])
TETRAHEDRA = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "says"),
    [
        (NODES, TETRAHEDRA[:, [0, 1, 3, 2]], ["body", "0", "wind|invert|negative"]),
        (NODES, np.array([[0, 1, 2, 3], [1, 2, 3, 77]]), ["body", "1", "77"]),
        (NODES, TETRAHEDRA[:1], ["body", "node", "4"]),
        (NODES * [1, 1, np.nan], TETRAHEDRA, ["body", "finite"]),
        (NODES, np.array([[0, 1, 2, 2], [1, 2, 3, 4]]), ["body", "0"]),
        (NODES, TETRAHEDRA.ravel()[:7], ["body", "elements[0].nodes"]),
        (NODES, np.empty((0, 4)), ["body"]),
    ],
    ids=["inverted", "out of range", "unused node", "nan", "repeated node", "cut off", "empty"],
)
def test_a_bad_mesh_is_refused_by_name_and_the_daemon_lives(
    server: tm.Server, nodes: np.ndarray, tetrahedra: np.ndarray, says: list[str]
) -> None:
    with pytest.raises(tm.InvalidArgumentError) as error:
        server.load(packed_scene(nodes, tetrahedra))
    for words in says:
        assert any(word in str(error.value) for word in words.split("|")), str(error.value)
    server.version()


def test_a_scene_pays_only_for_the_parts_it_uses(server: tm.Server) -> None:
    with_tool = server.inspect(block())
    bare = block()
    del bare.message.tools[:]
    without_tool = server.inspect(bare)
    assert any("contact" in stage.name for stage in with_tool.stages)
    assert not any("contact" in stage.name for stage in without_tool.stages)
    assert not any("contact" in buffer.name for buffer in without_tool.buffers)
    assert without_tool.bytes_total < with_tool.bytes_total
    assert without_tool.not_modelled
    assert server.scenes() == []


@pytest.mark.parametrize("name", tm.builtin_scenes())
def test_builtin_scenes_step_without_fault(name: str, load: Callable[..., tm.SceneHandle]) -> None:
    handle = load(name, lockstep=True)
    status = handle.step(20)
    assert (status.fault, status.step) == ("", 20)
    assert handle.report is not None
    assert list(handle.report.warnings) == []
    for body in handle.report.bodies:
        assert np.isfinite(handle.positions(body.name)).all()


def test_the_demo_organ_keeps_its_shape_and_yields_to_the_probe(load: Callable[..., tm.SceneHandle]) -> None:
    handle = load("demo", lockstep=True)
    rest = handle.positions("liver")
    handle.step(90)
    settled = handle.positions("liver")
    assert np.linalg.norm(settled - rest, axis=1).max() < 0.01
    x, y, _ = handle.feedback("probe").position_m
    handle.move_tool("probe", (x, y, 0.05))
    handle.step(60)
    assert 0.05 < handle.feedback("probe").force_n[2] < 5
    moved = np.linalg.norm(handle.positions("liver") - settled, axis=1)
    assert moved.max() > 0.004
    assert np.linalg.norm(settled[np.argmax(moved)][:2] - [x, y]) < 0.03


# --- fields -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_grid_is_cut_here_as_in_the_daemon(load: Callable[..., tm.SceneHandle], shape: str) -> None:
    scene = tm.Scene.from_yaml(
        f"""
        name: grid
        bodies:
          - name: body
            mesh:
              grid:
                {{origin_m: {{x: 1}}, size_m: {{x: 1, y: 2, z: 3}}, cells_x: 2, cells_y: 3, cells_z: 1, shape: {shape}}}
            law: {{hooke: {{young_modulus_pa: 1000, poisson_ratio: 0.3}}}}
            density_kg_per_m3: 1000
            fixed: [{{box: {{min_m: {{x: 0, y: -1, z: -1}}, max_m: {{x: 1.1, y: 9, z: 9}}}}}}]
        gravity_m_per_s2: {{x: 1, y: 2, z: 3}}
        solver: {{precision: double}}
        """
    )
    grid = load(scene, lockstep=True)
    mesh = tm.grid([2, 3, 1], [1.0, 2.0, 3.0], shape=shape, origin_m=[1.0, 0.0, 0.0])
    scene.message.bodies[0].mesh.packed.CopyFrom(pack_mesh(mesh))
    packed = load(scene, lockstep=True)
    np.testing.assert_allclose(grid.positions("body"), mesh.nodes, atol=1e-12)
    grid.step(3)
    packed.step(3)
    names: list[tm.FieldName] = ["displacement", "elastic_energy"]
    left, right = grid.fields("body", names), packed.fields("body", names)
    assert np.ptp(left["elastic_energy"]) > 1e-3 * left["elastic_energy"].max()  # no two elements alike
    for name in names:
        np.testing.assert_allclose(left[name], right[name], rtol=1e-9, atol=1e-15)


def test_fields_of_a_body(load: Callable[..., tm.SceneHandle]) -> None:
    handle = load(block(), lockstep=True)
    rest = handle.positions("tissue")
    handle.step(5)
    fields = handle.fields("tissue", FIELD_NAMES)
    assert set(fields.values) == set(FIELD_NAMES)
    assert fields.step == 5
    assert fields.simulated_time_s == pytest.approx(0.025)
    np.testing.assert_allclose(fields["displacement"], handle.positions("tissue") - rest, atol=1e-9)
    element_count = handle.report.bodies[0].element_count if handle.report else 0
    assert fields["cauchy_stress"].shape == (element_count, 6)
    assert fields["det_f"].shape == (element_count,)
    assert fields.min_det_f == fields["det_f"].min()
    assert fields.elastic_energy_j == pytest.approx(fields["elastic_energy"].sum())
    assert fields.kinetic_energy_j > 0
    free = rest[:, 2] > 0.001
    assert not fields["reaction_force"][free].any()
    s = fields["cauchy_stress"]
    deviator = s[:, :3] - s[:, :3].mean(axis=1, keepdims=True)
    expected = np.sqrt(1.5 * (deviator**2).sum(axis=1) + 3 * (s[:, 3:] ** 2).sum(axis=1))
    np.testing.assert_allclose(fields["von_mises_stress"], expected)
    with pytest.raises(tm.NotFoundError, match="spleen"):
        handle.fields("spleen")


# --- streams ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_frames_come_newest_first_to_a_slow_reader(load: Callable[..., tm.SceneHandle], transport: Transport) -> None:
    handle = load(block())
    with handle.frames(transport, timeout_s=DEADLINE_S) as frames:
        steps = [next(frames).step for _ in range(4)]
        assert steps == sorted(set(steps))
        # The reader rests until frames have been published past it, then reads one: it is a recent one.
        published = handle.status().frames_published
        wait_for("frames to go by", lambda: handle.status().frames_published > published + 10)
        at = handle.status().step
        assert next(frames).step > at - 10 * 20
        next(frames)
        assert frames.dropped_count >= 5


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_late_subscriber_gets_topology_and_status(
    server: tm.Server, load: Callable[..., tm.SceneHandle], transport: Transport
) -> None:
    handle = load(block(), lockstep=True)
    handle.step(3)
    for stream, kind in (("topology", stream_pb2.Topology), ("status", stream_pb2.SceneStatus)):
        with server.data_plane.subscribe(handle.name, stream, kind, transport) as subscription:
            assert subscription.receive(DEADLINE_S).scene == handle.name


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_late_reader_gets_all_events(load: Callable[..., tm.SceneHandle], transport: Transport) -> None:
    scene = load(block(), lockstep=True)
    scene.step(2)
    snapshot = scene.snapshot()
    scene.reset()
    scene.restore(snapshot)
    scene.adjust(stiffness_factor={scene.topology().bodies[0].name: 2.0})
    with scene.events(transport, timeout_s=DEADLINE_S) as events:
        found = [next(events) for _ in range(3)]
        assert [(event.sequence, event.kind, event.step) for event in found] == [
            (1, "reset", 0),
            (2, "restored", 2),
            (3, "adjusted", 2),
        ]
        assert found[0].text == "the scene was reset"
        scene.reset()
        assert next(events).kind == "reset"
    assert scene.frame().revision == 0
    assert scene.frame().triangles(scene.topology().bodies[0].name).shape[1] == 3


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_poses_over_the_bus_move_the_tool_and_come_back(
    load: Callable[..., tm.SceneHandle], transport: Transport
) -> None:
    handle = load(block())
    with handle.tool_stream("probe", transport) as poses, handle.feedbacks("probe", transport) as feedbacks:
        deadline = time.monotonic() + DEADLINE_S
        feedback = tm.Feedback.from_message(feedbacks.receive(DEADLINE_S))
        while feedback.pose_sequence == 0 or np.linalg.norm(feedback.position_m - PRESS_M) > 1e-4:
            assert time.monotonic() < deadline
            sent = poses.send(PRESS_M)
            feedback = tm.Feedback.from_message(feedbacks.receive(DEADLINE_S))
            assert feedback.pose_sequence <= sent
        wait_for("the last pose", lambda: handle.feedback("probe").pose_sequence == poses.last_sequence)
        wait_for("a force", lambda: handle.feedback("probe").force_n[2] > 0.05)


# --- what means nothing -----------------------------------------------------------------------------------------------

GARBAGE = [b"", b"\0", b"\xff" * 100, os.urandom(3000), b"tensormass/", b"GET / HTTP/1.1\r\n\r\n", os.urandom(1 << 20)]


def test_garbage_on_every_endpoint_is_survived_and_counted(
    server: tm.Server, load: Callable[..., tm.SceneHandle]
) -> None:
    handle = load(block())
    version = server.version()
    pose_key = stream_key(version.server, handle.name, "tool/probe/pose")
    valid = stream_pb2.ToolPose(sequence=1, client_id=5, position_m=scene_pb2.Vector3(x=np.nan)).SerializeToString()

    with zmq.Context() as context:
        for kind, endpoint in ((zmq.PUSH, version.zeromq_pose_endpoint), (zmq.SUB, version.zeromq_publish_endpoint)):
            with context.socket(kind) as sender:
                sender.setsockopt(zmq.LINGER, 2000)
                sender.connect(endpoint)
                for payload in GARBAGE:
                    if kind == zmq.SUB:
                        sender.subscribe(payload[:1000])
                        continue
                    sender.send(payload)
                    sender.send(pose_key.encode() + b"\0" + payload)
                    sender.send_multipart([pose_key.encode(), payload])
                if kind == zmq.PUSH:
                    sender.send(pose_key.encode() + b"\0" + valid)
                    sender.send(stream_key(version.server, "nowhere", "tool/probe/pose").encode() + b"\0" + valid)
    session = server.data_plane.zenoh()
    for payload in (*GARBAGE, valid):
        session.put(pose_key, payload)
        session.put(stream_key(version.server, handle.name, "tool/none/pose"), payload)
    for endpoint in (
        f"tcp://{server.address}",
        version.zeromq_pose_endpoint,
        version.zeromq_publish_endpoint,
        f"tcp://{version.zenoh_locator.removeprefix('tcp/')}",
    ):
        address = urlparse(endpoint)
        for payload in GARBAGE:
            with contextlib.suppress(OSError), socket.create_connection((address.hostname, address.port), 5) as raw:
                raw.sendall(payload)

    wait_for("garbage to be counted", lambda: server.version().malformed_messages >= version.malformed_messages + 10)
    wait_for("a pose that is not finite to be refused", lambda: handle.status().poses_rejected >= 1)
    at = handle.status().step
    wait_for("steps", lambda: handle.status().step > at + 10)
    handle.move_tool("probe", PRESS_M)
    wait_for("the next good pose", lambda: handle.feedback("probe").pose_sequence == 1)


def test_bytes_that_are_not_a_request_are_refused(server: tm.Server) -> None:
    with grpc.insecure_channel(server.address) as channel:
        call = channel.unary_unary("/tensormass.v1.Control/LoadScene", lambda payload: payload, lambda payload: payload)
        for payload in (b"\xff" * 100, os.urandom(1000)):
            with pytest.raises(grpc.RpcError):
                call(payload, timeout=DEADLINE_S)
    server.version()
