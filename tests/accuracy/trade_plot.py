"""Pictures of the fronts of results/trade-*.jsonl, for docs/accuracy.md."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from tensormass_tools.trade import sweep

from . import trade_calculix
from .trade import SCENES, Trade, picture

_DOCS = Path(__file__).parents[2] / "docs"
_WIDTH, _HEIGHT, _LEFT, _TOP, _RIGHT, _BOTTOM = 760, 450, 70, 20, 190, 70
_COLORS = ("#2b6cb0", "#c05621", "#2f855a")
Point = tuple[float, float]


@dataclass(frozen=True)
class Curve:
    """Points: cost [ms], error [%]. own: the unmodified scene. known: the reference's own error [%]."""

    name: str
    front: Sequence[Point]
    others: Sequence[Point]
    own: Point | None = None
    known: float = 0.0

    @staticmethod
    def of(name: str, trade: Trade) -> Curve:
        front = sweep.front(trade.measurements)
        rest = [of for of in trade.measurements if of.errors and of not in front]
        own = trade.measurements[0]
        points = [
            [(1e3 * of.cost_s, 100 * of.errors.judged) for of in some if of.errors] for some in (front, rest, [own])
        ]
        reference = trade.head["reference"]
        known = 100 * max(reference["displacement_error"], reference["force_error"] or 0.0)
        return Curve(name, points[0], points[1], points[2][0], known)


def write(backends: Sequence[str]) -> list[Path]:
    """Writes a picture for each scene that was measured, and returns the paths."""
    written = []
    for scene in SCENES:
        trades = [trade for backend in backends if (trade := Trade.read(scene, backend))]
        curves = [Curve.of(trade.head["machine"]["device"], trade) for trade in trades]
        if scene == trade_calculix.SCENE and (rows := trade_calculix.solved()):
            points = [(1e3 * row["cost_s"], 100 * row["displacement"]) for row in rows]
            front = sweep.pareto(points)
            others = [point for index, point in enumerate(points) if index not in front]
            curves.append(Curve(trade_calculix.read()[0]["solver"], [points[index] for index in front], others))
        if curves:
            path = _DOCS / picture(scene)
            path.write_text(svg(curves))
            written.append(path)
    return written


def svg(curves: Sequence[Curve]) -> str:
    """An SVG with logarithmic axes that cover the fronts and the unmodified scenes."""
    shown = [point for curve in curves for point in (*curve.front, *([curve.own] if curve.own else []))]
    across, up = _Axis([x for x, _ in shown]), _Axis([y for _, y in shown])

    def place(point: Point) -> Point:
        x, y = across.share(point[0]), up.share(point[1])
        return _LEFT + x * (_WIDTH - _LEFT - _RIGHT), _HEIGHT - _BOTTOM - y * (_HEIGHT - _TOP - _BOTTOM)

    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" font-family="sans-serif" '
        'font-size="13">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
    ]
    for value in across.marks():
        x, _ = place((value, up.low))
        out.append(f'<path d="M{x:.1f} {_TOP}V{bottom}" stroke="#ddd"/>')
        out.append(f'<text x="{x:.1f}" y="{bottom + 18}" text-anchor="middle">{value:g}</text>')
    for value in up.marks():
        _, y = place((across.low, value))
        out.append(f'<path d="M{_LEFT} {y:.1f}H{right}" stroke="#ddd"/>')
        out.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:g} %</text>')
    words = (
        "ms for what a step of the scene simulates; vertical: error",
        "lines: fronts; dots: other settings; rings: the unmodified scene; dashed: the reference's own error",
    )
    for row, text in enumerate(words):
        out.append(f'<text x="{_LEFT}" y="{bottom + 38 + 18 * row}">{text}</text>')
    for number, (curve, color) in enumerate(zip(curves, _COLORS, strict=False)):
        for point in curve.others:
            if across.holds(point[0]) and up.holds(point[1]):
                x, y = place(point)
                out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" fill="{color}" opacity="0.4"/>')
        places = [place(point) for point in curve.front]
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        out.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>' for x, y in places]
        if up.holds(curve.known):
            _, y = place((across.low, curve.known))
            out.append(f'<path d="M{_LEFT} {y:.1f}H{right}" stroke="{color}" stroke-dasharray="6 5"/>')
        if curve.own:
            x, y = place(curve.own)
            out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="7" fill="none" stroke="{color}" stroke-width="2"/>')
        name = escape(curve.name, quote=False)
        out.append(f'<text x="{right + 10}" y="{_TOP + 14 + 20 * number}" fill="{color}">{name}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


class _Axis:
    """A logarithmic axis with a margin at both ends."""

    def __init__(self, values: Sequence[float]) -> None:
        self.low, self.high = min(values) / 1.3, max(values) * 1.3

    def share(self, value: float) -> float:
        return math.log(value / self.low) / math.log(self.high / self.low)

    def holds(self, value: float) -> bool:
        return self.low <= value <= self.high

    def marks(self) -> list[float]:
        """Marks at 1, 2, 5, 10 ...; over many decades only at powers of ten."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        factors = (1, 2, 5) if math.log10(self.high / self.low) < 2.5 else (1,)
        marks = [float(f"{factor}e{decade}") for decade in decades for factor in factors]
        return [mark for mark in marks if self.holds(mark)]
