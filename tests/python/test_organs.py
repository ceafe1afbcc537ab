"""Isosurface stuffing and the organs made with it."""

from __future__ import annotations

import numpy as np
import pytest

from tensormass._src import interface, isosurface, mesh_geometry, mesh_repair, meshes, organ
from tensormass._src.meshes import FloatArray

BOX = np.full(3, 1.2)


def ball(radius: float, center: FloatArray) -> isosurface.Implicit:
    return lambda points: radius - np.linalg.norm(points - center, axis=1)


def edge_counts(surface: meshes.TriangleSurface) -> tuple[int, set[int]]:
    edges = np.sort(surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return len(counts), set(counts.tolist())


@pytest.mark.parametrize("seed", range(6))
def test_a_ball_is_filled_without_slivers_gaps_or_overlap(seed: int) -> None:
    random = np.random.default_rng(seed)
    radius, center = random.uniform(0.4, 0.9), random.uniform(-0.1, 0.1, 3)
    inside = ball(radius, center)
    mesh = isosurface.fill(inside, -BOX, BOX, 0.15)
    quality = mesh_geometry.mesh_quality(mesh)
    assert quality.inverted_count == 0
    assert quality.min_dihedral_angle_deg > 16
    assert mesh_geometry.dihedral_angles_deg(mesh).max() < 155

    surface = mesh_geometry.boundary_surface(mesh)
    edge_count, uses = edge_counts(surface)
    assert uses == {2}
    assert len(surface.vertices) - edge_count + len(surface.triangles) == 2  # a sphere
    np.testing.assert_allclose(inside(surface.vertices), 0, atol=1e-7)
    # Positive elements whose boundary encloses their sum neither overlap nor leave holes.
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(quality.volume, rel=1e-9)
    assert quality.volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.06)


def test_the_filling_is_the_same_every_time() -> None:
    first, second = (isosurface.fill(ball(0.7, np.zeros(3)), -BOX, BOX, 0.2) for _ in range(2))
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.elements("tetrahedron"), second.elements("tetrahedron"))


def test_smoothing_widens_angles_and_stays_on_the_surface() -> None:
    inside = ball(0.8, np.zeros(3))
    rough = mesh_geometry.boundary_surface(isosurface.fill(inside, -BOX, BOX, 0.2))
    even = isosurface.smooth(rough, inside, step_m=1e-4)
    np.testing.assert_allclose(inside(even.vertices), 0, atol=1e-6)

    assert smallest_angle_deg(even) > smallest_angle_deg(rough) + 5


def smallest_angle_deg(surface: meshes.TriangleSurface) -> float:
    corner = surface.vertices[surface.triangles]
    sides = np.roll(corner, -1, axis=1) - corner
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    return float(np.degrees(np.arccos(-np.einsum("tij,tij->ti", sides, np.roll(sides, 1, axis=1)))).min())


@pytest.mark.parametrize("cell", [0.2, 0.11])
@pytest.mark.parametrize("seed", range(3))
def test_a_fitted_mesh_has_no_edge_across_the_interface(seed: int, cell: float) -> None:
    random = np.random.default_rng(seed)
    whole = isosurface.fill(ball(0.9, np.zeros(3)), -BOX, BOX, cell)
    normal = random.normal(size=3)
    within = ball(0.7, random.uniform(-0.5, 0.5, 3))

    def inside(points: FloatArray) -> FloatArray:
        return np.maximum(within(points), points @ normal / np.linalg.norm(normal) - 0.6)

    mesh = interface.fit(whole, inside, "part")
    selected = np.zeros(len(mesh.nodes), bool)
    selected[mesh.sets["part"]] = True
    value = inside(mesh.nodes)
    assert not (value[~selected] > 0).any()
    # Selected nodes beside others are on the interface, but for the few that could not move there.
    corners = mesh.elements("tetrahedron")
    border = np.unique(corners[~selected[corners].all(axis=1)])
    off = np.abs(value[border[selected[border]]])
    assert (off > 1e-6 * cell).mean() < 0.1
    assert off.max() < 0.3 * cell

    quality = mesh_geometry.mesh_quality(mesh)
    assert quality.inverted_count == 0
    assert quality.min_dihedral_angle_deg > 6
    # The body is still whole: no gaps, no overlap, the volume that it had up to nodes that slid along the boundary.
    surface = mesh_geometry.boundary_surface(mesh)
    assert edge_counts(surface)[1] == {2}
    a, b, c = (surface.vertices[surface.triangles[:, k]] for k in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) / 6 == pytest.approx(quality.volume, rel=1e-9)
    assert quality.volume == pytest.approx(mesh_geometry.mesh_quality(whole).volume, rel=0.01)


def test_an_interface_that_misses_the_mesh_changes_nothing() -> None:
    whole = isosurface.fill(ball(0.9, np.zeros(3)), -BOX, BOX, 0.2)
    mesh = interface.fit(whole, ball(0.5, np.full(3, 3.0)), "part")
    np.testing.assert_array_equal(mesh.nodes, whole.nodes)
    np.testing.assert_array_equal(mesh.elements("tetrahedron"), whole.elements("tetrahedron"))
    assert len(mesh.sets["part"]) == 0


@pytest.mark.parametrize(("name", "count"), [("liver", 21_000), ("kidney", 5_500)])
def test_organs_are_whole_and_without_slivers(name: str, count: int) -> None:
    shape = organ.ORGANS[name]
    volume = shape.volume(graded=False)
    quality = mesh_geometry.mesh_quality(volume)
    assert quality.element_counts["tetrahedron"] == pytest.approx(count, rel=0.1)
    assert quality.min_dihedral_angle_deg > 8
    assert quality.inverted_count == 0
    assert mesh_repair.repair_mesh(volume).element_count == volume.element_count  # one component
    # The box does not cut the organ.
    assert (volume.nodes > shape.lower_m).all()
    assert (volume.nodes < shape.upper_m).all()


@pytest.mark.parametrize("name", sorted(organ.ORGANS))
def test_skins_are_closed_fine_and_on_the_surface(name: str) -> None:
    shape = organ.ORGANS[name]
    skin = shape.skin()
    _, uses = edge_counts(skin)
    assert uses == {2}
    assert np.abs(shape.inside(skin.vertices)).max() < 1e-5
    assert len(skin.vertices) > 3 * len(mesh_geometry.boundary_surface(shape.volume(graded=False)).vertices)


def test_a_focus_makes_cells_smaller_where_it_is() -> None:
    shape = organ.ORGANS["liver"]
    assert shape.focus is not None
    volume = shape.volume(graded=True)
    quality = mesh_geometry.mesh_quality(volume)
    assert quality.element_counts["tetrahedron"] == pytest.approx(15_000, rel=0.1)
    assert quality.inverted_count == 0
    assert quality.min_dihedral_angle_deg > 8  # drawn together, cells lose some of their angles
    corners = volume.nodes[volume.elements("tetrahedron")]
    edges = np.linalg.norm(corners[:, 1:] - corners[:, :1], axis=2).max(axis=1)
    distance = np.linalg.norm(corners.mean(axis=1) - shape.focus.center_m, axis=1)
    near, far = np.median(edges[distance < 0.015]), np.median(edges[distance > 0.1])
    assert near < 0.6 * far
    # Lattice points come to where `before` says that they do.
    for wanted in (0.01, 0.1):
        at = shape.focus.center_m + np.array([shape.focus.before(wanted), 0, 0])
        placed = shape.focus.placed(at[None])[0]
        assert np.linalg.norm(placed - shape.focus.center_m) == pytest.approx(wanted)
