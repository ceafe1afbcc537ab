"""Forces, prescribed displacements and initial states of single nodes, from arrays.

The protocol gives a force or a displacement to a region. Nodes of the same value therefore share an entry, and every
other node gets one of its own. The daemon takes `limits::kMaxBoundaryConditions` = 65,536 entries of a kind.

A body with `element_order: quadratic` gets a node in the middle of each edge when it is loaded. A region of both ends
of an edge contains that node. It must not change what an array says. Such a body therefore shares no entries of forces,
and the middle of two prescribed nodes is prescribed to the mean of both.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from tensormass._shared.errors import InvalidArgumentError
from tensormass._shared.names import suggestion
from tensormass._src.meshes import FloatArray, node_indices
from tensormass._src.packing import middle_ends, own_node_count
from tensormass.v1 import scene_pb2

_AXES = "xyz"
Indices = npt.NDArray[np.integer]


def add_nodal_forces(
    body: scene_pb2.Body, forces_n: npt.ArrayLike, nodes: npt.ArrayLike | None, schedule: npt.ArrayLike | None
) -> None:
    """See Scene.add_nodal_forces."""
    factors = _optional_schedule(schedule, f"{body.name}.schedule")
    where = f"{body.name}.nodes"
    chosen = _chosen(body, nodes, where, repeated=True)
    forces = _rows(forces_n, len(chosen), 3, f"{body.name}.forces_n")
    total = np.zeros((own_node_count(body), 3))
    np.add.at(total, chosen, forces)
    loaded = np.flatnonzero(total.any(axis=1))
    shared = body.element_order != scene_pb2.ELEMENT_ORDER_QUADRATIC
    for group, force in _groups(loaded, total[loaded], shared):
        load = body.loads.add(schedule=factors)
        load.region.nodes.indices.extend(group.tolist())
        x, y, z = len(group) * force  # the daemon divides it equally
        load.force_n.CopyFrom(scene_pb2.Vector3(x=x, y=y, z=z))


def prescribe(
    body: scene_pb2.Body,
    displacement_m: npt.ArrayLike,
    nodes: npt.ArrayLike | str | None,
    axes: str,
    schedule: npt.ArrayLike | None,
) -> None:
    """See Scene.prescribe."""
    _check_axes(axes, f"{body.name}.axes")
    factors = _optional_schedule(schedule, f"{body.name}.schedule")
    where = f"{body.name}.displacement_m"
    rows = _numbers(displacement_m, where)
    if isinstance(nodes, str):
        if rows.shape != (len(axes),):
            raise InvalidArgumentError(
                f"{where}: expected shape [{len(axes)}], the same for all nodes of a set, got {list(rows.shape)}"
            )
        _check_finite(rows[None], where)
        _add_prescribed(body, _set_region(body, nodes, f"{body.name}.nodes"), axes, rows, factors)
        return
    chosen = _chosen(body, nodes, f"{body.name}.nodes")
    if rows.shape == (len(axes),):
        rows = np.broadcast_to(rows, (len(chosen), len(axes)))
    rows = _rows(rows, len(chosen), len(axes), where)
    if body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC:
        chosen, rows = _with_middles(body, chosen, rows)
    for group, row in _groups(chosen, rows, shared=True):
        region = scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=group.tolist()))
        _add_prescribed(body, region, axes, row, factors)


def fix(body: scene_pb2.Body, nodes: npt.ArrayLike | str, axes: str) -> None:
    """See Scene.fix."""
    _check_axes(axes, f"{body.name}.axes")
    where = f"{body.name}.nodes"
    if isinstance(nodes, str):
        region = _set_region(body, nodes, where)
    else:
        chosen = _chosen(body, nodes, where, repeated=True)
        region = scene_pb2.Region(nodes=scene_pb2.NodeSet(indices=chosen.tolist()))
    if set(axes) == set(_AXES):
        body.fixed.append(region)
    else:
        _add_prescribed(body, region, axes, np.zeros(len(axes)), None)


def set_initial_state(
    body: scene_pb2.Body, displacement_m: npt.ArrayLike | None, velocity_m_per_s: npt.ArrayLike | None
) -> None:
    """See Scene.set_initial_state."""
    # All arrays are checked before the first is set.
    given = {"displacement_m": displacement_m, "velocity_m_per_s": velocity_m_per_s}
    checked = {
        name: _rows(values, own_node_count(body), 3, f"{body.name}.{name}")
        for name, values in given.items()
        if values is not None
    }
    for name, rows in checked.items():
        setattr(body, f"initial_{name}", rows.astype("<f8").tobytes())


def schedule_message(schedule: npt.ArrayLike, where: str = "schedule") -> scene_pb2.Schedule:
    """Returns a schedule as a message, for loads that are messages: `body.loads.add(pressure_pa=300, schedule=...)`.

    Args:
        schedule: pairs (time [s], factor), [points, 2]; the factor is linear in between and constant outside.
        where: the name of the argument, for messages.

    Raises:
        InvalidArgumentError: not such pairs, or times that do not ascend.
    """
    rows = _numbers(schedule, where)
    if rows.ndim != 2 or rows.shape[1] != 2 or len(rows) == 0:
        raise InvalidArgumentError(
            f"{where}: expected pairs of time [s] and factor, shape [k, 2] with k > 0, got {list(rows.shape)}"
        )
    _check_finite(rows, where)
    late = np.flatnonzero(np.diff(rows[:, 0]) <= 0)
    if late.size:
        at = late[0]
        raise InvalidArgumentError(
            f"{where}: time {rows[at + 1, 0]:g} s of row {at + 1} does not come after {rows[at, 0]:g} s"
        )
    return scene_pb2.Schedule(time_s=rows[:, 0].tolist(), factor=rows[:, 1].tolist())


def _optional_schedule(schedule: npt.ArrayLike | None, where: str) -> scene_pb2.Schedule | None:
    return None if schedule is None else schedule_message(schedule, where)


def _chosen(body: scene_pb2.Body, nodes: npt.ArrayLike | None, where: str, *, repeated: bool = False) -> Indices:
    """Returns indices of nodes, [k]; all nodes for None. A node stands there twice only if `repeated` allows it."""
    count = own_node_count(body)
    if nodes is None:
        return np.arange(count)
    if isinstance(nodes, str):
        raise InvalidArgumentError(f"{where}: expected node indices or a mask, got the text {nodes!r}")
    chosen = node_indices(nodes, count, where)
    if len(chosen) == 0:
        raise InvalidArgumentError(f"{where}: has no nodes")
    values, counts = np.unique(chosen, return_counts=True)
    if not repeated and len(values) < len(chosen):
        raise InvalidArgumentError(f"{where}: node {values[counts > 1][0]} stands there twice; give it once")
    return chosen


def _rows(values: npt.ArrayLike, count: int, width: int, where: str) -> FloatArray:
    """Returns finite numbers [count, width]."""
    rows = _numbers(values, where)
    if rows.shape != (count, width):
        raise InvalidArgumentError(
            f"{where}: expected shape [{count}, {width}], a row for each node, got {list(rows.shape)}"
        )
    _check_finite(rows, where)
    return rows


def _numbers(values: npt.ArrayLike, where: str) -> FloatArray:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(f"{where}: not an array of numbers: {error}") from error


def _check_finite(rows: FloatArray, where: str) -> None:
    """Refuses rows [n, ...] that hold NaN or infinity."""
    bad = np.flatnonzero(~np.isfinite(rows.reshape(len(rows), -1)).all(axis=1))
    if bad.size:
        raise InvalidArgumentError(f"{where}: row {bad[0]} is not finite: {rows[bad[0]].tolist()}")


def _check_axes(axes: str, where: str) -> None:
    if not isinstance(axes, str) or not axes or len(set(axes)) < len(axes) or not set(axes) <= set(_AXES):
        raise InvalidArgumentError(f"{where}: expected some of 'x', 'y' and 'z', such as 'xz', got {axes!r}")


def _set_region(body: scene_pb2.Body, name: str, where: str) -> scene_pb2.Region:
    known = [named.name for named in body.sets]
    if name not in known:
        raise InvalidArgumentError(f"{where}: the body has no set {name!r}; {suggestion(name, known)}")
    return scene_pb2.Region(set=name)


def _add_prescribed(
    body: scene_pb2.Body, region: scene_pb2.Region, axes: str, row: FloatArray, schedule: scene_pb2.Schedule | None
) -> None:
    entry = body.prescribed.add(region=region, schedule=schedule)
    for axis, value in zip(axes, row.tolist(), strict=True):
        setattr(entry, f"{axis}_m", value)


def _groups(nodes: Indices, rows: FloatArray, shared: bool) -> Iterator[tuple[Indices, FloatArray]]:
    """Yields nodes [k] with their row. If `shared`, all nodes of equal rows come together."""
    if not shared:
        yield from zip(nodes[:, None], rows, strict=True)
        return
    values, value_of = np.unique(rows, axis=0, return_inverse=True)
    order = np.argsort(value_of.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(value_of.reshape(-1), minlength=len(values)))
    for group, value in zip(np.split(nodes[order], ends[:-1]), values, strict=True):
        if len(group):
            yield group, value


def _with_middles(body: scene_pb2.Body, nodes: Indices, rows: FloatArray) -> tuple[Indices, FloatArray]:
    """Adds the nodes that the daemon puts between two of `nodes`, with the mean of their rows."""
    count = own_node_count(body)
    ends = middle_ends(body)
    row_of = np.full(count, -1)
    row_of[nodes] = np.arange(len(nodes))
    both = np.flatnonzero((row_of[ends] >= 0).all(axis=1))
    means = 0.5 * (rows[row_of[ends[both, 0]]] + rows[row_of[ends[both, 1]]])
    return np.concatenate([nodes.astype(np.int64), count + both]), np.concatenate([rows, means])
