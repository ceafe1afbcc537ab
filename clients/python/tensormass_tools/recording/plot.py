"""`tensormass plot`: draws what a recording says over time into a picture."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tensormass import InvalidArgumentError
from tensormass._shared.files import replacing
from tensormass_tools.output import check_writable, print_json
from tensormass_tools.recording.file import RecordingReader
from tensormass_tools.recording.series import Curve, Series, read_series

_ENDINGS = (".png", ".svg", ".pdf")
_WIDTH_IN = 9.0
_PANEL_HEIGHT_IN = 1.9
_DOTS_PER_INCH = 150
# A curve of at most so many points has a mark at each, so that a single point is seen.
_MARKED_POINTS = 40
_RESIDUAL = "residual"
# Curves that are bounds, not measurements.
_BOUNDS = ("target", "budget")


def run(args: argparse.Namespace) -> int:
    """Writes the picture; 0 if that was possible."""
    if args.output.suffix not in _ENDINGS:
        raise InvalidArgumentError(f"--output {args.output}: must end in {', '.join(_ENDINGS[:-1])} or {_ENDINGS[-1]}")
    check_writable("--output", args.output)
    recording = RecordingReader(args.file)
    series = read_series(recording)
    panels = _panels(series)
    if not panels:
        raise InvalidArgumentError(f"{args.file}: has nothing to draw; it ended before its first step")
    notes = _notes(series, cut_off=recording.cut_off or recording.damaged)
    try:
        with replacing(args.output) as aside:
            draw(series, panels, notes).savefig(aside, dpi=_DOTS_PER_INCH)
    except OSError as error:
        raise InvalidArgumentError(f"--output {args.output}: cannot be written: {error.strerror}") from error
    if args.json:
        print_json(
            {
                "output": str(args.output),
                "scene": series.scene,
                "steps": series.steps,
                "frames": series.frames,
                "recoveries": len(series.recoveries_s),
                "recovered_steps": series.recovered_steps,
                "panels": {title: list(curves) for title, curves in panels.items()},
                "notes": notes,
            }
        )
    else:
        print("\n".join([*notes, f"wrote {args.output}: {', '.join(_what(title) for title in panels)}"]))
    return 0


def draw(series: Series, panels: Mapping[str, Mapping[str, Curve]], notes: Sequence[str]) -> Figure:
    """Draws the panels below each other, over the same time.

    Args:
        panels: by the label of its axis, each panel's curves by their names.
        notes: lines above the panels.
    """
    figure = Figure(figsize=(_WIDTH_IN, 0.8 + _PANEL_HEIGHT_IN * len(panels)), layout="constrained")
    figure.suptitle(f"{series.scene}: {series.steps} recorded steps", parse_math=False)
    marks = [
        ("reset", "tab:gray", series.resets_s),
        ("restored", "tab:olive", series.restores_s),
        ("adjusted", "tab:cyan", series.adjustments_s),
        ("recovers", "tab:purple", series.recoveries_s),
        ("stopped by a guard", "tab:red", series.stops_s),
    ]
    all_axes = figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
    all_axes[0].set_title("\n".join(notes), fontsize="small", color="dimgray", loc="left", parse_math=False)
    for axes, (title, curves) in zip(all_axes, panels.items(), strict=True):
        _draw_panel(axes, title, curves)
        for _, color, times_s in marks:
            for time_s in times_s:
                axes.axvline(time_s, color=color, linestyle=":", linewidth=1)
    seen = [(Line2D([], [], color=color, linestyle=":"), name) for name, color, times_s in marks if times_s]
    if seen:
        figure.legend(*zip(*seen, strict=True), loc="outside lower center", ncols=len(seen), frameon=False)
    all_axes[-1].set_xlabel("time since the start of the recording [s]")
    return figure


def _draw_panel(axes: Axes, title: str, curves: Mapping[str, Curve]) -> None:
    lines = []
    for name, curve in curves.items():
        style: dict[str, Any] = {"linewidth": 1.2}
        if name in _BOUNDS:
            style |= {"color": "black", "linestyle": "--", "linewidth": 1.0}
        elif len(curve.time_s) <= _MARKED_POINTS:
            style |= {"marker": ".", "markersize": 5}
        # Milliseconds read better; everything else stays in SI units.
        scale = 1e3 if "[ms]" in title else 1.0
        lines += axes.plot(curve.time_s, scale * curve.values, **style)
    axes.set_ylabel(title)
    axes.grid(alpha=0.3)
    values = [value for curve in curves.values() for value in curve.values]
    if title == _RESIDUAL and any(value > 0 for value in values):
        axes.set_yscale("log")
    elif title != _RESIDUAL:
        axes.set_ylim(bottom=0)
    legend = axes.legend(lines, list(curves), loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    for text in legend.get_texts():
        text.set_parse_math(False)  # names of tools are not formulas


def _panels(series: Series) -> dict[str, dict[str, Curve]]:
    panels = {
        "force on tool [N]": series.forces_n,
        "step time [ms]": series.step_times_s,
        "rate [Hz]": series.rates_hz,
        _RESIDUAL: series.residuals,
        "missed deadlines": series.missed_deadlines,
    }
    return {title: curves for title, curves in panels.items() if curves}


def _what(title: str) -> str:
    return title.split(" [")[0]


def _notes(series: Series, *, cut_off: bool) -> list[str]:
    """Says what the picture cannot show, and why."""
    notes = []
    if not series.frames:
        instead = "the forces are those of its statuses, about one a second" if series.forces_n else "it shows no force"
        notes.append(f"the recording has no frames, so {instead}; `tensormass record --frames` records them")
    elif not series.forces_n:
        notes.append("the scene has no tools, so there is no force")
    if not series.residuals:
        notes.append("the recording has no status of a step, so it shows no residual and no missed deadline")
    elif not series.missed_deadlines:
        notes.append("the scene was stepped on request, so it had no deadlines")
    if series.recovered_steps:
        notes.append(f"recoveries {len(series.recoveries_s)}, {series.recovered_steps} steps")
    if series.lost_steps:
        notes.append(f"{series.lost_steps} steps were lost in the recording")
    if cut_off:
        notes.append("the recording was cut off; it was read up to its last whole chunk")
    return notes
