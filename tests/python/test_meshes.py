"""Mesh files in and out, checks, quality, repair, and volumes from surfaces."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest

from tensormass import meshes
from tensormass.errors import InvalidArgumentError, NotFoundError

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
CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
CUBE_QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


def shared_mesh(name: str) -> Path:
    path = SHARED_MESHES / name
    if not path.is_file():
        pytest.skip(f"../shared/meshes/{name} is not beside this checkout")
    return path


def regular_tetrahedron() -> meshes.TetrahedralMesh:
    corners = [[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]
    return meshes.TetrahedralMesh.from_arrays(corners, [[0, 1, 2, 3]])


def gmsh1_file(folder: Path, text: str) -> Path:
    path = folder / "mesh.msh"
    path.write_text(text)
    return path


def test_gmsh1_maps_node_numbers_and_passes_over_surface_elements(tmp_path: Path) -> None:
    mesh = meshes.read_mesh(gmsh1_file(tmp_path, GMSH1))
    np.testing.assert_array_equal(mesh.nodes[3:], [[0, 0, 1], [1, 1, 1]])
    np.testing.assert_array_equal(mesh.tetrahedra, [[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("20 30 40 50", "20 30 40 60", r"mesh\.msh:13: element 3 uses node 60"),
        ("50 1 1 1", "40 1 1 1", r"mesh\.msh:7: node 40 is defined a second time"),
        ("50 1 1 1", "50 1 1", r"mesh\.msh:7: expected `id x y z`"),
        ("50 1 1 1", "50 1 1 1 1", r"mesh\.msh:7: expected `id x y z`"),
        ("50 1 1 1", "50 1 1 nan", r"nodes: row 4 is not finite"),
        ("3 4 1 1 4 20 30 40 50", "3 5 1 1 8 10 20 30 40 50 10 20 30", r"mesh\.msh:13: element 3 has type 5"),
        ("3 4 1 1 4 20", "3 4 1 1 5 20", r"mesh\.msh:13: element 3 announces 5 nodes and lists 4"),
        ("3 4 1 1 4 20 30 40 50", "3 4 x", r"mesh\.msh:13: expected integers"),
        ("$ELM\n3", "$ELM\n4", r"section \$ELM announces 4 rows"),
        ("$NOD\n5", "$NOD\n-1", r"section \$NOD announces -1 rows"),
        ("$ELM", "$ELEMENTS", r"section \$ELM is missing"),
    ],
)
def test_gmsh1_names_the_line_that_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GMSH1
    with pytest.raises(InvalidArgumentError, match=message):
        meshes.read_mesh(gmsh1_file(tmp_path, GMSH1.replace(old, new)))


def test_reads_the_shared_liver_in_gmsh1() -> None:
    mesh = meshes.read_mesh(shared_mesh("liver.msh"))
    assert mesh.nodes.shape == (181, 3)
    assert mesh.tetrahedra.shape == (596, 4)
    assert meshes.quality(mesh).inverted_count == 0


@pytest.mark.parametrize("ending", ["msh", "vtk", "vtu"])
def test_what_is_written_is_read_back_exactly(tmp_path: Path, ending: str) -> None:
    mesh = regular_tetrahedron()
    path = tmp_path / f"mesh.{ending}"
    meshes.write_mesh(path, mesh)
    back = meshes.read_mesh(path)
    np.testing.assert_array_equal(back.nodes, mesh.nodes)
    np.testing.assert_array_equal(back.tetrahedra, mesh.tetrahedra)


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidArgumentError, match=r"use \.msh, \.vtk or \.vtu"):
        meshes.write_mesh(tmp_path / "mesh.xyz123", regular_tetrahedron())


def test_unreadable_files_are_refused_and_the_process_lives(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match=r"none\.vtu: no such file"):
        meshes.read_mesh(tmp_path / "none.vtu")
    garbage = tmp_path / "garbage.msh"
    garbage.write_bytes(bytes(range(256)))
    with pytest.raises(InvalidArgumentError, match=r"garbage\.msh: not readable as a mesh"):
        meshes.read_mesh(garbage)


def test_elements_with_volume_that_are_no_tetrahedra_are_refused() -> None:
    cube = meshio.Mesh(CUBE, [("hexahedron", [[0, 1, 3, 2, 4, 5, 7, 6]]), ("tetra", [[0, 1, 2, 4]])])
    with pytest.raises(InvalidArgumentError, match="elements of type hexahedron"):
        meshes.from_meshio(cube)
    with pytest.raises(InvalidArgumentError, match="tensormass mesh --edge"):
        meshes.from_meshio(meshio.Mesh(CUBE, [("quad", CUBE_QUADS)]))


def test_surfaces_split_quads_and_merge_repeated_vertices(tmp_path: Path) -> None:
    quads = tmp_path / "cube.ply"
    meshio.Mesh(CUBE, [("quad", CUBE_QUADS.astype(np.int32))]).write(quads)
    surface = meshes.read_surface(quads)
    assert surface.triangles.shape == (12, 3)
    assert enclosed_volume(surface) == pytest.approx(1.0)

    soup = tmp_path / "cube.stl"
    corners = surface.vertices[surface.triangles].reshape(-1, 3)
    meshio.Mesh(corners, [("triangle", np.arange(36).reshape(-1, 3))]).write(soup)
    merged = meshes.read_surface(soup)
    assert merged.vertices.shape == (8, 3)
    assert enclosed_volume(merged) == pytest.approx(1.0)


def enclosed_volume(surface: meshes.TriangleSurface) -> float:
    """By the divergence theorem; negative if the triangles face inwards."""
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "message"),
    [
        ([[0, 0, 0]] * 3, [[0, 1, 2, 3]], r"tetrahedra: row 0 is \[0, 1, 2, 3\], but indices run from 0 to 2"),
        ([[0, 0, 0]] * 4, [[0, 1, 2, -1]], "indices run from 0 to 3"),
        ([[0, 0, 0]] * 4, [[0.0, 1, 2, 3]], "expected integers"),
        ([[0, 0, 0]] * 4, [[0, 1, 2]], r"expected shape \[n, 4\]"),
        ([[0, 0, 0]] * 4, np.empty((0, 4), int), "with n > 0"),
        ([[0, 0]] * 4, [[0, 1, 2, 3]], r"nodes: expected shape \[n, 3\]"),
        ([[0, 0, np.inf]] * 4, [[0, 1, 2, 3]], "row 0 is not finite"),
        ([["a", "b", "c"]] * 4, [[0, 1, 2, 3]], "not an array of numbers"),
    ],
)
def test_arrays_that_make_no_mesh_are_refused(nodes: object, tetrahedra: object, message: str) -> None:
    with pytest.raises(InvalidArgumentError, match=message):
        meshes.TetrahedralMesh.from_arrays(nodes, tetrahedra)  # type: ignore[arg-type]


def test_quality_of_the_regular_tetrahedron() -> None:
    quality = meshes.quality(regular_tetrahedron())
    assert quality.volume == pytest.approx(8 / 3)
    assert quality.mean_edge_length == pytest.approx(np.sqrt(8))
    np.testing.assert_allclose(meshes.dihedral_angles_deg(regular_tetrahedron()), np.degrees(np.arccos(1 / 3)))
    assert quality.inverted_count == 0


def test_boundary_is_closed_outward_and_compact() -> None:
    mesh = regular_tetrahedron()
    unused = meshes.TetrahedralMesh(np.vstack([[[9, 9, 9]], mesh.nodes]), mesh.tetrahedra + np.uint32(1))
    surface = meshes.boundary(unused)
    assert len(surface.vertices) == 4
    assert enclosed_volume(surface) == pytest.approx(8 / 3)


def test_repair_rewinds_drops_flat_and_keeps_the_largest_component() -> None:
    # A chain of tetrahedra, one of them inverted; a flat one on it; a smaller tetrahedron far off; an unused node.
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, 0]]
    far = [[9, 9, 9], [9.1, 9, 9], [9, 9.1, 9], [9, 9, 9.1]]
    tetrahedra = [[0, 1, 2, 3], [1, 3, 2, 4], [0, 1, 2, 5], [6, 7, 8, 9]]
    mesh = meshes.TetrahedralMesh.from_arrays(corners + far + [[5, 5, 5]], tetrahedra)
    assert meshes.quality(mesh).inverted_count == 2
    repaired = meshes.repair(mesh)
    assert repaired.nodes.shape == (5, 3)
    np.testing.assert_allclose(meshes.signed_volumes(repaired), [1 / 6, 1 / 3])


def test_components_of_a_long_chain_are_one() -> None:
    chain = np.arange(2000)[:, None] + np.arange(4)[None, :]
    shuffled = np.random.default_rng(1).permutation(2003)[chain]
    assert len(np.unique(meshes._components(2003, shuffled))) == 1
    assert len(np.unique(meshes._components(2003, np.delete(shuffled, range(999, 1002), axis=0)))) == 2


def test_a_closed_surface_becomes_a_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    triangles = np.concatenate([CUBE_QUADS[:, [0, 1, 2]], CUBE_QUADS[:, [0, 2, 3]]])
    volume = meshes.tetrahedralize(meshes.TriangleSurface.from_arrays(CUBE, triangles), 0.25)
    quality = meshes.quality(volume)
    assert quality.volume == pytest.approx(1.0, rel=0.02)
    assert quality.inverted_count == 0
    assert quality.min_dihedral_angle_deg > 5
    assert 0.2 < quality.mean_edge_length < 0.55  # the mesher overshoots on flat sides; the cube's own edges are 1
    assert list(tmp_path.iterdir()) == []  # the mesher leaves files in its working directory


def test_an_edge_that_does_not_fit_the_surface_is_refused() -> None:
    surface = meshes.boundary(regular_tetrahedron())
    for edge in (0.0, -1.0, 1000.0, np.nan):
        with pytest.raises(InvalidArgumentError, match="edge length"):
            meshes.tetrahedralize(surface, edge)
