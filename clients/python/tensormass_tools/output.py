"""Output of the command: protobuf messages as JSON, and the same for people."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np

from tensormass import DurationHistogram, InvalidArgumentError, MeshQuality
from tensormass._shared import defaults, findings
from tensormass._shared.status_text import recoveries_text
from tensormass.v1 import control_pb2, finding_pb2, scene_pb2, stream_pb2

#: Number of steps that `step_time_p50_s` and its like span.
STATUS_WINDOW_STEPS = 1024


def print_json(value: object) -> None:
    """Prints one line of JSON and flushes it."""
    print(json.dumps(value), flush=True)


def check_writable(option: str, path: Path) -> None:
    """Refuses a file that cannot be written, before the work that produces its content."""
    if os.path.exists(path):
        if path.is_dir() or not os.access(path, os.W_OK):
            raise InvalidArgumentError(f"{option} {path}: cannot be written")
    elif not os.access(path.resolve().parent, os.W_OK):
        raise InvalidArgumentError(f"{option} {path}: no folder that can be written to")


def state_name(status: stream_pb2.SceneStatus) -> str:
    """Returns `running`, `paused`, `lockstep` or `faulted`."""
    return stream_pb2.SceneStatus.State.Name(status.state).removeprefix("STATE_").lower()


def load_line(*, quiet: bool = False) -> Callable[[str, float], None] | None:
    """Returns a `progress` for `Server.load` that rewrites one line of the terminal; None without a terminal."""
    if quiet or not sys.stdout.isatty():
        return None
    width = shutil.get_terminal_size().columns - 1

    def write(part: str, fraction: float) -> None:
        text = f"loading {100 * fraction:3.0f} %  {part}" if part else ""  # the last one clears the line
        print(f"\r{text[:width]:<{width}}", end="" if part else "\r", flush=True)

    return write


def load_silently(_part: str, _fraction: float) -> None:
    """Shows nothing, as a `progress` for `Server.load`. With one, the load ends if this client ends; without, the
    daemon would complete it."""


def status_line(status: stream_pb2.SceneStatus, client_count: int | None = None) -> str:
    """Returns the state of a scene on one line."""
    missed = 100.0 * status.missed_deadlines / max(1, status.step)
    parts = [
        f"{status.reached_rate_hz:.1f}/{status.target_rate_hz:g} Hz",
        f"missed {missed:.1f} %",
        f"{1e3 * status.step_time_p50_s:.1f} ms (p99 {1e3 * status.step_time_p99_s:.1f})",
        *_whole_run(status),
        f"CG {status.cg_iterations} to {status.cg_relative_residual:.0e}",
    ]
    if status.step_budget_s > 0:
        range_text = f"at most {status.cg_iteration_limit} (floor {status.floor_cg_iterations})"
        parts.append(f"{range_text} in {1e3 * status.step_budget_s:g} ms")
    if status.newton_iterations > 0:
        parts.append(f"Newton {status.newton_iterations} to {status.newton_residual:.0e}")
    if status.state != stream_pb2.SceneStatus.STATE_RUNNING:
        parts.insert(0, state_name(status))
    parts += [f"{tool.tool} retired" if tool.retired else f"{tool.tool} {force_n(tool):.2f} N" for tool in status.tools]
    if client_count is not None:
        parts.append(f"clients {client_count}")
    if status.guard_events > 0:
        parts.append(f"guards {status.guard_events}, mended {status.guard_recoveries}")
    if status.recoveries > 0:
        parts.append(f"recoveries {recoveries_text(status)}")
    if status.fault:
        parts.append(f"FAULT: {status.fault}")
    return "  ".join(parts)


def _whole_run(status: stream_pb2.SceneStatus) -> list[str]:
    """Describes the step times since the load, once there are more of them than in the window of the percentiles."""
    times = DurationHistogram.from_message(status.step_times)
    if times.count <= STATUS_WINDOW_STEPS:
        return []
    return [f"run {1e3 * times.p50_s:.1f} ms (p99 {1e3 * times.p99_s:.1f})"]


class Warnings:
    """Collects the findings about a scene's results, each once although its numbers change from step to step."""

    def __init__(self) -> None:
        self._by_kind: dict[tuple[int, str, str, str], finding_pb2.Finding] = {}

    def take(self, status: stream_pb2.SceneStatus) -> list[str]:
        """Returns the texts of the findings of `status` that are new."""
        found = {findings.key_of(one): one for one in findings.of_results(status)}
        new = [findings.text_of(one) for key, one in found.items() if key not in self._by_kind]
        self._by_kind.update(found)
        return new

    def lines(self, status: stream_pb2.SceneStatus) -> list[str]:
        """Returns the new findings as the command prints them."""
        return [f"warning: {text}" for text in self.take(status)]

    def latest(self, *, without: Collection[finding_pb2.FindingCode] = ()) -> list[str]:
        """Returns every finding so far, in its latest wording, but for some kinds."""
        return [findings.text_of(one) for one in self._by_kind.values() if one.code not in without]


def force_n(feedback: stream_pb2.ToolFeedback) -> float:
    """Returns the magnitude of the force on a tool [N]."""
    force = feedback.force_n
    return float(np.linalg.norm([force.x, force.y, force.z]))


def report_text(report: control_pb2.SceneReport, scene: scene_pb2.Scene) -> str:
    """Returns the plan of a scene: its bodies, what is not modelled, findings, then what a step does and costs."""
    bodies = [["body", "nodes", "elements", "fixed", "volume", "mass", "min dihedral", "skin or boundary"]]
    for body in report.bodies:
        surface = f"{body.surface_vertex_count} vertices, {body.surface_triangle_count} triangles"
        bodies.append(
            [
                body.name,
                str(body.node_count),
                str(body.element_count),
                str(body.fixed_node_count),
                f"{1e6 * body.volume_m3:.4g} cm³",
                f"{body.mass_kg:.4g} kg",
                f"{body.min_dihedral_angle_deg:.1f}°",
                surface,
            ]
        )
    stages = [["stage", "bytes", "operations", "reads", "writes"]]
    stages += [
        [stage.name, _bytes(stage.bytes), f"{stage.operations:,}", stage.reads, stage.writes] for stage in report.stages
    ]
    buffers = [["buffer", "bytes"], *([buffer.name, _bytes(buffer.bytes)] for buffer in report.buffers)]
    sections = [f"scene {report.scene}", table(bodies)]
    elevated = [repr(body.name) for body in scene.bodies if body.element_order == scene_pb2.ELEMENT_ORDER_QUADRATIC]
    if elevated:
        sections.append(f"made quadratic, with a node in the middle of each edge: {', '.join(elevated)}")
    if scheduled := _schedules(scene):
        sections.append("factors by schedule:\n" + "\n".join(f"  {item}" for item in scheduled))
    sections.append(_tools_and_guard(scene))
    if report.contacts:
        sections.append(_contacts(report))
    if report.not_modelled:
        sections.append("not modelled:\n" + "\n".join(f"  {item}" for item in report.not_modelled))
    sections += _findings(report)
    sections.append(f"memory {_bytes(report.bytes_total)}; expected rate {report.expected_rate_hz:.0f} Hz (a guess)")
    sections += [f"{table(stages)}\nper step; for the solve, per iteration", table(buffers)]
    return "\n\n".join(sections)


def _tools_and_guard(scene: scene_pb2.Scene) -> str:
    """Describes the loads above which tools give way, and what follows a step that cannot be made."""
    tools = [["tool", "largest force", "torque", "joint load"]]
    for tool in scene.tools:
        if tool.fixed:
            tools.append([tool.name, "fixed: bears any load", "", ""])
        else:
            loads = defaults.largest_loads(tool)
            tools.append([tool.name, f"{loads.force_n:g} N", f"{loads.torque_n_m:g} N m", f"{loads.joint_load:g}"])
    if defaults.goes_on_after_fault(scene):
        then = "go_on: tools back off or let go, or the tissue is held for at most 0.1 s"
    else:
        then = "stop: the scene stops until it is reset"
    guard = f"after a fault (guard.on_fault): {then}"
    return f"{table(tools)}\n\n{guard}" if scene.tools else guard


def _contacts(report: control_pb2.SceneReport) -> str:
    """Describes how stiff contact is, from the softest to the stiffest place that can be touched."""
    rows = [["contact", "pressure per depth, Pa/m", "from"]]
    for contact in report.contacts:
        bodies = contact.body if contact.body == contact.other else f"{contact.body}, {contact.other}"
        least, most = f"{contact.least_penalty_pa_per_m:.4g}", f"{contact.most_penalty_pa_per_m:.4g}"
        rows.append(
            [
                contact.tool or bodies,
                least if least == most else f"{least} to {most}",
                "what is touched" if contact.is_default else "the scene",
            ]
        )
    return table(rows)


def _findings(report: control_pb2.SceneReport) -> list[str]:
    """Lists the findings of a scene, first those that it does not accept."""
    sections = []
    if found := [f"{findings.code_of(one)}: {findings.text_of(one)}" for one in report.findings if not one.accepted]:
        sections.append("findings (docs/findings.md has the thresholds):\n" + "\n".join(f"  {line}" for line in found))
    accepted = [f"{findings.code_of(one)}: {one.message} ({one.accepted})" for one in report.findings if one.accepted]
    if accepted:
        sections.append("accepted findings:\n" + "\n".join(f"  {line}" for line in accepted))
    return sections


def _schedules(scene: scene_pb2.Scene) -> list[str]:
    """Describes the schedules of gravity, loads and prescribed displacements, one a line."""
    found = [("gravity", scene.gravity_schedule)]
    for body in scene.bodies:
        found += [(f"{body.name!r}, loads[{i}]", load.schedule) for i, load in enumerate(body.loads)]
        found += [(f"{body.name!r}, prescribed[{i}]", of.schedule) for i, of in enumerate(body.prescribed)]
    return [
        f"{what}: "
        + ", ".join(f"{factor:g} at {time_s:g} s" for time_s, factor in zip(of.time_s, of.factor, strict=True))
        for what, of in found
        if of.time_s
    ]


def quality_text(quality: MeshQuality) -> str:
    """Describes a mesh in metres, in two lines."""
    elements = ", ".join(f"{count} × {name.replace('_', ' ')}" for name, count in quality.element_counts.items())
    return (
        f"{quality.node_count} nodes, {elements}, {1e6 * quality.volume:.4g} cm³\n"
        f"mean edge {1e3 * quality.mean_edge_length:.3g} mm, smallest dihedral angle "
        f"{quality.min_dihedral_angle_deg:.1f}°"
    )


def _bytes(count: int) -> str:
    if count < 1000:
        return f"{count} B"
    power = min((len(str(count)) - 1) // 3, 4)
    return f"{count / 1000**power:.3g} {' kMGT'[power]}B"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Aligns rows in columns. The first row is the heading."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
