"""Boxes, planes and meshes as tools, and obstacles, from Python and from scene files."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from service_parts import block

import tensormass as tm
from tensormass._src import mesh_geometry, meshes
from tensormass_tools.hand import HandScript, script_of
from tensormass_tools.tool_sizes import movable_tools, radius_m


def tetrahedron(size_m: float) -> meshes.TriangleSurface:
    nodes = size_m * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return mesh_geometry.boundary_surface(meshes.VolumeMesh.from_tetrahedra(nodes, [[0, 1, 2, 3]]))


def test_solids_press_and_obstacles_stay(server: tm.Server) -> None:
    scene = block()
    above_m = (0.05, 0.05, 0.2)
    scene.add_tool("box", "box", position_m=above_m, size_x_m=0.02, size_y_m=0.02, size_z_m=0.02)
    scene.add_tool("mesh", "mesh", position_m=above_m, surface=tetrahedron(0.02))
    scene.add_tool("table", "plane", position_m=(0, 0, -0.2), fixed=True)
    assert [tool.name for tool in movable_tools(scene.message)] == ["probe", "box", "mesh"]
    with server.load(scene, name="solids", lockstep=True) as handle:
        for name, lower_m in (("box", 0.01), ("mesh", 0.0)):
            handle.move_tool(name, (0.05, 0.05, 0.045 + lower_m))
            handle.step(200)
            assert handle.feedback(name).force_n[2] > 0.01
            handle.move_tool(name, above_m)
            handle.step(200)
            assert handle.feedback(name).force_n == pytest.approx((0, 0, 0))
        with pytest.raises(tm.FailedPreconditionError, match=r"tool 'table': .* fixed"):
            handle.move_tool("table", (0, 0, 0))


def test_a_solid_has_half_its_thickness_as_radius() -> None:
    scene = block()
    box = scene.add_tool("box", "box", position_m=(0, 0, 0), size_x_m=0.02, size_y_m=0.006, size_z_m=0.3)
    mesh = scene.add_tool("mesh", "mesh", position_m=(0, 0, 0), surface=tetrahedron(3), scale=0.01)
    plane = scene.add_tool("plane", "plane", position_m=(0, 0, 0))
    assert radius_m(box) == pytest.approx(0.003)
    assert radius_m(mesh) == pytest.approx(0.015)
    with pytest.raises(tm.InvalidArgumentError, match="is a plane"):
        radius_m(plane)
    with pytest.raises(tm.InvalidArgumentError, match="expected a number, got a surface"):
        scene.add_tool("wrong", "box", position_m=(0, 0, 0), size_x_m=tetrahedron(1))


def test_a_scene_file_names_the_surface_of_a_tool(tmp_path: Path) -> None:
    surface = tetrahedron(2)
    meshio.Mesh(surface.vertices, [("triangle", surface.triangles.astype("int32"))]).write(tmp_path / "rake.ply")
    text = """
name: raked
bodies: [{name: tissue, mesh: {grid: {size_m: {x: 1, y: 1, z: 1}, cells_x: 1, cells_y: 1, cells_z: 1}},
          law: {hooke: {young_modulus_pa: 1000, poisson_ratio: 0.3}}, density_kg_per_m3: 1000}]
tools: [{name: rake, mesh: {surface: {file: rake.ply}, scale: 0.01}}]
"""
    (tmp_path / "raked.yaml").write_text(text)
    packed = tm.Scene.from_file(tmp_path / "raked.yaml").message.tools[0].mesh.surface.packed
    assert len(np.frombuffer(packed.triangles, "<u4")) == 12
    (tmp_path / "raked.yaml").write_text(text.replace("rake.ply", "missing.ply"))
    with pytest.raises(tm.NotFoundError, match=r"tools\[0\].mesh.surface.file"):
        tm.Scene.from_file(tmp_path / "raked.yaml")


def test_an_organ_lies_on_a_table_and_is_pushed(server: tm.Server) -> None:
    """The table carries its weight. Pushed, it slides, and stays where it was pushed to."""
    path = script_of("table")
    assert path is not None
    script = HandScript.read(path)
    with server.load("table", lockstep=True) as handle:
        assert handle.report is not None
        (body,) = handle.report.bodies
        weight_n = 9.81 * body.mass_kg
        handle.step(120)
        before_m = handle.positions("liver").mean(axis=0)
        handle.step(30)
        at_rest = handle.feedback("table")
        assert at_rest.force_n[2] == pytest.approx(-weight_n, rel=1e-3)
        np.testing.assert_allclose(handle.positions("liver").mean(axis=0), before_m, atol=1e-5)
        pushed_n = 0.0
        for step in range(60 * round(script.times_s[-1])):
            handle.move_tool(script.tool, *script.at(step / 60))
            handle.step()
            pushed_n = max(pushed_n, float(np.linalg.norm(handle.feedback(script.tool).force_n)))
        after_m = handle.positions("liver").mean(axis=0)
        handle.step(60)
        np.testing.assert_allclose(handle.positions("liver").mean(axis=0), after_m, atol=1e-4)
        assert pushed_n > 1
        assert after_m[1] - before_m[1] > 0.003
