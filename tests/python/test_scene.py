"""Scene files and scenes from arrays: one to one on the protobuf message, and refused with the place named."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

import tensormass as tm
from tensormass import meshes
from tensormass.v1 import scene_pb2

NODES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
TETRAHEDRA = np.array([[0, 1, 2, 3]])

YAML = """
name: block
bodies:
  - name: tissue
    mesh: {grid: {origin_m: {x: 1}, size_m: {x: 1, y: 2, z: 3}, cells_x: 4, cells_y: 5, cells_z: 6}, scale: 0.5}
    law: {hooke: {young_modulus_pa: 1e6, poisson_ratio: .4}}
    density_kg_per_m3: 1000
    fixed:
      - nodes: {indices: [1, 2, 3]}
tools:
  - name: probe
    spherical_probe: {radius_m: 0.01}
solver: {precision: PRECISION_DOUBLE, cg_tolerance: 0}
streams: {frame_rate_hz: 0}
"""


def test_yaml_is_the_message_by_field_name() -> None:
    expected = scene_pb2.Scene(
        name="block",
        bodies=[
            scene_pb2.Body(
                name="tissue",
                mesh=scene_pb2.Mesh(
                    grid=scene_pb2.Grid(
                        origin_m=scene_pb2.Vector3(x=1),
                        size_m=scene_pb2.Vector3(x=1, y=2, z=3),
                        cells_x=4,
                        cells_y=5,
                        cells_z=6,
                    ),
                    scale=0.5,
                ),
                law=scene_pb2.Law(hooke=scene_pb2.IsotropicElastic(young_modulus_pa=1e6, poisson_ratio=0.4)),
                density_kg_per_m3=1000,
                fixed=[scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=[1, 2, 3]))],
            )
        ],
        tools=[scene_pb2.Tool(name="probe", spherical_probe=scene_pb2.SphericalProbe(radius_m=0.01))],
        # Zero that was written is not the same as nothing written.
        solver=scene_pb2.Solver(precision=scene_pb2.Solver.PRECISION_DOUBLE, cg_tolerance=0),
        streams=scene_pb2.Streams(frame_rate_hz=0),
    )
    assert tm.Scene.from_yaml(YAML).message == expected


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "    density_kg",
            "    densty_kg",
            r"bodies\[0\]: Body has no field 'densty_kg_per_m3'; did you mean 'density_k",
        ),
        ("density_kg_per_m3", "densityKgPerM3", "did you mean 'density_kg_per_m3'"),
        ("{x: 1, y: 2, z: 3}", "{x: 1, y: 2, w: 3}", r"bodies\[0\]\.mesh\.grid\.size_m: Vector3 has no field 'w'"),
        ("{x: 1, y: 2, z: 3}", "[1, 2, 3]", r"bodies\[0\]\.mesh\.grid\.size_m: expected a mapping of Vector3's fields"),
        ("{x: 1, y: 2, z: 3}", "", r"bodies\[0\]\.mesh\.grid\.size_m: has no value"),
        ("indices: [1, 2, 3]", "indices: 7", r"bodies\[0\]\.fixed\[0\]\.nodes\.indices: expected a list"),
        ("indices: [1, 2, 3]", "indices: [1, -2]", "indices"),
        ("name: block", "name: [block]", "name: expected one value"),
        ("name: block", "name: 7", "name"),
        ("name: block", "name: block\nname: other", "'name' stands twice"),
        ("PRECISION_DOUBLE", "PRECISION_HALF", "PRECISION_HALF"),
        ("hooke: {", "mooney: {", r"bodies\[0\]\.law: Law has no field 'mooney'; known: hooke, st_venant_kirchhoff"),
        ("cells_x: 4", "cells_x: 4.5", "cells_x"),
        ("cells_x: 4", "cells_x: many", "cells_x"),
        ("poisson_ratio: .4", "poisson_ratio: .nan", "poisson_ratio|hooke"),
        ("name: block", "name: !!python/object/apply:os.getcwd []", "not valid YAML"),
        ("name: block", "? [a]\n: b", "a field's name is a plain word"),
        ("name: block", "name: [", "not valid YAML"),
    ],
)
def test_a_mistake_in_yaml_is_refused_with_its_place(old: str, new: str, message: str) -> None:
    assert old in YAML
    with pytest.raises(tm.InvalidArgumentError, match=message) as error:
        tm.Scene.from_yaml(YAML.replace(old, new), where="block.yaml")
    assert str(error.value).startswith("block.yaml: ")


@pytest.mark.parametrize("text", ["", "- a\n- b", "just words", "7"])
def test_yaml_that_is_no_mapping_is_refused(text: str) -> None:
    with pytest.raises(tm.InvalidArgumentError, match="a scene is a mapping"):
        tm.Scene.from_yaml(text)


def test_mesh_and_skin_files_become_packed_arrays(tmp_path: Path) -> None:
    meshes.write_mesh(tmp_path / "body.vtu", meshes.TetrahedralMesh.from_arrays(NODES, TETRAHEDRA))
    triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    meshio.Mesh(NODES, [("triangle", np.array(triangles, np.int32))]).write(tmp_path / "skin.ply")
    scene_file = tmp_path / "scene.yaml"
    scene_file.write_text(
        "name: s\nbodies:\n- name: b\n  mesh: {file: body.vtu, scale: 0.01}\n  skin: {file: skin.ply}\n"
    )
    body = tm.Scene.from_file(scene_file).message.bodies[0]
    # The file's own coordinates: the daemon scales mesh and skin alike.
    assert body.mesh.scale == 0.01
    np.testing.assert_array_equal(np.frombuffer(body.mesh.packed.node_positions, "<f8").reshape(-1, 3), NODES)
    np.testing.assert_array_equal(np.frombuffer(body.mesh.packed.tetrahedra, "<u4").reshape(-1, 4), TETRAHEDRA)
    np.testing.assert_array_equal(np.frombuffer(body.skin.packed.vertex_positions, "<f8").reshape(-1, 3), NODES)
    np.testing.assert_array_equal(np.frombuffer(body.skin.packed.triangles, "<u4").reshape(-1, 3), triangles)


def test_a_missing_mesh_is_named_with_its_body(tmp_path: Path) -> None:
    scene_file = tmp_path / "scene.yaml"
    scene_file.write_text("name: s\nbodies:\n- name: b\n  mesh: {file: none.msh}\n")
    with pytest.raises(tm.NotFoundError, match=r"scene\.yaml: bodies\[0\]\.mesh\.file: .*none\.msh: no such file"):
        tm.Scene.from_file(scene_file)
    with pytest.raises(tm.NotFoundError, match="nor a built-in scene"):
        tm.Scene.from_file("no_such_scene")


@pytest.mark.parametrize("name", tm.builtin_scenes())
def test_builtin_scenes_are_found_by_name(name: str) -> None:
    scene = tm.Scene.from_file(name)
    assert scene.name == name
    assert len(scene.message.bodies) >= 1
    for body in scene.message.bodies:
        assert body.mesh.WhichOneof("source") in ("packed", "grid")


def test_a_mesh_file_is_a_scene_of_one_body(tmp_path: Path) -> None:
    path = tmp_path / "my organ.v2.vtu"
    meshes.write_mesh(path, meshes.TetrahedralMesh.from_arrays(NODES, TETRAHEDRA))
    scene = tm.Scene.from_file(path)
    assert scene.name == "my_organ_v2"
    assert len(scene.message.bodies[0].mesh.packed.tetrahedra) == 16


def test_a_scene_from_arrays_carries_everything_given() -> None:
    skin = meshes.TriangleSurface.from_arrays(NODES, [[0, 2, 1]])
    scene = tm.Scene.from_arrays(
        NODES.astype(np.float32),
        TETRAHEDRA.astype(np.int64),
        name="s",
        body="b",
        law="hooke",
        young_modulus_pa=1e4,
        poisson_ratio=0.3,
        density_kg_per_m3=900,
        fixed_nodes=NODES[:, 2] == 0,
        gravity_m_per_s2=(0, 0, -9.81),
        skin=skin,
    )
    scene.add_spherical_probe("probe", radius_m=0.01, position_m=(1, 2, 3), max_speed_m_per_s=0.2)
    message = scene.message
    body = message.bodies[0]
    assert (message.name, body.name, body.density_kg_per_m3) == ("s", "b", 900)
    assert body.law.hooke == scene_pb2.IsotropicElastic(young_modulus_pa=1e4, poisson_ratio=0.3)
    assert list(body.fixed[0].nodes.indices) == [0, 1, 2]
    assert message.gravity_m_per_s2 == scene_pb2.Vector3(z=-9.81)
    assert len(body.skin.packed.triangles) == 12
    assert message.tools[0].position_m == scene_pb2.Vector3(x=1, y=2, z=3)
    assert message.tools[0].max_speed_m_per_s == 0.2
    np.testing.assert_array_equal(np.frombuffer(body.mesh.packed.node_positions, "<f8").reshape(-1, 3), NODES)
    assert not tm.Scene.from_arrays(NODES, TETRAHEDRA).message.HasField("gravity_m_per_s2")


def test_a_scene_from_meshio_is_that_of_its_arrays() -> None:
    mesh = meshio.Mesh(NODES, [("triangle", [[0, 1, 2]]), ("tetra", TETRAHEDRA)])
    options = {"name": "s", "fixed_nodes": [0]}
    assert tm.Scene.from_meshio(mesh, **options).message == tm.Scene.from_arrays(NODES, TETRAHEDRA, **options).message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "rubber"}, "unknown law 'rubber'; known: hooke, st_venant_kirchhoff"),
        ({"fixed_nodes": [4]}, "index 4, but nodes run from 0 to 3"),
        ({"fixed_nodes": [-1]}, "index -1"),
        ({"fixed_nodes": [0.5]}, "expected node indices or a mask"),
        ({"fixed_nodes": [True, False]}, r"a mask needs shape \[4\]"),
        ({"gravity_m_per_s2": (0, 0, np.nan)}, "gravity_m_per_s2: expected three finite numbers"),
        ({"gravity_m_per_s2": (0, 0)}, "gravity_m_per_s2: expected three finite numbers"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(tm.InvalidArgumentError, match=message):
        tm.Scene.from_arrays(NODES, TETRAHEDRA, **options)  # type: ignore[arg-type]
