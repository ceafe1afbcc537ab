"""Mesh files in and out: every shape, named sets and element fields, and surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from conftest import full_disk
from test_meshes import CUBE, CUBE_QUADS, enclosed_volume, mixed_mesh, regular_tetrahedron

from tensormass._shared.errors import InvalidArgumentError, NotFoundError
from tensormass._src import grids, mesh_files, mesh_geometry, meshes
from tensormass._src.shapes import SHAPES

pytestmark = pytest.mark.filterwarnings("ignore::tensormass.MeshFileWarning")
SHARED_MESHES = Path(__file__).resolve().parents[3] / "shared" / "meshes"

GMSH1 = """$NOD
5
10 0 0 0
20 1 0 0
30 0 1 0
40 0 0 1
50 1 1 1
$ENDNOD
$ELM
3
1 2 1 1 3 10 20 30
2 4 1 1 4 10 20 30 40
3 4 1 1 4 20 30 40 50
$ENDELM
"""


def shared_mesh(name: str) -> Path:
    path = SHARED_MESHES / name
    if not path.is_file():
        pytest.skip(f"../shared/meshes/{name} is not beside this checkout")
    return path


def gmsh1_file(folder: Path, text: str) -> Path:
    path = folder / "mesh.msh"
    path.write_text(text)
    return path


@pytest.mark.parametrize("flat", ["2 1 1 3 10 20 30", "3 1 1 4 10 20 30 40", "1 1 1 2 10 20", "15 1 1 1 10"])
def test_gmsh1_maps_node_numbers_and_skips_elements_without_volume(tmp_path: Path, flat: str) -> None:
    assert "\n1 2 1 1 3 10 20 30\n" in GMSH1
    mesh = mesh_files.read_mesh(gmsh1_file(tmp_path, GMSH1.replace("1 2 1 1 3 10 20 30", f"1 {flat}")))
    np.testing.assert_array_equal(mesh.nodes[3:], [[0, 0, 1], [1, 1, 1]])
    np.testing.assert_array_equal(mesh.elements("tetrahedron"), [[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("20 30 40 50", "20 30 40 60", r"mesh\.msh:13: element 3 uses node 60"),
        ("50 1 1 1", "40 1 1 1", r"mesh\.msh:7: node 40 is defined a second time"),
        ("50 1 1 1", "50 1 1", r"mesh\.msh:7: expected `id x y z`"),
        ("50 1 1 1", "50 1 1 1 1", r"mesh\.msh:7: expected `id x y z`"),
        ("50 1 1 1", "50 1 1 nan", r"nodes: row 4 is not finite"),
        ("3 4 1 1 4 20 30 40 50", "3 93 1 1 4 20 30 40 50", r"mesh\.msh:13: element 3 has Gmsh's type 93"),
        ("3 4 1 1 4 20 30 40 50", "3 4 1 1 5 20 30 40 50 10", r"mesh\.msh:13: element 3 .*; its type 4 has 4"),
        ("3 4 1 1 4 20", "3 4 1 1 5 20", r"mesh\.msh:13: element 3 announces 5 nodes and lists 4"),
        ("3 4 1 1 4 20 30 40 50", "3 4 x", r"mesh\.msh:13: .*expected a whole number, found 'x'"),
        ("$ELM\n3", "$ELM\n4", r"section \$ELM announces 4 rows"),
        ("$NOD\n5", "$NOD\n-1", r"section \$NOD announces -1 rows"),
        ("$ELM", "$ELEMENTS", r"mesh\.msh:9: section \$ELEMENTS has no \$EndELEMENTS"),
        ("$ELM", "$Comments", r"section \$Comments has no"),
    ],
)
def test_gmsh1_names_the_line_that_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GMSH1
    with pytest.raises(InvalidArgumentError, match=message):
        mesh_files.read_mesh(gmsh1_file(tmp_path, GMSH1.replace(old, new)))


def test_gmsh1_counts_no_rows_from_the_end(tmp_path: Path) -> None:
    elements_first = GMSH1[(at := GMSH1.index("$ELM")) :] + GMSH1[:at].replace("$NOD\n5", "$NOD\n-9")
    with pytest.raises(InvalidArgumentError, match=r"section \$NOD announces -9 rows"):
        mesh_files.read_mesh(gmsh1_file(tmp_path, elements_first))


def test_reads_the_shared_liver_in_gmsh1() -> None:
    mesh = mesh_files.read_mesh(shared_mesh("liver.msh"))
    assert mesh.nodes.shape == (181, 3)
    assert mesh.elements("tetrahedron").shape == (596, 4)
    assert mesh_geometry.mesh_quality(mesh).inverted_count == 0


@pytest.mark.parametrize("ending", ["msh", "vtk", "vtu"])
def test_written_meshes_are_read_back_exactly(tmp_path: Path, ending: str) -> None:
    mesh = regular_tetrahedron()
    path = tmp_path / f"mesh.{ending}"
    mesh_files.write_mesh(path, mesh)
    back = mesh_files.read_mesh(path)
    np.testing.assert_array_equal(back.nodes, mesh.nodes)
    np.testing.assert_array_equal(back.elements("tetrahedron"), mesh.elements("tetrahedron"))


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"use \.msh, \.vtk or \.vtu"):
        mesh_files.write_mesh(tmp_path / "mesh.xyz123", regular_tetrahedron())


def test_unreadable_files_are_refused_and_the_process_lives(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"none\.vtu: no such file"):
        mesh_files.read_mesh(tmp_path / "none.vtu")
    garbage = tmp_path / "garbage.msh"
    garbage.write_bytes(bytes(range(256)))
    with pytest.raises(InvalidArgumentError, match=r"garbage\.msh:1: expected a section"):
        mesh_files.read_mesh(garbage)


@pytest.mark.parametrize("share", [1.0, 0.9, 0.5])
@pytest.mark.parametrize("binary", [True, False])
def test_a_mesh_of_ansys_is_refused_whole_or_cut_off(tmp_path: Path, binary: bool, share: float) -> None:
    path = tmp_path / "fluent.MSH"
    grid = grids.grid([1, 1, 1], [1.0, 1.0, 1.0])
    mesh = meshio.Mesh(grid.nodes, [("tetra", grid.elements("tetrahedron").astype(np.int64))])
    meshio.write(path, mesh, file_format="ansys", binary=binary)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    for read in (mesh_files.read_mesh, mesh_files.read_surface):
        with pytest.raises(InvalidArgumentError, match=r"fluent\.MSH: a mesh of ANSYS .* is not read; save it as Gmsh"):
            read(path)


def test_gmsh_sections_before_the_mesh_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "mesh.msh"
    path.write_text("$Comments\n(made by hand)\n$EndComments\n" + MSH_22)
    assert mesh_files.read_mesh(path).element_count == 2


def test_a_full_disk_leaves_the_mesh_that_is_there(tmp_path: Path) -> None:
    path = tmp_path / "mesh.vtu"
    mesh_files.write_mesh(path, regular_tetrahedron())
    before = path.read_bytes()
    with full_disk(), pytest.raises(InvalidArgumentError, match=r"mesh\.vtu: cannot be written: File too large"):
        mesh_files.write_mesh(path, grids.grid([9, 9, 9], [1.0, 1.0, 1.0]))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_elements_of_shapes_that_are_not_simulated_are_refused() -> None:
    cube = meshio.Mesh(np.zeros((27, 3)), [("hexahedron27", [np.arange(27)]), ("tetra", [[0, 1, 2, 4]])])
    with pytest.raises(
        InvalidArgumentError, match="cell 0 is one of 1 elements of type hexahedron27; known are tetra, pyramid, wedge"
    ):
        mesh_files.from_meshio(cube)
    with pytest.raises(InvalidArgumentError, match="tensormass mesh --edge"):
        mesh_files.from_meshio(meshio.Mesh(CUBE, [("quad", CUBE_QUADS)]))


# --- shapes, sets, fields ---------------------------------------------------------------------------------------------


def assert_same(back: meshes.VolumeMesh, mesh: meshes.VolumeMesh) -> None:
    np.testing.assert_array_equal(back.nodes, mesh.nodes)
    assert [block.shape.name for block in back.blocks] == [block.shape.name for block in mesh.blocks]
    for (_, left), (_, right) in zip(back.blocks, mesh.blocks, strict=True):
        np.testing.assert_array_equal(left, right)
    np.testing.assert_equal(dict(back.sets), dict(mesh.sets))
    np.testing.assert_equal(dict(back.element_fields), dict(mesh.element_fields))


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh"])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_read_back_with_sets_and_fields(tmp_path: Path, shape: str, ending: str) -> None:
    grid = grids.grid([2, 1, 1], [2.0, 1.0, 1.0], shape=shape)
    count = grid.element_count
    mesh = replace(
        grid,
        sets={"wall": np.flatnonzero(grid.nodes[:, 0] == 0).astype(np.uint32), "tip": np.array([1], np.uint32)},
        element_fields={
            "young_modulus_pa": np.linspace(1e3, 2e3, count),
            "fibre_directions": np.arange(3.0 * count).reshape(-1, 3),
        },
    )
    mesh_files.write_mesh(tmp_path / f"mesh.{ending}", mesh)
    assert_same(mesh_files.read_mesh(tmp_path / f"mesh.{ending}"), mesh)


def test_a_mixed_mesh_keeps_its_blocks_in_their_order(tmp_path: Path) -> None:
    mesh_files.write_mesh(tmp_path / "mixed.vtu", mixed_mesh())
    assert_same(mesh_files.read_mesh(tmp_path / "mixed.vtu"), mixed_mesh())


MSH_22 = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
2 1 "left wall"
2 2 "unused"
3 1 "tissue"
$EndPhysicalNames
$Nodes
5
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
5 1 1 1
$EndNodes
$Elements
3
1 2 2 1 1 1 3 4
2 4 2 1 1 1 2 3 4
3 4 2 7 2 2 3 4 5
$EndElements
"""
MSH_41 = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
2
2 1 "left wall"
3 1 "tissue"
$EndPhysicalNames
$Entities
0 0 1 2
1 0 0 0 0 1 1 1 1 0
1 0 0 0 1 1 1 1 1 0
2 0 0 0 1 1 1 1 7 0
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1
2
3
4
5
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
$EndNodes
$Elements
3 3 1 3
2 1 2 1
1 1 3 4
3 1 4 1
2 1 2 3 4
3 2 4 1
3 2 3 4 5
$EndElements
"""


@pytest.mark.parametrize("text", [MSH_22, MSH_41], ids=["2.2", "4.1"])
def test_physical_groups_of_gmsh_are_sets_of_their_nodes(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mesh.msh"
    path.write_text(text)
    mesh = mesh_files.read_mesh(path)
    np.testing.assert_array_equal(mesh.elements("tetrahedron"), [[0, 1, 2, 3], [1, 2, 3, 4]])
    assert {name: nodes.tolist() for name, nodes in mesh.sets.items()} == {
        "left_wall": [0, 2, 3],
        "tissue": [0, 1, 2, 3],  # the second tetrahedron has the tag 7
    }


ABAQUS = """*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 0., 1., 0.
4, 0., 0., 1.
5, 1., 0., 1.
6, 0., 1., 1.
*ELEMENT, TYPE=C3D6, ELSET=all
1, 1, 2, 3, 4, 5, 6
*NSET, NSET=base
1, 2, 3
*ELSET, ELSET=prism
1
"""


def test_sets_of_an_abaqus_file_are_sets_of_nodes(tmp_path: Path) -> None:
    path = tmp_path / "mesh.inp"
    path.write_text(ABAQUS)
    mesh = mesh_files.read_mesh(path)
    np.testing.assert_array_equal(mesh.elements("wedge"), [[0, 1, 2, 3, 4, 5]])
    np.testing.assert_allclose(mesh_geometry.signed_volumes(mesh), [0.5])
    assert mesh.sets["base"].tolist() == [0, 1, 2]
    assert mesh.sets["prism"].tolist() == [0, 1, 2, 3, 4, 5]


def test_fields_are_those_of_the_volume_elements() -> None:
    mesh = meshio.Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        [("triangle", [[0, 1, 2]]), ("tetra", [[0, 1, 2, 3]])],
        cell_data={"poisson_ratio": [[np.nan], [0.3]], "fibre_direction": [[[0, 0, 0]], [[0, 0, 1]]], "x": [[1], [2]]},
    )
    read = mesh_files.from_meshio(mesh)
    assert {name: values.tolist() for name, values in read.element_fields.items()} == {
        "poisson_ratio": [0.3],
        "fibre_directions": [[0, 0, 1]],
    }


def test_gmsh_bookkeeping_does_not_become_a_set() -> None:
    cell_sets = {"gmsh:bounding_entities": [np.array([0])], "wall": [np.array([0])]}
    mesh = meshio.Mesh(CUBE, [("tetra", [[0, 1, 2, 4]])], cell_sets=cell_sets)
    assert {name: nodes.tolist() for name, nodes in mesh_files.from_meshio(mesh).sets.items()} == {"wall": [0, 1, 2, 4]}


@pytest.mark.parametrize("names", [("the wall", "the_wall"), ("the_wall", "the wall")])
def test_two_sets_of_one_name_are_refused(names: tuple[str, str]) -> None:
    mesh = meshio.Mesh(CUBE, [("tetra", [[0, 1, 2, 4]])], point_sets={names[0]: [0], names[1]: [1]})
    with pytest.raises(InvalidArgumentError, match="two of its sets are called 'the_wall'; rename one"):
        mesh_files.from_meshio(mesh, "mesh.inp")


# --- surfaces ---------------------------------------------------------------------------------------------------------


def test_surfaces_split_quads_and_merge_repeated_vertices(tmp_path: Path) -> None:
    quads = tmp_path / "cube.ply"
    meshio.Mesh(CUBE, [("quad", CUBE_QUADS.astype(np.int32))]).write(quads)
    surface = mesh_files.read_surface(quads)
    assert surface.triangles.shape == (12, 3)
    assert enclosed_volume(surface) == pytest.approx(1.0)

    soup = tmp_path / "cube.stl"
    corners = surface.vertices[surface.triangles].reshape(-1, 3)
    meshio.Mesh(corners, [("triangle", np.arange(36).reshape(-1, 3))]).write(soup)
    merged = mesh_files.read_surface(soup)
    assert merged.vertices.shape == (8, 3)
    assert enclosed_volume(merged) == pytest.approx(1.0)


#: Two triangles of a square. Vertex 2 lies on a seam: it has another place in the picture in each triangle.
WAVEFRONT = """v 0 0 0
v 1 0 0
v 0 1 0
v 1 1 0
vt 0 0
vt 1 0
vt 0 1
vt 1 1
vt 0.5 0.5
f 1/1 2/2 3/3
f 2/2 4/4 3/5
"""


def test_a_wavefront_file_keeps_the_seams_of_its_picture(tmp_path: Path) -> None:
    path = tmp_path / "skin.obj"
    path.write_text(WAVEFRONT)
    surface = mesh_files.read_surface(path)
    assert len(surface.vertices) == 4, "the seam adds no vertices"
    corners = surface.vertices[surface.triangles]
    np.testing.assert_array_equal(corners[:, :, :2], [[[0, 0], [1, 0], [0, 1]], [[1, 0], [1, 1], [0, 1]]])
    assert surface.texture_coordinates is not None
    places = [[[0, 0], [1, 0], [0, 1]], [[1, 0], [1, 1], [0.5, 0.5]]]
    np.testing.assert_array_equal(surface.texture_coordinates, places)


@pytest.mark.parametrize("line", ["f 1 2 4 3", "f 1//1 2//1 4//1 3//1"])
def test_a_wavefront_file_without_texture_coordinates_is_a_surface(tmp_path: Path, line: str) -> None:
    path = tmp_path / "skin.obj"
    lines = [row for row in WAVEFRONT.splitlines() if row[0] != "f"]
    path.write_text("\n".join([*lines, "vn 0 0 1", line, ""]))
    surface = mesh_files.read_surface(path)
    assert len(surface.vertices) == 4
    assert len(surface.triangles) == 2, "a quadrilateral is split"
    assert surface.texture_coordinates is None


@pytest.mark.parametrize("text", ["", "v 0 0 0\n", WAVEFRONT.replace("f 2/2 4/4", "f 2/2 9/4"), "\x00\x01"])
def test_a_spoiled_wavefront_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "skin.obj"
    path.write_text(text)
    with pytest.raises(InvalidArgumentError, match=r"skin\.obj:"):
        mesh_files.read_surface(path)
