"""Rest positions and element fields on the surface: what the gateway makes of a scene's message, and whom it tells."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from asynchronous import asynchronous
from fake_daemon import fake_daemon, frame_of
from gateway_parts import browse, options

import tensormass as tm
from tensormass._src.packing import body_mesh
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_gateway.fields import FieldPoll
from tensormass_gateway.gateway import serve
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.surface import MismatchError, SurfaceMap, reduced, rest_positions


def cube(skin: np.ndarray | None = None) -> tuple[scene_pb2.Scene, stream_pb2.Topology]:
    """A block of 2x1x1 m in two cells, moved and scaled, and its topology; the surface is a skin or all the nodes."""
    grid = scene_pb2.Grid(size_m=scene_pb2.Vector3(x=2, y=1, z=1), cells_x=2, cells_y=1, cells_z=1)
    body = scene_pb2.Body(name="cube", mesh=scene_pb2.Mesh(grid=grid, scale=2.0))
    body.mesh.grid.shape = scene_pb2.SHAPE_HEXAHEDRON
    body.mesh.translation_m.x = 10
    surface = stream_pb2.BodySurface(name="cube")
    if skin is None:
        surface.vertex_count = 12
        surface.nodes = np.arange(12, dtype="<u4")[::-1].tobytes()
    else:
        surface.vertex_count = len(skin)
        body.skin.packed.vertex_positions = skin.astype("<f8").tobytes()
    scene = scene_pb2.Scene(name="block", bodies=[body])
    return scene, stream_pb2.Topology(scene="block", version=3, bodies=[surface])


def replies(*values: float) -> dict[str, control_pb2.GetFieldsResponse]:
    field = control_pb2.FieldValues(components=1, values=np.array(values, "<f8").tobytes())
    return {"cube": control_pb2.GetFieldsResponse(step=5, fields=[field])}


def test_rest_positions_of_nodes_are_scaled_and_moved() -> None:
    scene, topology = cube()
    nodes = body_mesh(scene.bodies[0]).nodes
    np.testing.assert_allclose(rest_positions(scene, topology), (2 * nodes + [10, 0, 0])[::-1])


def test_rest_positions_of_a_skin_are_scaled_and_moved_like_the_mesh() -> None:
    scene, topology = cube(np.array([[0.5, 0, 0], [1, 1, 1]]))
    np.testing.assert_allclose(rest_positions(scene, topology), [[11, 0, 0], [12, 2, 2]])


def test_node_between_two_elements_has_their_mean() -> None:
    scene, topology = cube()
    x = body_mesh(scene.bodies[0]).nodes[::-1, 0]
    expected = np.where(x == 0, 1.0, np.where(x == 2, 3.0, 2.0))
    np.testing.assert_allclose(SurfaceMap(scene, topology).values("von_mises", replies(1, 3)), expected)


def test_vertex_of_a_skin_takes_the_value_of_the_node_below_it() -> None:
    scene, topology = cube(np.array([[0.0, 0, 0], [2, 1, 0], [1, 0, 1], [0.02, 0.01, 0.01]]))
    values = SurfaceMap(scene, topology).values("volume_ratio", replies(1, 3))
    np.testing.assert_allclose(values[:3], [1, 3, 2], rtol=1e-6)
    assert 1 <= values[3] < 1.1


def test_pressure_is_minus_a_third_of_the_trace() -> None:
    stress = np.array([-3.0, -6, -9, 1, 2, 3, 1, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(reduced("pressure", stress), [6, -1])


@pytest.mark.parametrize("change", ["name", "count", "nodes", "skin"])
def test_topology_of_another_scene_is_refused(change: str) -> None:
    scene, topology = cube(np.zeros((2, 3)) if change == "skin" else None)
    if change == "name":
        topology.bodies[0].name = "other"
    elif change == "nodes":
        topology.bodies[0].nodes = np.full(12, 12, "<u4").tobytes()
    else:
        topology.bodies[0].vertex_count += 1
    with pytest.raises(MismatchError, match="another"):
        rest_positions(scene, topology)


@asynchronous
async def test_rest_positions_follow_the_topology_of_a_scene_that_is_known(viewer: Path) -> None:
    scene, topology = cube()
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control), {"block": scene}) as gateway:
        daemon.topologies["block"] = topology
        async with browse(gateway, "block") as page:
            await page.take(Stream.TOPOLOGY)
            rest = stream_pb2.Frame.FromString(await page.take(Stream.REST))
            assert rest.topology_version == topology.version
            assert rest.positions == rest_positions(scene, topology).tobytes()
            async with browse(gateway, "block") as late:
                await late.take(Stream.TOPOLOGY)
                assert stream_pb2.Frame.FromString(await late.take(Stream.REST)) == rest


@asynchronous
async def test_field_is_sent_to_whom_it_is_shown(viewer: Path) -> None:
    scene, topology = cube()
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control), {"block": scene}) as gateway:
        daemon.topologies["block"] = topology
        daemon.fields = replies(1, 3)["cube"]
        async with browse(gateway, "block") as page, browse(gateway, "block") as other:
            for each in (page, other):
                await each.take(Stream.TOPOLOGY)
                await each.take(Stream.REST)
            await daemon.wait_subscribed("block", "status")
            await page.send(type="field", name="von_mises")
            head, _, values = (await page.take(Stream.FIELD)).partition(b"\n")
            assert json.loads(head) == {"field": "von_mises", "topology_version": "3", "step": 5}
            assert values == SurfaceMap(scene, topology).values("von_mises", replies(1, 3)).tobytes()
            status = stream_pb2.SceneStatus(scene="block", step=5).SerializeToString()
            await daemon.publish("block", "status", status)
            await page.take(Stream.STATUS)
            daemon.fields.step = 6
            await daemon.publish("block", "status", stream_pb2.SceneStatus(scene="block", step=6).SerializeToString())
            await page.take(Stream.STATUS)
            await page.take(Stream.FIELD)
            await other.take(Stream.STATUS)
            assert await other.nothing_pending()
            await page.send(type="field", name="")
            await page.nothing_pending()


@asynchronous
async def test_daemon_is_asked_only_after_new_steps_and_for_new_watchers() -> None:
    _, topology = cube()
    first, second = Watcher(), Watcher()
    source: Any = SimpleNamespace(scene="block", watchers={first}, shown_version=lambda _: topology.version)
    poll = FieldPoll(source)
    assert not poll._due("pressure", 5)
    first.field = "pressure"
    assert poll._due("pressure", 5)
    poll._sent[first] = ("pressure", topology.version, 5)
    assert not poll._due("pressure", 5)
    assert poll._due("pressure", 6)
    second.field = "pressure"
    source.watchers.add(second)
    assert [watcher for watcher, _ in poll._due("pressure", 5)] == [second]


@asynchronous
async def test_unknown_scene_has_no_fields_and_an_unknown_field_is_refused(viewer: Path) -> None:
    _, topology = cube()
    async with fake_daemon() as daemon, serve(options(viewer, daemon.control)) as gateway:
        daemon.topologies["block"] = topology
        async with browse(gateway, "block") as page:
            await page.take(Stream.TOPOLOGY)
            await page.send(type="field", name="von_mises")
            await daemon.wait_subscribed("block", "frame")
            await daemon.publish("block", "frame", frame_of(topology, 1).SerializeToString())
            await page.take(Stream.FRAME)
            assert await page.nothing_pending()
            assert daemon.asked_fields == []
            await page.send(type="field", name="temperature")
            assert await page.closed() == (1008, "a field is one of von_mises, largest_strain, pressure, volume_ratio")


@pytest.mark.parametrize("name", ["cantilever", "two_organs"])
def test_rest_positions_are_those_of_a_daemon_before_the_first_step(server: tm.Server, name: str) -> None:
    with server.load(name, lockstep=True) as handle:
        assert handle.message is not None
        rest = rest_positions(handle.message, handle.topology())
        np.testing.assert_allclose(rest, handle.frame().positions, rtol=0, atol=1e-7)


def test_stress_of_a_bent_beam_is_largest_at_its_wall(server: tm.Server) -> None:
    with server.load("cantilever", lockstep=True) as handle:
        assert handle.message is not None
        topology = handle.topology()
        rest = rest_positions(handle.message, topology)
        handle.step(1)
        request = control_pb2.GetFieldsRequest(
            scene=handle.name, body="beam", fields=[control_pb2.FIELD_VON_MISES_STRESS]
        )
        reply = server.call("GetFields", request)
    values = SurfaceMap(handle.message, topology).values("von_mises", {"beam": reply})
    assert rest[np.argmax(values), 0] < 0.2 * rest[:, 0].max()
    assert values[rest[:, 0] > 0.95 * rest[:, 0].max()].max() < 0.2 * values.max()
