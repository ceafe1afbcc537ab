"""What objects show of themselves in a notebook: short tables in SI units.

Classes of the SDK make theirs in `_repr_html_`, which notebooks call, with `table` and `quantity`. The protocol's
messages get theirs from `show_messages`, because their classes are generated. Every text is escaped, because names come
from files and other clients.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

from google.protobuf.message import Message

from tensormass._shared.status_text import recoveries_text
from tensormass._shared.units import unit_of
from tensormass._src.durations import DurationHistogram
from tensormass._src.shapes import BY_NUMBER, Shape
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2

#: A longer table ends with the number of rows that it leaves out.
MAX_ROWS = 20

Rows = Sequence[Sequence[str]]


def table(title: str, rows: Rows, heading: Sequence[str] = ()) -> str:
    """Returns a table as HTML. Escapes every cell."""
    shown = [_row("th", heading)] if heading else []
    shown += [_row("td", row) for row in rows[:MAX_ROWS]]
    if len(rows) > MAX_ROWS:
        shown.append(_row("td", [f"... and {len(rows) - MAX_ROWS} more"]))
    return f"<table><caption>{html.escape(title)}</caption>{''.join(shown)}</table>"


def _row(tag: str, cells: Sequence[str]) -> str:
    inner = "".join(f'<{tag} style="text-align:left">{html.escape(cell)}</{tag}>' for cell in cells)
    return f"<tr>{inner}</tr>"


def quantity(value: float, unit: str = "") -> str:
    """Returns a number of four digits with its unit."""
    return f"{value:.4g} {unit}".rstrip()


def vector(values: Any, unit: str = "") -> str:  # noqa: ANN401
    """Returns a `Vector3` or an array as (x, y, z) with its unit."""
    numbers = (values.x, values.y, values.z) if isinstance(values, scene_pb2.Vector3) else values
    return f"({', '.join(f'{number:.4g}' for number in numbers)}) {unit}".rstrip()


# --- scenes -----------------------------------------------------------------------------------------------------------


def scene_html(message: scene_pb2.Scene) -> str:
    """Shows bodies, tools and the step of a scene."""
    bodies = [[body.name, _mesh(body.mesh), _law(body.law), *_body_rest(body)] for body in message.bodies]
    heading = ["body", "mesh", "law", "density", "boundary conditions"]
    parts = [table(f"scene {message.name}", bodies, heading)]
    if message.tools:
        tools = [[tool.name, _kind(tool), vector(tool.position_m, "m"), _motion(tool)] for tool in message.tools]
        parts.append(table("tools", tools, ["tool", "kind", "starts at", "moves"]))
    step = _fields(message.stepping)
    if message.HasField("gravity_m_per_s2"):
        step.append(["gravity", vector(message.gravity_m_per_s2, "m/s²")])
    return "".join([*parts, table("stepping", step)] if step else parts)


def body_html(body: scene_pb2.Body) -> str:
    """Shows mesh, law and boundary conditions of a body."""
    density, conditions = _body_rest(body)
    rows = [["mesh", _mesh(body.mesh)], ["law", _law(body.law)], ["density", density]]
    return table(f"body {body.name}", [*rows, ["boundary conditions", conditions]])


def law_html(law: scene_pb2.Law) -> str:
    """Shows the constants of a law."""
    kind = law.WhichOneof("kind")
    rows = _fields(getattr(law, kind)) if kind else []
    rows += [
        [f"Prony term {i}", f"share {quantity(of.share)}, relaxes in {quantity(of.relaxation_time_s, 's')}"]
        for i, of in enumerate(law.prony)
    ]
    return table(f"law {kind or 'none'}", rows)


def _body_rest(body: scene_pb2.Body) -> list[str]:
    counts = {"fixed": len(body.fixed), "loads": len(body.loads), "prescribed": len(body.prescribed)}
    conditions = ", ".join(f"{name}: {count}" for name, count in counts.items() if count)
    return [quantity(body.density_kg_per_m3, "kg/m³"), conditions or "none"]


def _mesh(mesh: scene_pb2.Mesh) -> str:
    source = mesh.WhichOneof("source")
    if source == "grid":
        of = mesh.grid
        return f"grid of {of.cells_x} × {of.cells_y} × {of.cells_z} cells, shape {_shape_name(of.shape)}"
    if source == "file":
        return f"file {mesh.file}"
    elements = []
    for block in mesh.packed.elements:
        shape = _shape(block.shape)
        count = len(block.nodes) // (4 * shape.node_count) if shape is not None else 0
        elements.append(f"{count:,} × {_shape_name(block.shape)}")
    return ", ".join([f"{len(mesh.packed.node_positions) // 24:,} nodes", *elements])


def _shape(number: scene_pb2.Shape) -> Shape | None:
    return BY_NUMBER.get(number or scene_pb2.SHAPE_TETRAHEDRON)


def _shape_name(number: scene_pb2.Shape) -> str:
    shape = _shape(number)
    return shape.name.replace("_", " ") if shape is not None else f"shape {number}"


def _law(law: scene_pb2.Law) -> str:
    kind = law.WhichOneof("kind")
    if kind is None:
        return "none"
    constants = ", ".join(" ".join(row) for row in _fields(getattr(law, kind)))
    prony = f", {len(law.prony)} Prony terms" if law.prony else ""
    return f"{kind}: {constants}{prony}"


def _kind(tool: scene_pb2.Tool) -> str:
    return (tool.WhichOneof("kind") or "none").replace("_", " ")


def _motion(tool: scene_pb2.Tool) -> str:
    if tool.fixed:
        return "fixed"
    return f"mass {quantity(tool.mass_kg, 'kg')}" if tool.HasField("mass_kg") else "with its pose"


def _fields(message: Message) -> list[list[str]]:
    """Returns name and value of the numbers and vectors that a message has, with the unit that the name ends with."""
    rows = []
    for field, value in message.ListFields():
        unit = unit_of(field.name) or ""
        if isinstance(value, scene_pb2.Vector3):
            rows.append([field.name, vector(value, unit)])
        elif isinstance(value, bool):
            rows.append([field.name, "yes" if value else "no"])
        elif isinstance(value, int | float):
            rows.append([field.name, quantity(value, unit)])
    return rows


# --- running scenes ---------------------------------------------------------------------------------------------------


def report_html(report: control_pb2.SceneReport) -> str:
    """Shows the bodies of a plan, and what a step needs."""
    bodies = [
        [
            body.name,
            f"{body.node_count:,}",
            f"{body.element_count:,}",
            f"{body.fixed_node_count:,}",
            quantity(body.volume_m3, "m³"),
            quantity(body.mass_kg, "kg"),
        ]
        for body in report.bodies
    ]
    needs = [["memory", f"{report.bytes_total:,} bytes"], ["expected rate", quantity(report.expected_rate_hz, "Hz")]]
    needs += [["warning", text] for text in report.warnings]
    heading = ["body", "nodes", "elements", "fixed nodes", "volume", "mass"]
    return table(f"scene {report.scene}", bodies, heading) + table("plan", needs)


def status_html(status: stream_pb2.SceneStatus) -> str:
    """Shows state, time, solver and tools of a scene."""
    times = DurationHistogram.from_message(status.step_times)
    rows = [["state", state_name(status)]]
    if status.fault:
        rows.append(["fault", status.fault])
    rows += [
        ["step", f"{status.step:,} at {quantity(status.simulated_time_s, 's')}"],
        ["rate", f"{quantity(status.reached_rate_hz)} of {quantity(status.target_rate_hz, 'Hz')}"],
        ["step time", f"{quantity(status.step_time_p50_s, 's')}, p99 {quantity(status.step_time_p99_s, 's')}"],
        ["missed deadlines", f"{status.missed_deadlines:,}"],
        ["conjugate gradients", f"{status.cg_iterations} iterations to {status.cg_relative_residual:.1e}"],
    ]
    if times.count:
        rows.append(["step time, whole run", f"{quantity(times.p50_s, 's')}, p99 {quantity(times.p99_s, 's')}"])
    if status.newton_iterations:
        rows.append(["Newton", f"{status.newton_iterations} iterations to {status.newton_residual:.1e}"])
    rows += [
        ["kinetic energy", quantity(status.kinetic_energy_j, "J")],
        ["elastic energy", quantity(status.elastic_energy_j, "J")],
        ["smallest det F", quantity(status.min_det_f)],
    ]
    if status.guard_events:
        rows.append(["guards", f"{status.guard_events} events, {status.guard_recoveries} recovered"])
    if status.recoveries:
        rows.append(["recoveries", recoveries_text(status)])
    rows += [["warning", text] for text in status.warnings]
    rows += [[f"force on {tool.tool}", vector(tool.force_n, "N")] for tool in status.tools]
    return table(f"scene {status.scene}", rows)


def state_name(status: stream_pb2.SceneStatus) -> str:
    values = stream_pb2.SceneStatus.State.DESCRIPTOR.values_by_number
    known = values.get(status.state)
    return known.name.removeprefix("STATE_").lower() if known is not None else str(status.state)


# --- the protocol's messages ------------------------------------------------------------------------------------------


def show_messages() -> None:
    """Gives the messages that users hold their `_repr_html_`."""
    for message, shows in (
        (scene_pb2.Scene, scene_html),
        (scene_pb2.Body, body_html),
        (scene_pb2.Law, law_html),
        (control_pb2.SceneReport, report_html),
        (stream_pb2.SceneStatus, status_html),
    ):
        setattr(message, "_repr_html_", shows)  # noqa: B010  mypy refuses an assignment
