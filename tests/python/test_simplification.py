"""Fewer triangles between some of a surface's own vertices."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from surfaces import ball, distance_to, plate

from tensormass_gateway.simplification import Simplification, simplify

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def edges_of(triangles: Indices) -> Indices:
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def is_closed(triangles: Indices) -> bool:
    """Whether each edge has exactly two triangles, of the same orientation."""
    edges = edges_of(triangles)
    there = {(int(a), int(b)) for a, b in edges}
    return len(there) == len(edges) and all((b, a) in there for a, b in there)


def volume(positions: Floats, triangles: Indices) -> float:
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def error_of(made: Simplification, positions: Floats) -> float:
    there = np.einsum("ij,ijk->ik", made.weights, positions[made.corners])
    return float(np.linalg.norm(positions[made.gone] - there, axis=1).max(initial=0))


@pytest.mark.parametrize("share", [0.75, 0.5, 0.25, 0.1, 0.02])
def test_a_ball_stays_a_closed_ball_of_its_own_vertices(share: float) -> None:
    positions, triangles = ball(5)
    target = round(share * len(triangles))
    made = simplify(positions, triangles, target)
    assert target - 2 <= len(made.triangles) <= target
    assert is_closed(made.triangles)
    # Euler: a sphere has 2 (vertices - 2) triangles.
    assert len(made.triangles) == 2 * (len(made.vertices) - 2)
    # No triangle is turned over.
    first, second, third = (positions[made.triangles[:, corner]] for corner in range(3))
    normals = np.cross(second - first, third - first)
    assert ((normals * positions[made.triangles].mean(axis=1)).sum(axis=1) > 0).all()
    assert volume(positions, made.triangles) > (0.9 if share < 0.1 else 0.98) * volume(positions, triangles)
    assert set(made.gone) | set(made.vertices) == set(range(len(positions)))
    assert not set(made.gone) & set(made.vertices)


def test_fewer_triangles_lie_further_off() -> None:
    positions, triangles = ball(5)
    errors = [error_of(simplify(positions, triangles, round(s * len(triangles))), positions) for s in (0.5, 0.1, 0.02)]
    assert errors[0] < errors[1] < errors[2] < 0.15
    # The triangles of a regular mesh with as many are (edge length)² / 6 off at their centres.
    edge_squared = 4 * np.pi / (0.1 * len(triangles)) * 4 / np.sqrt(3)
    assert errors[1] < 5 * edge_squared / 6


def test_the_kept_points_are_on_the_triangles_and_bound_the_distance_also_in_another_shape() -> None:
    positions, triangles = ball(3)
    made = simplify(positions, triangles, len(triangles) // 5)
    corners = {tuple(sorted(triangle)) for triangle in made.triangles.tolist()}
    assert all(tuple(sorted(each)) in corners or len(set(each)) == 1 for each in made.corners.tolist())
    assert made.weights.min() >= -1e-12
    assert np.allclose(made.weights.sum(axis=1), 1)
    bent = positions + 0.3 * np.sin(3 * positions[:, [1, 2, 0]])
    for shape in (positions, bent):
        exact = distance_to(shape[made.gone], shape, made.triangles)
        there = np.einsum("ij,ijk->ik", made.weights, shape[made.corners])
        bound = np.linalg.norm(shape[made.gone] - there, axis=1)
        assert (exact <= bound + 1e-12).all()
    # In the shape that was simplified the points are the nearest ones, or nearly so.
    exact = distance_to(positions[made.gone], positions, made.triangles)
    assert error_of(made, positions) < 1.5 * exact.max()


def test_a_flat_plate_loses_nothing_and_keeps_its_open_edge() -> None:
    positions, triangles = plate(20)
    made = simplify(positions, triangles, 150)
    assert 148 <= len(made.triangles) <= 150
    edge = np.flatnonzero((positions[:, :2] == 0).any(axis=1) | (positions[:, :2] == 1).any(axis=1))
    assert set(edge) <= set(made.vertices)
    assert error_of(made, positions) < 1e-12
    a, b, c = (positions[made.triangles[:, i]] for i in range(3))
    assert np.cross(b - a, c - a)[:, 2].min() > 0
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(1)


def test_an_open_edge_does_not_go_below_what_it_needs() -> None:
    positions, triangles = plate(10)
    made = simplify(positions, triangles, 4)
    # 40 vertices lie on the edge, and a polygon of as many corners has two triangles fewer.
    assert 38 <= len(made.triangles) < 60


def test_two_parts_of_a_body_stay_apart_and_none_vanishes() -> None:
    positions, triangles = ball(3)
    both = np.concatenate([positions, 0.1 * positions + [3, 0, 0]])
    made = simplify(both, np.concatenate([triangles, triangles + len(positions)]), 20)
    assert is_closed(made.triangles)
    parts = (made.triangles >= len(positions)).all(axis=1)
    assert ((made.triangles >= len(positions)).any(axis=1) == parts).all()
    assert parts.sum() >= 4
    assert (~parts).sum() >= 4


def test_a_tetrahedron_stays() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    assert simplify(positions, triangles, 1).triangles.tolist() == triangles.tolist()


def test_an_edge_with_three_triangles_stays() -> None:
    positions, triangles = ball(3)
    fin = np.array([[triangles[0, 0], triangles[0, 1], len(positions)]])
    finned = np.concatenate([positions, 2 * positions[triangles[0, :1]]])
    made = simplify(finned, np.concatenate([triangles, fin]), 100)
    assert {int(fin[0, 0]), int(fin[0, 1]), len(positions)} <= set(made.vertices)


@pytest.mark.parametrize(
    "positions", [np.zeros((66, 3)), np.ones((66, 3)), ball(2)[0] * [1, 1, 0], 1e-160 * ball(2)[0], 1e100 * ball(2)[0]]
)
def test_a_shape_without_an_extent_ends(positions: Floats) -> None:
    triangles = ball(2)[1]
    made = simplify(positions, triangles, 20)
    assert is_closed(made.triangles)
    assert np.isfinite(made.weights).all()


def test_no_triangles_and_a_target_that_is_reached_already() -> None:
    positions, triangles = ball(1)
    made = simplify(positions, triangles, len(triangles))
    assert made.triangles.tolist() == triangles.tolist()
    assert len(made.gone) == 0
    empty = simplify(np.empty((0, 3)), np.empty((0, 3), np.int64), 0)
    assert len(empty.vertices) == 0


def test_a_vertex_without_a_triangle_is_neither_kept_nor_missed() -> None:
    positions, triangles = ball(2)
    made = simplify(np.concatenate([positions, [[9.0, 9, 9]]]), triangles, 40)
    assert len(positions) not in made.vertices
    assert len(positions) not in made.gone
