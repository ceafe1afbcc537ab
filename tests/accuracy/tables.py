"""Texts made of results. CSV files: one line a row, plain numbers, the same columns in every run. Tables of pages."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence

Cell = str | int | float | bool | None


def csv_text(rows: Sequence[Mapping[str, Cell]]) -> str:
    """CSV of rows that all have the columns of the first. Numbers have up to six significant digits; None, NaN and
    infinity are empty."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return out.getvalue()


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table for a page."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


def filled(page: str, blocks: Mapping[str, Sequence[str]]) -> str:
    """Replaces what stands in a page between `<!-- made: NAME -->` and `<!-- end -->` by the lines of that name. Names
    without lines keep what they have."""

    def block(of: re.Match[str]) -> str:
        name = of[1]
        return "\n".join([f"<!-- made: {name} -->", *blocks[name], "<!-- end -->"]) if name in blocks else of[0]

    return re.sub(r"<!-- made: (\w+) -->\n.*?<!-- end -->", block, page, flags=re.DOTALL)


def _cell(value: Cell) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
