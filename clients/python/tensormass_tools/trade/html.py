"""The report as one self-contained HTML page: error against cost, the front, and every number."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from tensormass_tools.trade import report, sweep
from tensormass_tools.trade.outcome import Outcome
from tensormass_tools.trade.store import Measurement

_WIDTH, _HEIGHT, _MARGIN, _FOOT = 860, 430, 62, 32
# Smaller errors are drawn here, because a logarithm needs a floor and no reference is that accurate.
_LEAST_ERROR = 1e-5
_STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1100px; padding: 0 1em; color: #1c2530; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 12.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 8px; border-bottom: 1px solid #dde3ea; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; white-space: normal; min-width: 15em; }
tr.front td { background: #eef5ff; }
svg { width: 100%; height: auto; } svg text { font: 12px system-ui, sans-serif; fill: #4a5664; }
.grid { stroke: #e6eaef; } .limit { stroke: #b3372f; stroke-dasharray: 5 4; }
.line { fill: none; stroke: #1f5fbf; stroke-width: 1.5; }
.single { fill: #9aa7b5; } .combined { fill: #d99a2b; } .onfront { fill: #1f5fbf; } .own { fill: #16803c; }
.warning { color: #8a2d1c; }
"""


def page(outcome: Outcome) -> str:
    """Returns the whole document."""
    machine = outcome.machine
    front = sweep.front(outcome.measurements)
    on_front = {of.key for of in front}
    by_cost = sorted(outcome.measurements, key=lambda of: of.cost_s)
    rows = [(report.cells(of), "front" if of.key in on_front else "") for of in by_cost]
    picks = "".join(f"<li><b>{escape(what)}</b>: {escape(reached)}</li>" for what, reached in report.picks(outcome))
    sections = [
        f"<h1>{escape(outcome.scene)}: accuracy against time</h1>",
        f"<p>{escape(outcome.script.text())}. On {escape(machine.backend)} ({escape(machine.device)}), tensormassd "
        f"{escape(machine.version)}, build {escape(machine.build)}.</p>",
        f"<ul>{picks}</ul>",
        _paragraphs(report.confirmations(outcome)),
        _paragraphs(report.findings(outcome), "warning"),
        _chart(outcome, front),
        f"<p>{len(outcome.measurements)} settings: single knobs, and {outcome.combinations} combinations of "
        f"{outcome.possible_combinations} that are possible.</p>",
        "<h2>Reference</h2>",
        _paragraphs(outcome.reference.text()),
        "<h2>One knob at a time</h2>",
        _table(report.KNOB_HEADS, report.knob_rows(list(outcome.knobs.knobs.values()), outcome.measurements)),
        _paragraphs(f"{name}: {why}" for name, why in outcome.knobs.without.items()),
        "<h2>All settings</h2>",
        _paragraphs(report.table_head(outcome.reference), "warning"),
        _table(report.HEADS, rows),
        _paragraphs(report.words()),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(outcome.scene)}</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n" + "\n".join(sections) + "\n</body></html>\n"
    )


def _paragraphs(lines: Iterable[str], kind: str = "") -> str:
    return "".join(f'<p class="{kind}">{escape(line)}</p>' for line in lines)


def _table(heads: Sequence[str], rows: Iterable[tuple[Sequence[str], str]]) -> str:
    head = "".join(f"<th>{escape(of)}</th>" for of in heads)
    body = "".join(
        f'<tr class="{kind}">' + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row, kind in rows
    )
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>'


def _chart(outcome: Outcome, front: list[Measurement]) -> str:
    """Draws error against cost, both logarithmic."""
    drawn = [of for of in outcome.measurements if of.errors is not None and math.isfinite(of.errors.judged)]
    costs = [1e3 * of.cost_s for of in drawn] + [1e3 * outcome.budget_s]
    errors = [_error(of) for of in drawn] + [outcome.tolerance]
    x, y = _Axis(costs, _MARGIN, _WIDTH - 20), _Axis(errors, _HEIGHT - _FOOT, 15)
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="error against cost">']
    for value in x.marks():
        at = x(value)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="15" y2="{_HEIGHT - _FOOT}"/>')
        parts.append(f'<text x="{at:.1f}" y="{_HEIGHT - _FOOT + 18}" text-anchor="middle">{value:g} ms</text>')
    for value in y.marks():
        at = y(value)
        parts.append(f'<line class="grid" x1="{_MARGIN}" x2="{_WIDTH - 20}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{_MARGIN - 6}" y="{at + 4:.1f}" text-anchor="end">{100 * value:g} %</text>')
    budget, tolerance = x(1e3 * outcome.budget_s), y(outcome.tolerance)
    parts.append(f'<line class="limit" x1="{budget:.1f}" x2="{budget:.1f}" y1="15" y2="{_HEIGHT - _FOOT}"/>')
    parts.append(f'<line class="limit" x1="{_MARGIN}" x2="{_WIDTH - 20}" y1="{tolerance:.1f}" y2="{tolerance:.1f}"/>')
    points = " ".join(f"{x(1e3 * of.cost_s):.1f},{y(_error(of)):.1f}" for of in front)
    parts.append(f'<polyline class="line" points="{points}"/>')
    on_front = {of.key for of in front}
    for of in drawn:
        kind = "combined" if len(of.setting) > 1 else "single"
        kind = "onfront" if of.key in on_front else kind
        kind = "own" if not of.setting else kind
        title = escape(f"{report.setting_text(of.setting)}: {report.brief(of)}")
        place = f'cx="{x(1e3 * of.cost_s):.1f}" cy="{y(_error(of)):.1f}"'
        parts.append(
            f'<circle class="{kind}" {place} r="{6 if not of.setting else 4.5}"><title>{title}</title></circle>'
        )
    words = (
        "Error against the time to compute one step's worth of the scene. Blue: the front, green: the unmodified "
        "scene, grey: one knob, orange: several, dashed: tolerance and budget. Point at a dot for its numbers."
    )
    return "".join([*parts, f"</svg><p>{words}</p>"])


def _error(of: Measurement) -> float:
    assert of.errors is not None
    return max(of.errors.judged, _LEAST_ERROR)


class _Axis:
    """Maps positive values logarithmically to pixels."""

    def __init__(self, values: Sequence[float], start: float, end: float) -> None:
        self._low, self._high = math.log10(min(values)) - 0.08, math.log10(max(values)) + 0.08
        self._start, self._end = start, end

    def __call__(self, value: float) -> float:
        return self._start + (math.log10(value) - self._low) / (self._high - self._low) * (self._end - self._start)

    def marks(self) -> list[float]:
        """Returns ticks 1, 2, 5, 10 ... within the range."""
        decades = range(math.floor(self._low), math.ceil(self._high) + 1)
        marks = [factor * 10.0**decade for decade in decades for factor in (1, 2, 5)]
        return [float(f"{mark:.3g}") for mark in marks if self._low <= math.log10(mark) <= self._high]
