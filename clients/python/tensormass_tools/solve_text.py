"""The output of `tensormass solve`: its progress and its summary."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from collections.abc import Sequence
from typing import Any

from tensormass.v1 import stream_pb2
from tensormass_tools.output import table

_PROGRESS_PERIOD_S = 0.2
_LOG_PERIOD_S = 5.0


class Progress(contextlib.AbstractContextManager["Progress"]):
    """A line on stderr: rewritten in place on a terminal, now and then in a log."""

    def __init__(self, count: int | None, dt_s: float) -> None:
        self._count = count
        self._dt_s = dt_s
        self._live = sys.stderr.isatty()
        self._period_s = _PROGRESS_PERIOD_S if self._live else _LOG_PERIOD_S
        self._shown = time.monotonic()
        self._width = 0

    def show(self, status: stream_pb2.SceneStatus, kinetic_share: float | None) -> None:
        """Prints the progress, unless the last line is too recent.

        `kinetic_share`: kinetic energy as a share of its peak, for a scene that must come to rest.
        """
        if time.monotonic() - self._shown < self._period_s:
            return
        self._shown = time.monotonic()
        parts = [f"step {status.step}" + (f"/{self._count}" if self._count is not None else "")]
        parts += [f"{status.simulated_time_s:.4g} s", f"CG {status.cg_iterations} to {status.cg_relative_residual:.0e}"]
        if status.newton_iterations > 0:
            parts.append(f"Newton {status.newton_iterations} to {status.newton_residual:.0e}")
        if kinetic_share is not None:
            parts.append(f"kinetic energy {kinetic_share:.0e} of its peak")
        text = "  ".join(parts)
        if self._live:
            text = text[: shutil.get_terminal_size().columns - 1]
            print(f"\r{text:<{self._width}}", end="", file=sys.stderr, flush=True)
            self._width = len(text)
        else:
            print(text, file=sys.stderr, flush=True)

    def __exit__(self, *_: object) -> None:
        if self._width > 0:
            print(f"\r{'':<{self._width}}\r", end="", file=sys.stderr, flush=True)


def text(summary: dict[str, Any]) -> str:
    """Formats the summary for people."""
    solves = [f"{summary['cg_iterations']} CG iterations, the last to {summary['cg_relative_residual']:.1e}"]
    if summary["newton_iterations"] > 0:
        solves.insert(
            0, f"{summary['newton_iterations']} Newton iterations, residual {summary['newton_residual']:.1e} at most"
        )
    steps = "1 step" if summary["steps"] == 1 else f"{summary['steps']} steps"
    head = (
        f"{summary['scene']}: {summary['integrator']}, {summary['precision']}, {steps}, "
        f"{summary['simulated_time_s']:.4g} s simulated in {summary['wall_time_s']:.2g} s "
        f"on {summary['backend']} ({summary['device']})"
    )
    rows = [["body", "displacement", "reaction sum [N]", "elastic", "kinetic", "min det F"]]
    for body in summary["bodies"]:
        rows.append(
            [
                body["name"],
                f"{body['max_displacement_m']:.4g} m",
                _vector(body["reaction_sum_n"]),
                f"{body['elastic_energy_j']:.4g} J",
                f"{body['kinetic_energy_j']:.4g} J",
                f"{body['min_det_f']:.4g}",
            ]
        )
    sections = ["\n".join([head, *solves]), table(rows)]
    if summary["warnings"]:
        sections.append("warnings:\n" + "\n".join(f"  {text}" for text in summary["warnings"]))
    sections.append("written: " + ", ".join(summary["files"]))
    return "\n\n".join(sections)


def _vector(values: Sequence[float]) -> str:
    """Formats a vector. Components that are only rounding of the largest one become zero."""
    largest = max(map(abs, values))
    return ", ".join(f"{value:.4g}" if abs(value) > 1e-6 * largest else "0" for value in values)
