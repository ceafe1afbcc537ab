"""Scene files and scenes from arrays: one to one on the protobuf message, and refused with the place named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import meshio
import numpy as np
import pytest
from test_meshes import mixed_mesh

import tensormass as tm
from tensormass._shared import defaults, units
from tensormass._shared.names import as_name
from tensormass._src import demo, mesh_files, meshes
from tensormass._src.packing import body_mesh, pack_mesh, unpack_mesh
from tensormass._src.scene_file import SceneFile
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
        (
            "density_kg_per_m3: 1000",
            "young_modulus_pa: 1000",
            r"bodies\[0\]: Body has no field 'young_modulus_pa'; did you mean 'law\.hooke\.young_modulus_pa'",
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
        (
            "PRECISION_DOUBLE",
            "PRECISION_HALF",
            "solver.precision: unknown value 'PRECISION_HALF'; known: float, double",
        ),
        ("PRECISION_DOUBLE", "doubel", "solver.precision: unknown value 'doubel'; did you mean 'double'"),
        ("PRECISION_DOUBLE", "2", "solver.precision: unknown value 2; known"),
        ("hooke: {", "mooney: {", r"bodies\[0\]\.law: Law has no field 'mooney'; did you mean 'mooney_rivlin'"),
        ("cells_x: 4", "cells_x: 4.5", "cells_x"),
        ("cells_x: 4", "cells_x: many", "cells_x"),
        ("poisson_ratio: .4", "poisson_ratio: .nan", r"poisson_ratio: expected a finite number, found nan$"),
        ("poisson_ratio: .4", "poisson_ratio: -.inf", r"poisson_ratio: expected a finite number, found -inf$"),
        ("name: block", "name: !!python/object/apply:os.getcwd []", "not valid YAML"),
        ("name: block", "? [a]\n: b", "a field's name is a plain word"),
        ("name: block", "name: [", "not valid YAML"),
        ("name: block", "name: 2001-99-99", "'2001-99-99' cannot be read as timestamp(?s:.*)line 2, column 7"),
        ("cells_x: 4", f"cells_x: {'9' * 5000}", r"'9{40}\.\.\.' cannot be read as int(?s:.*)line 5"),
        ("name: block", "name: !!bool maybe", "'maybe' cannot be read as bool"),
        ("name: block", "name: !!timestamp now", "'now' cannot be read as timestamp"),
        ("name: block", "name: !!int ''", "'' cannot be read as int"),
        ("name: block", "name: !!map x", "expected a mapping node, but found scalar"),
        ("name: block", "name: " + 5000 * "[", "not valid YAML: nested too deep"),
        ("name: block", "name: block\nx: " + 5000 * "[" + 5000 * "]", "not valid YAML: nested too deep"),
        ("scale: 0.5", f"scale: {'9' * 400}", r"bodies\[0\]\.mesh\.scale: expected a finite number, found one above 1"),
        ("scale: 0.5", f"scale: -0x{'f' * 5000}", r"mesh\.scale: expected a finite number, found one below -1"),
        ("scale: 0.5", "scale: yes", r"bodies\[0\]\.mesh\.scale: expected a number, found true$"),
        ("indices: [1, 2, 3]", "indices: [1, off]", r"nodes\.indices\[1\]: expected a number, found false$"),
        ("cells_x: 4", "cells_x: true", r"grid\.cells_x: expected a number, found true$"),
        ("name: block", "name: on", "name: expected text, found true; write it in quotes$"),
        ("poisson_ratio: .4", "poisson_ratio: half", r"law\.hooke\.poisson_ratio: expected a number, found 'half'$"),
        (
            "young_modulus_pa: 1e6",
            "young_modulus_pa: 3 kPa",
            r"_pa: expected a number in Pa, found '3 kPa'; write 3000$",
        ),
        ("young_modulus_pa: 1e6", "young_modulus_pa: 3 kN", r"_pa: expected a number in Pa, found '3 kN'$"),
        ("young_modulus_pa: 1e6", "young_modulus_pa: soft", r"_pa: expected a number in Pa, found 'soft'$"),
        ("cells_x: 4", "cells_x: 4.5", r"grid\.cells_x: expected a whole number, found 4\.5$"),
        ("cells_x: 4", "cells_x: -4", r"grid\.cells_x: expected a whole number of 0 to 4294967295, found -4$"),
        ("name: block", "name: block\nstepping: {lockstep: 1}", "stepping.lockstep: expected true or false, found 1$"),
        ("name: block", "name: block\ngravity_m_per_s2: {z: 1 g}", r"z: expected a number in m/s², found '1 g'$"),
        ("name: block", "name: [", r"not valid YAML: .*, in line \d+, column \d+$"),
        ("name: block", "name: \a", r"not valid YAML: character '.+' is not allowed, in line 2, column 7$"),
        ("PRECISION_DOUBLE", "yes", "solver.precision: unknown value true; known: float, double"),
    ],
)
def test_a_mistake_in_yaml_is_refused_with_its_place(old: str, new: str, message: str) -> None:
    assert old in YAML
    with pytest.raises(tm.InvalidArgumentError, match=message) as error:
        tm.Scene.from_yaml(YAML.replace(old, new), where="block.yaml")
    assert str(error.value).startswith("block.yaml: ")


def test_booleans_are_accepted_for_boolean_fields() -> None:
    assert tm.Scene.from_yaml(YAML + "stepping: {lockstep: yes}\n").message.stepping.lockstep


@pytest.mark.parametrize("text", ["", "- a\n- b", "just words", "7"])
def test_yaml_that_is_not_a_mapping_is_refused(text: str) -> None:
    with pytest.raises(tm.InvalidArgumentError, match="a scene is a mapping"):
        tm.Scene.from_yaml(text)


def test_mesh_and_skin_files_become_packed_arrays(tmp_path: Path) -> None:
    mesh_files.write_mesh(tmp_path / "body.vtu", meshes.VolumeMesh.from_tetrahedra(NODES, TETRAHEDRA))
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
    np.testing.assert_array_equal(np.frombuffer(body.mesh.packed.elements[0].nodes, "<u4").reshape(-1, 4), TETRAHEDRA)
    np.testing.assert_array_equal(np.frombuffer(body.skin.packed.vertex_positions, "<f8").reshape(-1, 3), NODES)
    np.testing.assert_array_equal(np.frombuffer(body.skin.packed.triangles, "<u4").reshape(-1, 3), triangles)


def textured_scene(folder: Path, skin: str = "skin.obj") -> Path:
    """A scene file of one body with a picture on its skin."""
    mesh_files.write_mesh(folder / "body.vtu", meshes.VolumeMesh.from_tetrahedra(NODES, TETRAHEDRA))
    (folder / "skin.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    (folder / "plain.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "tissue.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    scene = folder / "scene.yaml"
    scene.write_text(
        "name: s\nbodies:\n- name: b\n  mesh: {file: body.vtu}\n"
        f"  skin: {{file: {skin}}}\n  texture: {{file: tissue.png}}\n"
    )
    return scene


def test_a_picture_and_its_coordinates_come_from_files(tmp_path: Path) -> None:
    body = tm.Scene.from_file(textured_scene(tmp_path)).message.bodies[0]
    assert body.texture.image == (tmp_path / "tissue.png").read_bytes()
    np.testing.assert_array_equal(np.frombuffer(body.texture.coordinates, "<f4"), [0, 0, 1, 0, 0, 1])


def test_a_picture_needs_coordinates_and_a_file(tmp_path: Path) -> None:
    with pytest.raises(tm.InvalidArgumentError, match=r"^\S+scene\.yaml: bodies\[0\]\.texture: the skin has no"):
        tm.Scene.from_file(textured_scene(tmp_path, "plain.obj"))
    scene = textured_scene(tmp_path)
    (tmp_path / "tissue.png").unlink()
    with pytest.raises(tm.NotFoundError, match=r"bodies\[0\]\.texture\.file: .*tissue\.png: no such file"):
        tm.Scene.from_file(scene)


def test_a_body_takes_a_picture_as_bytes_or_file(tmp_path: Path) -> None:
    mesh = meshes.VolumeMesh.from_tetrahedra(NODES, TETRAHEDRA)
    skin = meshes.TriangleSurface.from_arrays(NODES, [[0, 2, 1]], texture_coordinates=[[[0, 0], [1, 0], [0, 1]]])
    (tmp_path / "tissue.png").write_bytes(b"png")
    for texture in (b"png", tmp_path / "tissue.png", str(tmp_path / "tissue.png")):
        scene = tm.Scene()
        body = scene.add_body("b", mesh, density_kg_per_m3=1000, skin=skin, texture=texture)
        assert body.texture.image == b"png"
        assert len(body.texture.coordinates) == 24
    with pytest.raises(tm.InvalidArgumentError, match=r"b\.texture: needs a skin"):
        tm.Scene().add_body("b", mesh, density_kg_per_m3=1000, texture=b"png")
    with pytest.raises(
        tm.InvalidArgumentError, match=r"texture_coordinates: expected finite numbers of shape \[1, 3, 2\]"
    ):
        meshes.TriangleSurface.from_arrays(NODES, [[0, 2, 1]], texture_coordinates=[[0, 0], [1, 0], [0, 1]])


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


def test_meshes_of_organs_are_made_once_and_again_when_their_source_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[list[str]] = []

    def make(folder: Path, organs: list[str]) -> None:
        made.append(organs)
        for organ in organs:
            for file in (f"{organ}.msh", f"{organ}_skin.ply"):
                (folder / file).write_text(str(len(made)))

    monkeypatch.setattr(demo, "_make_organs", make)
    monkeypatch.setattr(demo, "cache_folder", lambda: tmp_path / "scenes")

    def liver() -> str:
        found = demo.builtin_scene("demo")
        assert found is not None
        assert found[1] == tmp_path / "scenes"
        return (found[1] / "liver.msh").read_text()

    moved: list[str] = []
    replace = os.replace

    def move(source: Path, target: Path) -> None:
        moved.append(target.name)
        replace(source, target)

    monkeypatch.setattr(os, "replace", move)
    assert [liver(), liver()] == ["1", "1"]
    # The last one says that the others are there. Organs of other scenes are not made.
    assert moved == ["liver.msh", "liver_skin.ply", "liver_made_from.txt"]
    assert sorted(file.name for file in (tmp_path / "scenes").iterdir()) == sorted(moved)
    (tmp_path / "scenes" / "liver_made_from.txt").write_text("older sources")
    assert [liver(), liver()] == ["2", "2"]
    (tmp_path / "scenes" / "liver_skin.ply").unlink()
    assert liver() == "3"
    demo.builtin_scene("two_organs")
    assert made == [["liver"]] * 3 + [["kidney"]]
    assert demo.builtin_scene("none") is None


@pytest.mark.parametrize(
    ("stem", "name"), [("größe 1", "gr__e_1"), ("a-b_C", "a-b_C"), (100 * "a", 64 * "a"), ("²", "_"), ("", "")]
)
def test_names_are_converted_to_the_alphabet_of_scene_names(stem: str, name: str) -> None:
    assert as_name(stem) == name


def test_a_file_goes_before_a_builtin_scene_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("beam").write_text("name: mine\n")
    Path("other.YML").write_text("name: other\n")
    assert [tm.Scene.from_file(path).name for path in ("beam", "other.YML")] == ["mine", "other"]
    assert SceneFile.read("beam").builtin is None
    Path("beam").unlink()
    assert SceneFile.read("beam").builtin == "beam"


def test_a_grid_is_cut_where_its_message_puts_it() -> None:
    (body,) = tm.Scene.from_yaml(YAML).message.bodies
    nodes = body_mesh(body).nodes
    np.testing.assert_array_equal([nodes.min(axis=0), nodes.max(axis=0)], [[1, 0, 0], [2, 2, 3]])


def test_a_mesh_file_is_a_scene_of_one_body(tmp_path: Path) -> None:
    path = tmp_path / "my organ.v2.vtu"
    mesh_files.write_mesh(path, meshes.VolumeMesh.from_tetrahedra(NODES, TETRAHEDRA))
    scene = tm.Scene.from_file(path)
    assert scene.name == "my_organ_v2"
    assert len(scene.message.bodies[0].mesh.packed.elements[0].nodes) == 16


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
    cork = tm.Scene.from_arrays(NODES, TETRAHEDRA, law="hooke", poisson_ratio=0.0).message.bodies[0]
    assert cork.law.hooke.poisson_ratio == 0


def test_tools_of_any_kind_are_added_by_name() -> None:
    scene = tm.Scene()
    tool = scene.add_tool(
        "hook",
        "capsule",
        position_m=(0, 0, 1),
        orientation=(0, 1, 0, 0),
        radius_m=0.005,
        length_m=0.2,
        tip_offset_m=(0, 0, -0.1),
        joint_values=[0.5],
        mass_kg=0.1,
        coupling_stiffness_n_per_m=500,
        max_force_n=5,
        max_joint_load=0.2,
    )
    assert tool.joint_values == [0.5]
    assert (tool.max_force_n, tool.max_joint_load) == (5, 0.2)
    assert not tool.HasField("max_torque_n_m")
    assert (tool.mass_kg, tool.coupling_stiffness_n_per_m) == (0.1, 500)
    assert not tool.HasField("coupling_damping_n_s_per_m")
    assert tool.orientation == scene_pb2.Quaternion(x=1)
    assert tool.capsule == scene_pb2.Capsule(radius_m=0.005, length_m=0.2, tip_offset_m=scene_pb2.Vector3(z=-0.1))
    with pytest.raises(tm.InvalidArgumentError, match=r"hook: there is no kind 'capsul'.*capsule"):
        scene.add_tool("hook", "capsul", position_m=(0, 0, 1))
    with pytest.raises(tm.InvalidArgumentError, match=r"hook: capsule has no 'lenght_m'.*length_m"):
        scene.add_tool("hook", "capsule", position_m=(0, 0, 1), lenght_m=0.2)
    for wrong in ("0.2", None, (0, 0, 1)):
        with pytest.raises(tm.InvalidArgumentError, match=r"hook.length_m: expected a number, got"):
            scene.add_tool("hook", "capsule", position_m=(0, 0, 1), length_m=wrong)  # type: ignore[arg-type]
    with pytest.raises(tm.InvalidArgumentError, match=r"hook.tip_offset_m: expected three finite numbers, got 0.1"):
        scene.add_tool("hook", "capsule", position_m=(0, 0, 1), tip_offset_m=0.1)
    with pytest.raises(tm.InvalidArgumentError, match=r"hook.joint_values: expected finite numbers"):
        scene.add_tool("hook", "capsule", position_m=(0, 0, 1), joint_values=[float("nan")])
    assert len(scene.message.tools) == 1, "a tool that is refused is not added"


def test_a_budget_comes_with_its_floor() -> None:
    scene = tm.Scene("s")
    scene.keep_to_budget(0.004, floor_cg_iterations=12)
    assert scene.message.solver.budget_s == 0.004
    assert scene.message.solver.floor_cg_iterations == 12
    assert not scene.message.solver.HasField("floor_tolerance")
    scene.keep_to_budget(0.004, floor_tolerance=1e-2)
    assert scene.message.solver.floor_tolerance == 1e-2
    scene.keep_to_budget(0.004, floor_cg_iterations=0, floor_tolerance=0.0)
    assert (scene.message.solver.floor_cg_iterations, scene.message.solver.floor_tolerance) == (0, 0)


def test_a_scene_from_meshio_is_that_of_its_arrays() -> None:
    mesh = meshio.Mesh(NODES, [("triangle", [[0, 1, 2]]), ("tetra", TETRAHEDRA)])
    options = {"name": "s", "fixed_nodes": [0]}
    assert tm.Scene.from_meshio(mesh, **options).message == tm.Scene.from_arrays(NODES, TETRAHEDRA, **options).message


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"law": "rubber"}, "body.law: unknown law 'rubber'; known: hooke, st_venant_kirchhoff"),
        ({"law": "neohookean"}, "unknown law 'neohookean'; did you mean 'neo_hookean'"),
        ({"law": "ogden"}, "ogden needs mu_pa, alpha, bulk_modulus_pa"),
        ({"law": "ogden", "constants": {"mu": 1.0}}, "ogden has no constant 'mu'; did you mean 'mu_pa'"),
        ({"law": "ogden", "constants": {"mu_pa": 1.0}}, "ogden needs alpha, bulk_modulus_pa"),
        ({"law": "ogden", "young_modulus_pa": 4e3}, "no constant 'young_modulus_pa'; it is given by mu_pa, alpha"),
        ({"law": "hooke", "young_modulus_pa": np.nan}, r"hooke\.young_modulus_pa: expected a finite number, got nan"),
        ({"law": "hooke", "constants": {"young_modulus_pa": "1 MPa"}}, "expected a number, got '1 MPa'"),
        (
            {"law": "transversely_isotropic", "constants": {"fibre_modulus_pa": 1.0, "fibre_direction": 1.0}},
            "fibre_direction: expected three finite numbers",
        ),
        ({"element_order": "cubic"}, "body.element_order: unknown value 'cubic'; known: as_given, quadratic"),
        ({"quadrature": "gauss"}, "body.quadrature: unknown value 'gauss'; known: full, reduced, selective"),
        ({"mass": "lump"}, "body.mass: unknown value 'lump'; did you mean 'lumped'"),
        ({"fixed": "wall"}, "body.fixed: the mesh has no set 'wall'; known: none"),
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
        tm.Scene.from_arrays(NODES, TETRAHEDRA, **options)


# --- shapes, laws, sets and fields ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "read"),
    [
        ("solver: {precision: double}", lambda scene: scene.solver.precision),
        ("solver: {precision: PRECISION_DOUBLE}", lambda scene: scene.solver.precision),
        ("solver: {integrator: bdf2}", lambda scene: scene.solver.integrator),
        ("bodies: [{quadrature: reduced}]", lambda scene: scene.bodies[0].quadrature),
        ("bodies: [{mass: CONSISTENT}]", lambda scene: scene.bodies[0].mass),
        ("bodies: [{element_order: quadratic}]", lambda scene: scene.bodies[0].element_order),
        ("bodies: [{mesh: {packed: {elements: [{}, {shape: pyramid}]}}}]", lambda scene: second_shape(scene)),
    ],
)
def test_every_enum_has_short_names_in_yaml(line: str, read: Callable[[scene_pb2.Scene], int]) -> None:
    assert read(tm.Scene.from_yaml(f"name: s\n{line}").message) == 2


def second_shape(scene: scene_pb2.Scene) -> int:
    return scene.bodies[0].mesh.packed.elements[1].shape


def carrying_mesh() -> meshes.VolumeMesh:
    return meshes.VolumeMesh.from_arrays(
        NODES,
        [("tetrahedron", TETRAHEDRA)],
        sets={"wall": [0, 2, 3], "tip": [1]},
        element_fields={"poisson_ratio": [0.3], "fibre_directions": [[0, 0, 2.0]]},
    )


def test_a_body_has_the_shapes_sets_and_fields_of_its_mesh() -> None:
    scene = tm.Scene("s")
    scene.add_body("mixed", mixed_mesh(), density_kg_per_m3=1)
    body = scene.add_body("b", carrying_mesh(), density_kg_per_m3=1, fixed="wall", fixed_nodes=[1])
    packed = scene.message.bodies[0].mesh.packed
    names = [block.shape.name for block in mixed_mesh().blocks]
    assert [scene_pb2.Shape.Name(block.shape) for block in packed.elements] == [f"SHAPE_{n.upper()}" for n in names]
    back = unpack_mesh(packed)
    np.testing.assert_array_equal(back.nodes, mixed_mesh().nodes)
    for (_, left), (_, right) in zip(back.blocks, mixed_mesh().blocks, strict=True):
        np.testing.assert_array_equal(left, right)
    assert {of.name: list(of.regions[0].nodes.indices) for of in body.sets} == {"wall": [0, 2, 3], "tip": [1]}
    assert [region.WhichOneof("kind") for region in body.fixed] == ["set", "nodes"]
    assert body.fixed[0].set == "wall"
    np.testing.assert_array_equal(np.frombuffer(body.element_fields.poisson_ratio, "<f8"), [0.3])
    np.testing.assert_array_equal(np.frombuffer(body.element_fields.fibre_directions, "<f8"), [0, 0, 2])
    assert not body.element_fields.young_modulus_pa


def test_laws_have_their_constants_by_name() -> None:
    scene = tm.Scene("s")
    fibres: dict[str, float | tuple[float, ...]] = {"fibre_modulus_pa": 3.0, "fibre_direction": (0, 1, 0)}
    body = scene.add_body(
        "b",
        carrying_mesh(),
        law="transversely_isotropic",
        constants=fibres,
        young_modulus_pa=1.0,
        poisson_ratio=0.2,
        prony=[(0.25, 0.5), (0.3, 0.03)],
        density_kg_per_m3=1,
        quadrature="selective",
        mass="consistent",
        element_order="quadratic",
    )
    assert body.law == scene_pb2.Law(
        transversely_isotropic=scene_pb2.TransverselyIsotropic(
            young_modulus_pa=1, poisson_ratio=0.2, fibre_modulus_pa=3, fibre_direction=scene_pb2.Vector3(y=1)
        ),
        prony=[
            scene_pb2.PronyTerm(share=0.25, relaxation_time_s=0.5),
            scene_pb2.PronyTerm(share=0.3, relaxation_time_s=0.03),
        ],
    )
    assert body.quadrature == scene_pb2.QUADRATURE_SELECTIVE
    assert body.mass == scene_pb2.MASS_CONSISTENT
    assert body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC
    rubber = tm.law_message("mooney_rivlin", {"c10_pa": 3, "c01_pa": 0, "bulk_modulus_pa": 9})
    assert rubber == scene_pb2.Law(mooney_rivlin=scene_pb2.MooneyRivlin(c10_pa=3, bulk_modulus_pa=9))


def test_a_scene_file_uses_the_sets_of_its_mesh_file(tmp_path: Path) -> None:
    mesh_files.write_mesh(tmp_path / "body.vtu", carrying_mesh())
    text = """
        name: s
        bodies:
          - name: b
            mesh: {file: body.vtu}
            sets: [{name: both, regions: [{set: wall}, {set: tip}]}]
            fixed: [{set: both}]
    """
    body = tm.Scene.from_yaml(text, directory=tmp_path).message.bodies[0]
    assert [of.name for of in body.sets] == ["wall", "tip", "both"]  # one set is made of those before it
    assert len(body.element_fields.fibre_directions) == 24
    with pytest.raises(tm.InvalidArgumentError, match=r"bodies\[0\].*: the mesh has a set 'wall' already"):
        tm.Scene.from_yaml(text.replace("name: both", "name: wall"), directory=tmp_path)


def test_a_message_with_half_an_element_is_refused() -> None:
    packed = pack_mesh(carrying_mesh())
    packed.elements[0].nodes = packed.elements[0].nodes[:-1]
    with pytest.raises(tm.InvalidArgumentError, match=r"body\.elements\[0\]: an unknown shape, or not whole elements"):
        unpack_mesh(packed, "body")
    packed = pack_mesh(carrying_mesh())
    packed.node_positions = packed.node_positions[:-8]
    with pytest.raises(tm.InvalidArgumentError, match=r"body\.node_positions: not a whole number of nodes"):
        unpack_mesh(packed, "body")


def test_defaults_are_those_of_the_schema() -> None:
    scene = scene_pb2.Scene()
    solver = scene.solver
    assert defaults.dt_s(scene) == 1 / 60
    assert defaults.scheduled_s(scene) == 0
    assert (defaults.cg_max_iterations(solver), defaults.cg_tolerance(solver)) == (100, 1e-3)
    assert (defaults.newton_max_iterations(solver), defaults.newton_tolerance(solver)) == (1, 1e-3)
    solver.integrator, solver.precision = scene_pb2.Solver.INTEGRATOR_QUASI_STATIC, scene_pb2.Solver.PRECISION_DOUBLE
    assert (defaults.cg_max_iterations(solver), defaults.cg_tolerance(solver)) == (10_000, 1e-5)
    assert (defaults.newton_max_iterations(solver), defaults.newton_tolerance(solver)) == (200, 1e-6)
    for ends_s in (2.0, 7.0, 3.0):
        scene.bodies.add().prescribed.add().schedule.time_s.extend([0.0, ends_s])
    assert defaults.scheduled_s(scene) == 7.0
    scene.bodies[1].loads.add().schedule.time_s.extend([0.0, 8.0])
    assert defaults.scheduled_s(scene) == 8.0
    scene.gravity_schedule.time_s.extend([0.0, 9.0])
    assert defaults.scheduled_s(scene) == 9.0


@pytest.mark.parametrize(
    ("text", "unit", "si"),
    [
        ("5 kPa", "Pa", 5000.0),
        ("5e-1kPa", "Pa", 500.0),
        ("8 mm", "m", 0.008),
        ("2 ms", "s", 0.002),
        ("3 m", "m", 3.0),
        ("9.81 m/s²", "m/s²", None),
        ("5 psi", "Pa", None),
        ("5 kN", "Pa", None),
        ("1e999 Pa", "Pa", None),
        ("1.2.3 Pa", "Pa", None),
    ],
)
def test_a_quantity_is_a_number_in_the_unit_of_its_field(text: str, unit: str, si: float | None) -> None:
    found = units.in_si(text, unit)
    assert found == (None if si is None else pytest.approx(si))


def test_the_scene_in_the_readme_is_whole(tmp_path: Path) -> None:
    readme = (Path(__file__).resolve().parents[2] / "clients" / "python" / "README.md").read_text("utf-8")
    scene = tmp_path / "cube.yaml"
    scene.write_text(readme.split("```yaml\n")[1].split("```")[0], "utf-8")
    message = tm.Scene.from_file(scene).message
    assert [body.density_kg_per_m3 for body in message.bodies] == [1000]
    assert [tool.name for tool in message.tools] == ["probe"]
