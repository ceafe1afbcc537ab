"""Bodies made quadratic, in the SDK and in a real daemon. Without build/bin/tensormassd these are skipped."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import tensormass as tm
from tensormass._shared import processes
from tensormass._src import meshes
from tensormass._src.packing import body_mesh
from tensormass.v1 import scene_pb2
from tensormass_tools.output import report_text

try:
    processes.find_program("tensormassd", "TENSORMASSD")
except tm.NotFoundError as not_built:
    pytest.skip(str(not_built), allow_module_level=True)


@pytest.fixture(scope="module")
def server() -> Iterator[tm.Server]:
    with tm.launch(backend="cpu", cpu_threads=1) as running:
        yield running


def scene_of(**options: object) -> tm.Scene:
    grid = tm.grid([3, 2, 2], [0.3, 0.2, 0.2])
    turned = grid.elements("tetrahedron")[::-1, [1, 2, 0, 3]]
    scene = tm.Scene.from_arrays(grid.nodes, turned, element_order="quadratic", fixed_nodes=[0, 1, 2, 3], **options)
    scene.message.bodies[0].mesh.scale = 0.5
    return scene


def test_the_daemon_numbers_the_nodes_as_the_sdk_does(server: tm.Server) -> None:
    scene = scene_of()
    handle = server.load(scene, lockstep=True)
    np.testing.assert_array_equal(handle.positions("body"), 0.5 * body_mesh(scene.message.bodies[0]).nodes)
    assert len(handle.positions("body")) == 7 * 5 * 5
    assert len(handle.fields("body", ["von_mises_stress"])["von_mises_stress"]) == 3 * 2 * 2 * 6
    assert handle.report is not None
    text = report_text(handle.report, scene.message)
    assert "made quadratic, with a node in the middle of each edge: 'body'" in text
    assert "made quadratic" not in report_text(handle.report, scene_pb2.Scene())
    handle.unload()


def test_the_boundary_follows_a_skin(server: tm.Server) -> None:
    """The skin is a roof over one row of the top's cells. Their diagonals lie under its ridge, 5 mm below."""
    roof_of = [[x, y, 0.2 if y != 0.05 else 0.205] for y in (0.0, 0.05, 0.1) for x in (-0.1, 0.4)]
    roof = meshes.TriangleSurface.from_arrays(roof_of, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
    scene = scene_of(skin=roof)
    handle = server.load(scene, lockstep=True)
    moved = handle.positions("body") - 0.5 * body_mesh(scene.message.bodies[0]).nodes
    handle.unload()
    raised = np.flatnonzero(np.linalg.norm(moved, axis=1) > 1e-4)
    assert len(raised) > 0
    assert (raised >= 4 * 3 * 3).all()  # nodes of the mesh stay
    highest = moved[moved[:, 2].argmax()]
    np.testing.assert_allclose(highest, [0, 0, 0.5 * 0.005 / (1 + 0.1**2)], atol=1e-9)
