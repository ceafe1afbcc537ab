"""Draws step time against elements from results of `tensormass-bench --suite sizes`, for docs/performance.md.

python tests/bench/plot.py tests/bench/results/*-sizes.jsonl > docs/images/step-time.svg
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

WIDTH, HEIGHT, LEFT, TOP, RIGHT, BOTTOM = 760, 440, 70, 20, 220, 50
COLORS = ("#2b6cb0", "#c05621", "#2f855a", "#6b46c1")


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines() if line]


def decades(values: list[float]) -> range:
    return range(math.floor(math.log10(min(values))), math.ceil(math.log10(max(values))) + 1)


def svg(series: dict[str, list[tuple[float, float]]]) -> str:
    """Draws lines of (elements, ms) by name, on two logarithmic axes."""
    points = [point for line in series.values() for point in line]
    across, up = decades([x for x, _ in points]), decades([y for _, y in points])

    def place(x: float, y: float) -> tuple[float, float]:
        share_x = (math.log10(x) - across[0]) / (across[-1] - across[0])
        share_y = (math.log10(y) - up[0]) / (up[-1] - up[0])
        return LEFT + share_x * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - share_y * (HEIGHT - TOP - BOTTOM)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" '
        'font-size="13">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
    ]
    for power in across:
        x, _ = place(10**power, 10 ** up[0])
        out.append(f'<path d="M{x:.1f} {TOP}V{HEIGHT - BOTTOM}" stroke="#ddd"/>')
        out.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{10**power:,}</text>')
    for power in up:
        _, y = place(10 ** across[0], 10**power)
        out.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        out.append(f'<text x="{LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{10**power:g}</text>')
    out.append(
        f'<text x="{LEFT}" y="{HEIGHT - 10}">tetrahedra; vertical: ms a step (50 CG iterations, StVK, float)</text>'
    )
    for (name, line), color in zip(series.items(), COLORS, strict=False):
        places = [place(*point) for point in sorted(line)]
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        out.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{color}"/>' for x, y in places]
        x, y = places[-1]
        out.append(f'<text x="{x + 8:.1f}" y="{y + 4:.1f}" fill="{color}">{name}</text>')
    return "\n".join([*out, "</svg>"])


def main() -> None:
    series: dict[str, list[tuple[float, float]]] = {}
    for argument in sys.argv[1:]:
        for row in rows(Path(argument)):
            series.setdefault(row["device"], []).append((row["elements"], row["step_ms_median"]))
    print(svg(series))


if __name__ == "__main__":
    main()
