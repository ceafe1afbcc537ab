r"""Simplifies a surface to fewer triangles between some of its own vertices.

A vertex u that goes is collapsed along an edge onto a neighbour v: the triangles at u that have v vanish, and the
others take v in place of u. Each vertex that stays is a vertex of the whole surface, so the positions of a frame are
those of the whole frame at fewer vertices.

      a---b            a---b
     / \ / \          / `-. \        Collapses happen in rounds. The vertices of one round share no neighbour, so
    c---u---v   ->   c-----`-v       that no collapse sees what another one changes. A round tries the quarter of
     \ / \ /          \ .-' /        the vertices that costs least.
      d---e            d---e

The cost of u onto v is the squared distance of v from the planes around u, weighted by the areas of their triangles.
After that, v has the planes of both (M. Garland, P. Heckbert: Surface simplification using quadric error metrics,
SIGGRAPH 1997). A collapse must not turn a triangle over, and must leave each edge with two triangles (link condition).
Open edges stay as they are.

A simplification also keeps a point of its triangles for each vertex that went, near it in the shape that was
simplified. The distance between the two in a later frame says how far that frame is simplified.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LEAST_TRIANGLES = 16
"""A body keeps as many triangles, so that no small body vanishes."""

MIN_TURN_COSINE = 0.2
"""No collapse turns a triangle further than this, so that none is turned over."""

MIN_SHAPE = 0.05
"""Smallest area of a new triangle, in units of its longest edge squared: no slivers. A regular one has 0.43."""

LENGTH_WEIGHT = 1e-3
"""Part of the squared edge length in the cost. Where the surface is flat, it prefers short edges."""

MAX_ROUNDS = 400
"""Rounds after which a surface stays as it is, with more triangles than asked for. A hundredth takes about 100."""

MAX_WALKS = 8
"""Steps from a triangle to its neighbours in the search for the point near a vertex that went."""

CHEAP_SHARE = 0.25
"""Share of the vertices that a round tries. A smaller one takes more rounds and keeps closer to the surface."""


@dataclass(frozen=True)
class Simplification:
    """Which vertices and triangles of a surface stay. Indices are those of the whole surface."""

    triangles: Indices
    """[triangle_count, 3]"""
    gone: Indices
    """Vertices of the whole surface that no triangle has any more, [gone_count]."""
    corners: Indices
    """Corners of the triangle near each of them, [gone_count, 3]."""
    weights: Floats
    """The point of that triangle that is near it, [gone_count, 3]; each row sums to 1."""

    @property
    def vertices(self) -> Indices:
        """Vertices that stay, ascending."""
        return np.unique(self.triangles)


def simplify(positions: Floats, triangles: Indices, target: int) -> Simplification:
    """Simplifies a surface.

    Args:
        positions: [vertex_count, 3] m
        triangles: [triangle_count, 3]
        target: number of triangles that shall stay. More stay if no further collapse is possible.
    """
    assert triangles.min(initial=0) >= 0
    assert triangles.max(initial=-1) < len(positions)
    used = np.unique(triangles)
    into = np.arange(len(positions))
    if len(triangles) <= target:
        return _bound(positions, triangles, into, used)
    # Unit size, so that products of four lengths stay in the range of floats.
    low, high = positions[used].min(axis=0), positions[used].max(axis=0)
    places = (positions - low) / max(float((high - low).max()), float(np.finfo(float).tiny))
    quadrics, locked = _quadrics(places, triangles), _locked(triangles, len(positions))
    barred = locked.copy()
    for _ in range(MAX_ROUNDS):
        left = len(triangles) - target
        if left <= 0:
            break
        edges = _Edges(triangles, closed=not locked.any())
        gone, onto, failed = _round(places, quadrics, edges, barred)
        if len(gone) == 0 and len(failed) == 0:
            break
        # A collapse takes two triangles away.
        gone, onto = gone[: (left + 1) // 2], onto[: (left + 1) // 2]
        barred[failed] = True
        # What failed may succeed once its neighbourhood has changed.
        barred[edges.neighbours_of(gone)] = False
        barred |= locked
        quadrics[:, onto] += quadrics[:, gone]
        moved = np.arange(len(positions))
        moved[gone] = onto
        into = moved[into]
        triangles = moved[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
    return _bound(places, triangles, into, used)


class _Edges:
    """The directed edges of a surface, sorted by their start."""

    def __init__(self, triangles: Indices, *, closed: bool) -> None:
        a, b, c = triangles.T
        start = np.concatenate([a, b, c])
        order = np.argsort(start, kind="stable")
        self.start = start[order]
        self.end = np.concatenate([b, c, a])[order]
        self.third = np.concatenate([c, a, b])[order]
        """Corner of the edge's triangle across from it."""
        self.runs, self.vertices = _runs(self.start)
        # An open surface has some edges in one direction only, so its neighbours need the other one, too.
        if closed:
            self.pair_start, self.pair_end, self.pair_runs = self.start, self.end, self.runs
        else:
            both = np.concatenate([np.stack([self.start, self.end]), np.stack([self.end, self.start])], axis=1)
            self.pair_start, self.pair_end = np.unique(both, axis=1)
            self.pair_runs = _runs(self.pair_start)[0]

    def least_around(self, values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Returns the smallest value of each vertex and its neighbours."""
        least = values.copy()
        around = np.minimum.reduceat(values[self.pair_end], self.pair_runs)
        least[self.vertices] = np.minimum(least[self.vertices], around)
        return least

    def neighbours_of(self, vertices: Indices) -> Indices:
        chosen = np.zeros(int(self.vertices[-1]) + 1, bool)
        chosen[vertices] = True
        return self.pair_end[chosen[self.pair_start]]


def _runs(sorted_values: Indices) -> tuple[Indices, Indices]:
    """Returns where each run of equal values begins, and its value."""
    begins = np.flatnonzero(np.diff(sorted_values, prepend=-1))
    return begins, sorted_values[begins]


def _round(
    places: Floats, quadrics: Floats, edges: _Edges, barred: npt.NDArray[np.bool_]
) -> tuple[Indices, Indices, Indices]:
    """Returns vertices to collapse, onto which neighbours, and vertices that must stay for now."""
    # The cheapest edge of each vertex.
    costs = _costs(places, quadrics, edges)
    costs[barred[edges.start]] = np.inf
    least = np.minimum.reduceat(costs, edges.runs)
    counts = np.diff(edges.runs, append=len(costs))
    cheapest = np.flatnonzero(costs == np.repeat(least, counts))
    first, vertices = _runs(edges.start[cheapest])
    onto = np.full(len(places), -1)
    onto[vertices] = edges.end[cheapest[first]]
    candidates = np.flatnonzero(np.isfinite(least))
    if len(candidates) == 0:
        return candidates, candidates, candidates
    # Cheap vertices that win a draw within two edges share no neighbour. The draw is the same in each run. A draw by
    # cost has fewer winners, because costs rise evenly over wide parts of a surface.
    order = np.argsort(least[candidates], kind="stable")[: max(1, int(CHEAP_SHARE * len(candidates)))]
    cheap = edges.vertices[candidates[order]]
    draw = np.full(len(places), len(places))
    draw[cheap] = np.random.default_rng(len(edges.start)).permutation(len(cheap))
    winners = edges.least_around(edges.least_around(draw))
    chosen = cheap[winners[cheap] == draw[cheap]]
    fails = _turns(places, edges, chosen, onto) | ~_keeps_edges(edges, chosen, onto, len(places))
    return chosen[~fails], onto[chosen[~fails]], chosen[fails]


def _costs(places: Floats, quadrics: Floats, edges: _Edges) -> Floats:
    """Returns what it costs to collapse the start of each edge onto its end."""
    x, y, z = places.T
    one = np.ones_like(x)
    terms = (x * x, y * y, z * z, 2 * x * y, 2 * y * z, 2 * z * x, 2 * x, 2 * y, 2 * z, one)
    area = quadrics[10]
    total = LENGTH_WEIGHT * area[edges.start] * sum((axis[edges.end] - axis[edges.start]) ** 2 for axis in (x, y, z))
    for quadric, term in zip(quadrics, terms, strict=False):
        total += quadric[edges.start] * term[edges.end]
    return np.asarray(total)


def _quadrics(places: Floats, triangles: Indices) -> Floats:
    """Returns the quadrics of the vertices, [11, vertex_count]: squared distance from the planes around each, by area.

    The last row is the area.
    """
    corner = places[triangles[:, 0]]
    cross = np.cross(places[triangles[:, 1]] - corner, places[triangles[:, 2]] - corner)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    nx, ny, nz = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0).T
    d = -(nx * corner[:, 0] + ny * corner[:, 1] + nz * corner[:, 2])
    one = np.ones_like(d)
    planes = [nx * nx, ny * ny, nz * nz, nx * ny, ny * nz, nz * nx, nx * d, ny * d, nz * d, d * d, one]
    weighted = [plane * length[:, 0] / 2 for plane in planes]
    flat, count = triangles.ravel(), len(places)
    return np.stack([np.bincount(flat, np.repeat(values, 3), count) for values in weighted])


def _locked(triangles: Indices, vertex_count: int) -> npt.NDArray[np.bool_]:
    """Tells which vertices lie on an edge without exactly two triangles of opposite direction."""
    a, b, c = triangles.T
    start, end = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    forward, counts = np.unique(start * vertex_count + end, return_counts=True)
    single = forward[counts == 1]
    paired = np.isin(single, (single % vertex_count) * vertex_count + single // vertex_count)
    odd = np.concatenate([single[~paired], forward[counts > 1]])
    locked = np.zeros(vertex_count, bool)
    locked[odd // vertex_count] = True
    locked[odd % vertex_count] = True
    return locked


def _turns(places: Floats, edges: _Edges, chosen: Indices, onto: Indices) -> npt.NDArray[np.bool_]:
    """Tells which collapses turn a triangle too far, or make a sliver of it."""
    wanted = np.full(len(places), False)
    wanted[chosen] = True
    at = np.flatnonzero(wanted[edges.start])
    u, v, w = edges.start[at], edges.end[at], edges.third[at]
    target = onto[u]
    stays = (v != target) & (w != target)
    u, v, w, target = u[stays], v[stays], w[stays], target[stays]
    before = np.cross(places[v] - places[u], places[w] - places[u])
    first, second, third = places[v] - places[target], places[w] - places[target], places[w] - places[v]
    after = np.cross(first, second)
    areas = np.linalg.norm(after, axis=1)
    longest = np.max([(side**2).sum(axis=1) for side in (first, second, third)], axis=0)
    turned = (before * after).sum(axis=1) < MIN_TURN_COSINE * np.linalg.norm(before, axis=1) * areas
    bad = np.zeros(len(places), bool)
    bad[u[turned | (areas / 2 <= MIN_SHAPE * longest)]] = True
    return np.asarray(bad[chosen])


def _keeps_edges(edges: _Edges, chosen: Indices, onto: Indices, vertex_count: int) -> npt.NDArray[np.bool_]:
    """Tells for which collapses start and end of the edge have exactly two neighbours in common, and more of their own.

    Chosen vertices share no neighbour, so each vertex has at most one chosen neighbour.
    """
    owner, target_of = np.full(vertex_count, -1), np.full(vertex_count, -1)
    is_chosen = np.zeros(vertex_count, bool)
    is_chosen[chosen] = True
    near = is_chosen[edges.pair_start]
    owner[edges.pair_end[near]] = edges.pair_start[near]
    target_of[onto[chosen]] = chosen
    mover = target_of[edges.pair_start]
    common = (mover >= 0) & (owner[edges.pair_end] == mover)
    shared = np.bincount(mover[common], minlength=vertex_count)[chosen]
    # Two vertices with three neighbours each are half of a tetrahedron, which would become flat.
    counts = np.bincount(edges.pair_start, minlength=vertex_count)
    return np.asarray((shared == 2) & ((counts[chosen] > 3) | (counts[onto[chosen]] > 3)))


def _bound(positions: Floats, triangles: Indices, into: Indices, used: Indices) -> Simplification:
    """Finds a point of the triangles near each vertex that went.

    Args:
        into: the vertex into which each vertex has gone; itself if it stays.
        used: vertices of the whole surface that had a triangle.
    """
    stays = np.zeros(len(positions), bool)
    stays[triangles.ravel()] = True
    gone = used[~stays[used]]
    corners, weights = np.repeat(into[gone][:, None], 3, axis=1), np.zeros((len(gone), 3))
    weights[:, 0] = 1
    best = ((positions[gone] - positions[into[gone]]) ** 2).sum(axis=1)
    # The triangles around each vertex, one after the other.
    around = np.argsort(triangles.ravel(), kind="stable") // 3
    counts = np.bincount(triangles.ravel(), minlength=len(positions))
    begins = np.cumsum(counts) - counts
    active, starts = np.arange(len(gone)), into[gone][:, None]
    for _ in range(MAX_WALKS):
        before = best[active].copy()
        for start in starts.T:
            for k in range(int(counts[start].max(initial=0))):
                there = k < counts[start]
                rows = active[there]
                candidates = triangles[around[begins[start[there]] + k]]
                points = positions[gone[rows]]
                parts = _nearest(points, *(positions[candidates[:, i]] for i in range(3)))
                squares = ((points - np.einsum("ij,ijk->ik", parts, positions[candidates])) ** 2).sum(axis=1)
                better = squares < best[rows]
                rows = rows[better]
                best[rows], corners[rows], weights[rows] = squares[better], candidates[better], parts[better]
        # A point inside of its triangle is the nearest one. One on a side may have a nearer one across.
        walks = (best[active] < before) & (weights[active].min(axis=1) <= 0)
        active = active[walks]
        if len(active) == 0:
            break
        starts = corners[active]
    return Simplification(triangles, gone, corners, weights)


def _nearest(points: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    """Returns the weights of the corners at the point of a triangle nearest to each point, [point_count, 3]."""
    normal = np.cross(b - a, c - a)
    square = (normal**2).sum(axis=1)
    scale = np.divide(1, square, out=np.zeros_like(square), where=square > 0)
    inside = np.stack(
        [
            (np.cross(c - b, points - b) * normal).sum(axis=1) * scale,
            (np.cross(a - c, points - c) * normal).sum(axis=1) * scale,
            (np.cross(b - a, points - a) * normal).sum(axis=1) * scale,
        ],
        axis=1,
    )
    outside = (inside.min(axis=1) < 0) | (square <= 0)
    best, out = np.full(len(points), np.inf), inside
    for i, (start, end) in enumerate(((a, b), (b, c), (c, a))):
        side = end - start
        length = (side**2).sum(axis=1)
        along = ((points - start) * side).sum(axis=1)
        share = np.clip(np.divide(along, length, out=np.zeros_like(along), where=length > 0), 0, 1)
        squares = ((points - start - share[:, None] * side) ** 2).sum(axis=1)
        closer = outside & (squares < best)
        best[closer] = squares[closer]
        out[closer] = 0
        out[closer, i] = 1 - share[closer]
        out[closer, (i + 1) % 3] = share[closer]
    return out
