"""Checks, geometry, quality and repair of meshes of every shape, grids, and volumes from surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tensormass._shared.components import components
from tensormass._shared.errors import InvalidArgumentError
from tensormass._src import grids, mesh_geometry, mesh_repair, meshes, tetwild
from tensormass._src.elevate import elevated
from tensormass._src.shapes import SHAPES

CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
CUBE_QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])


def regular_tetrahedron() -> meshes.VolumeMesh:
    corners = [[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]
    return meshes.VolumeMesh.from_tetrahedra(corners, [[0, 1, 2, 3]])


def mixed_mesh() -> meshes.VolumeMesh:
    """Along x: a hexahedron, a cell of six pyramids, one of two wedges, a pyramid on its end, and a tetrahedron on one
    of the pyramid's sides; 3.4 m³ of them."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)  # (y, z), counter-clockwise seen from +x
    layers = [np.column_stack([np.full(4, x), square]) for x in (0.0, 1.0, 2.0, 3.0)]
    nodes = np.concatenate([*layers, [[1.5, 0.5, 0.5]], [[3.8, 0.5, 0.5]], [[3.9, -0.4, 0.5]]])
    centre, apex, corner = 16, 17, 18
    a, b, c, d = (np.arange(4) + 4 * k for k in range(4))
    sides = [[b[i], b[(i + 1) % 4], c[(i + 1) % 4], c[i], centre] for i in range(4)]
    return meshes.VolumeMesh.from_arrays(
        nodes,
        [
            ("hexahedron", [[*a, *b]]),
            ("pyramid", [[*b, centre], [*c[::-1], centre], *[[s[3], s[2], s[1], s[0], s[4]] for s in sides]]),
            ("wedge", [[c[0], c[3], d[0], c[1], c[2], d[1]], [c[3], d[3], d[0], c[2], d[2], d[1]]]),
            ("pyramid", [[*d, apex]]),
            ("tetrahedron", [[d[3], d[0], apex, corner]]),
        ],
    )


def enclosed_volume(surface: meshes.TriangleSurface) -> float:
    """By the divergence theorem; negative if the triangles face inwards."""
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("nodes", "tetrahedra", "message"),
    [
        ([[0, 0, 0]] * 3, [[0, 1, 2, 3]], r"blocks\[0\]: row 0 is \[0, 1, 2, 3\], but indices run from 0 to 2"),
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
        meshes.VolumeMesh.from_tetrahedra(nodes, tetrahedra)  # type: ignore[arg-type]


def test_quality_of_the_regular_tetrahedron() -> None:
    quality = mesh_geometry.mesh_quality(regular_tetrahedron())
    assert quality.volume == pytest.approx(8 / 3)
    assert quality.mean_edge_length == pytest.approx(np.sqrt(8))
    np.testing.assert_allclose(mesh_geometry.dihedral_angles_deg(regular_tetrahedron()), np.degrees(np.arccos(1 / 3)))
    assert quality.inverted_count == 0


def test_boundary_is_closed_outward_and_compact() -> None:
    mesh = regular_tetrahedron()
    nodes = np.vstack([[[9, 9, 9]], mesh.nodes])
    unused = meshes.VolumeMesh.from_tetrahedra(nodes, mesh.elements("tetrahedron") + 1)
    surface = mesh_geometry.boundary_surface(unused)
    assert len(surface.vertices) == 4
    assert enclosed_volume(surface) == pytest.approx(8 / 3)


def test_repair_rewinds_drops_flat_and_keeps_the_largest_component() -> None:
    # A chain of tetrahedra, one of them inverted; a flat one on it; a smaller tetrahedron far off; an unused node.
    corners: list[list[float]] = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1, 1, 0]]
    far = [[9.0, 9, 9], [9.1, 9, 9], [9, 9.1, 9], [9, 9, 9.1]]
    tetrahedra = [[0, 1, 2, 3], [1, 3, 2, 4], [0, 1, 2, 5], [6, 7, 8, 9]]
    mesh = meshes.VolumeMesh.from_tetrahedra([*corners, *far, [5.0, 5, 5]], tetrahedra)
    assert mesh_geometry.mesh_quality(mesh).inverted_count == 2
    repaired = mesh_repair.repair_mesh(mesh)
    assert repaired.nodes.shape == (5, 3)
    np.testing.assert_allclose(mesh_geometry.signed_volumes(repaired), [1 / 6, 1 / 3])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_repair_keeps_the_most_volume_in_whatever_unit(scale: float) -> None:
    crumb = np.array([[5, 5, 5], [5.1, 5, 5], [5, 5.1, 5], [5, 5, 5.1], [5.1, 5.1, 5.1]])
    nodes = np.concatenate([[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], crumb])
    mesh = meshes.VolumeMesh.from_tetrahedra(scale * nodes, [[4, 5, 6, 7], [5, 7, 6, 8], [0, 1, 2, 3]])
    np.testing.assert_allclose(mesh_geometry.signed_volumes(mesh_repair.repair_mesh(mesh)), [scale**3 / 6])


def test_volume_under_a_warped_side_is_exact() -> None:
    box = grids.grid([1, 1, 1], [1.0, 1.0, 1.0], shape="hexahedron")
    nodes = box.nodes.copy()
    nodes[7] = [1, 1, 2]  # the top is at 1 + x y
    np.testing.assert_allclose(mesh_geometry.signed_volumes(replace(box, nodes=nodes)), [1.25])


def test_components_of_a_long_chain_are_one() -> None:
    chain = np.arange(2000)[:, None] + np.arange(4)[None, :]
    shuffled = np.random.default_rng(1).permutation(2003)[chain]
    assert len(np.unique(components(2003, [shuffled]))) == 1
    assert len(np.unique(components(2003, [np.delete(shuffled, range(999, 1002), axis=0)]))) == 2


def test_a_closed_surface_becomes_a_volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    triangles = np.concatenate([CUBE_QUADS[:, [0, 1, 2]], CUBE_QUADS[:, [0, 2, 3]]])
    volume = tetwild.tetrahedralize(meshes.TriangleSurface.from_arrays(CUBE, triangles), 0.25)
    quality = mesh_geometry.mesh_quality(volume)
    assert quality.volume == pytest.approx(1.0, rel=0.02)
    assert quality.inverted_count == 0
    assert quality.min_dihedral_angle_deg > 5
    assert 0.2 < quality.mean_edge_length < 0.55  # the mesher overshoots on flat sides; the cube's own edges are 1
    assert list(tmp_path.iterdir()) == []  # the mesher leaves files in its working directory


def test_an_edge_that_does_not_fit_the_surface_is_refused() -> None:
    surface = mesh_geometry.boundary_surface(regular_tetrahedron())
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    for edge in (0.0, -1.0, diagonal, 1000.0, np.nan):
        with pytest.raises(InvalidArgumentError, match="edge length"):
            tetwild.tetrahedralize(surface, edge)


# --- every shape ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
def test_a_grid_fills_its_box_and_its_boundary_is_closed(shape: str) -> None:
    mesh = grids.grid([2, 3, 1], [2.0, 6.0, 0.5], shape=shape, origin_m=[1.0, 0.0, -1.0])
    np.testing.assert_allclose(mesh.nodes.min(axis=0), [1, 0, -1])
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [3, 6, -0.5])
    assert len(np.unique(mesh.nodes, axis=0)) == len(mesh.nodes)
    assert np.array_equal(np.unique(mesh.blocks[0].nodes), np.arange(len(mesh.nodes)))
    quality = mesh_geometry.mesh_quality(mesh)
    assert quality.element_counts == {shape: mesh.element_count}
    assert quality.volume == pytest.approx(6.0)
    assert quality.inverted_count == 0
    surface = mesh_geometry.boundary_surface(mesh)
    assert enclosed_volume(surface) == pytest.approx(6.0)
    assert len(surface.triangles) == 2 * 2 * (2 * 3 + 3 * 1 + 2 * 1)


#: Ends of the edges whose middles follow the corners, as VTK lists them.
MIDDLES = {
    "quadratic_tetrahedron": ["01", "12", "02", "03", "13", "23"],
    "quadratic_hexahedron": ["01", "12", "23", "30", "45", "56", "67", "74", "04", "15", "26", "37"],
}


def assert_middles_are_in_the_middle(mesh: meshes.VolumeMesh, shape: str) -> None:
    at = mesh.nodes[mesh.elements(shape)]
    for middle, ends in enumerate(MIDDLES[shape], start=SHAPES[shape].corner_count):
        np.testing.assert_allclose(at[:, middle], (at[:, int(ends[0])] + at[:, int(ends[1])]) / 2)


@pytest.mark.parametrize("shape", MIDDLES)
def test_middle_nodes_of_quadratic_shapes_are_in_the_middle_of_their_edges(shape: str) -> None:
    assert_middles_are_in_the_middle(grids.grid([1, 2, 1], [1.0, 1.0, 1.0], shape=shape), shape)


def test_a_mesh_made_quadratic_has_a_node_in_the_middle_of_each_edge() -> None:
    grid = grids.grid([2, 1, 3], [2.0, 1.0, 3.0])
    turned = grid.elements("tetrahedron")[::-1, [1, 2, 0, 3]]
    linear = meshes.VolumeMesh.from_tetrahedra(grid.nodes, turned)
    mesh = elevated(linear)
    edges = sorted({(min(a, b), max(a, b)) for of in turned.tolist() for a in of for b in of if a != b})
    np.testing.assert_array_equal(mesh.nodes[: len(grid.nodes)], grid.nodes)
    np.testing.assert_array_equal(
        mesh.nodes[len(grid.nodes) :], [(grid.nodes[a] + grid.nodes[b]) / 2 for a, b in edges]
    )
    elements = mesh.elements("quadratic_tetrahedron")
    np.testing.assert_array_equal(elements[:, :4], turned)
    for middle, (a, b) in zip(range(4, 10), [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)], strict=True):
        pairs = np.sort(turned[:, [a, b]], axis=1).tolist()
        assert [len(grid.nodes) + edges.index((low, high)) for low, high in pairs] == elements[:, middle].tolist()


def test_a_linear_tetrahedron_made_quadratic_takes_the_middles_of_quadratic_ones() -> None:
    quadratic = elevated(
        meshes.VolumeMesh.from_tetrahedra([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    )
    nodes = np.concatenate([quadratic.nodes, [[0, -1, 0], [0, 0, -1]]])
    own = quadratic.elements("quadratic_tetrahedron")
    mixed = meshes.VolumeMesh.from_arrays(
        nodes, [("quadratic_tetrahedron", own), ("tetrahedron", [[1, 0, 11, 10]]), ("hexahedron", [range(8)])]
    )
    mesh = elevated(mixed)
    np.testing.assert_array_equal(mesh.blocks[0].nodes, own)
    np.testing.assert_array_equal(mesh.blocks[1].nodes, [[1, 0, 11, 10, 4, 13, 15, 14, 12, 16]])
    np.testing.assert_array_equal(mesh.blocks[2].nodes, [range(8)])
    assert len(mesh.nodes) == 17


def test_boundary_and_volume_of_a_mixed_mesh() -> None:
    mesh = mixed_mesh()
    surface = mesh_geometry.boundary_surface(mesh)
    assert (len(surface.vertices), len(surface.triangles)) == (18, 32)  # a sphere: 18 - 48 + 32 = 2
    assert enclosed_volume(surface) == pytest.approx(3.395)
    quality = mesh_geometry.mesh_quality(mesh)
    assert quality.volume == pytest.approx(3.395)
    assert quality.element_counts == {"hexahedron": 1, "pyramid": 7, "wedge": 2, "tetrahedron": 1}
    assert quality.min_dihedral_angle_deg == pytest.approx(45)
    assert quality.inverted_count == 0


def mirrored(mesh: meshes.VolumeMesh) -> meshes.VolumeMesh:
    """Mirrors a mesh, which inverts all of its elements."""
    return replace(mesh, nodes=mesh.nodes * [1, 1, -1])


@pytest.mark.parametrize("shape", SHAPES)
def test_repair_rewinds_every_shape(shape: str) -> None:
    grid = grids.grid([2, 1, 1], [2.0, 1.0, 1.0], shape=shape)
    inverted = mirrored(grid)
    assert mesh_geometry.mesh_quality(inverted).inverted_count == grid.element_count
    repaired = mesh_repair.repair_mesh(inverted)
    assert mesh_geometry.mesh_quality(repaired).inverted_count == 0
    assert mesh_geometry.mesh_quality(repaired).volume == pytest.approx(2.0)
    np.testing.assert_array_equal(repaired.nodes, inverted.nodes)
    if shape in MIDDLES:
        assert_middles_are_in_the_middle(repaired, shape)


def test_repair_takes_sets_and_fields_along() -> None:
    box = grids.grid([1, 1, 1], [1.0, 1.0, 1.0], shape="hexahedron")
    far = box.nodes[:4] * 0.1 + 5
    mesh = meshes.VolumeMesh.from_arrays(
        np.concatenate([[[9, 9, 9]], far, box.nodes]),
        [("tetrahedron", [[1, 2, 3, 4]]), ("tetrahedron", [[5, 6, 7, 9]]), ("hexahedron", box.blocks[0].nodes + 5)],
        sets={"a": [0, 1, 5, 12], "far": [1, 2]},
        element_fields={"young_modulus_pa": [1.0, 2.0, 3.0]},
    )
    repaired = mesh_repair.repair_mesh(mesh)
    assert {name: nodes.tolist() for name, nodes in repaired.sets.items()} == {"a": [0, 7]}
    assert repaired.element_fields["young_modulus_pa"].tolist() == [2.0, 3.0]


def test_a_corner_that_is_turned_in_is_counted() -> None:
    box = grids.grid([1, 1, 1], [1.0, 1.0, 1.0], shape="hexahedron")
    dented = box.nodes.copy()
    dented[7] = [0.2, 0.2, 0.2]  # beyond the middle, with most of the volume left
    mesh = replace(box, nodes=dented)
    assert mesh_geometry.signed_volumes(mesh)[0] > 0
    assert mesh_geometry.mesh_quality(mesh).inverted_count == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"blocks": [("hexaeder", [[0, 1, 2, 3]])]},
            r"blocks\[0\]: unknown shape 'hexaeder'; did you mean 'hexahedron'",
        ),
        ({"blocks": [("pyramid", [[0, 1, 2, 3]])]}, r"blocks\[0\]: expected shape \[n, 5\] with n > 0, got \[1, 4\]"),
        ({"blocks": []}, "has no elements"),
        ({"sets": {"wall": [4]}}, r"sets\['wall'\]: index 4, but nodes run from 0 to 3"),
        (
            {"element_fields": {"young_modulus": [1.0]}},
            "unknown field 'young_modulus'; did you mean 'young_modulus_pa'",
        ),
        ({"element_fields": {"poisson_ratio": [0.1, 0.2]}}, r"expected shape \[1\], one row an element, got \[2\]"),
        ({"element_fields": {"fibre_directions": [1.0]}}, r"expected shape \[1, 3\]"),
        ({"element_fields": {"poisson_ratio": [np.nan]}}, "row 0 is not finite"),
        ({"element_fields": {"fibre_directions": [[0, np.nan, 1]]}}, "row 0 is not finite"),
    ],
)
def test_arrays_that_are_not_a_volume_mesh_are_refused(options: dict[str, object], message: str) -> None:
    arguments = {"nodes": regular_tetrahedron().nodes, "blocks": [("tetrahedron", [[0, 1, 2, 3]])], **options}
    with pytest.raises(InvalidArgumentError, match=message):
        meshes.VolumeMesh.from_arrays(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("cells", "size", "shape"),
    [
        ([0, 1, 1], [1, 1, 1], "wedge"),
        ([1, 1], [1, 1, 1], "wedge"),
        ([1, 1, 1], [1, 0, 1], "wedge"),
        ([1] * 3, [1] * 3, "x"),
    ],
)
def test_an_invalid_grid_is_refused(cells: list[int], size: list[float], shape: str) -> None:
    with pytest.raises(InvalidArgumentError, match="grid: "):
        grids.grid(cells, size, shape=shape)
