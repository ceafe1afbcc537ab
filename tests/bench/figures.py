"""Figures in documents that name their field: a link whose title says from where the number is.

    step [0.705 ms](tests/bench/results/nvidia-h200-demo-default.jsonl "step_time.p50_ms where case=real time: demo")

The title is a field, or a quotient of two, of the last row whose other fields have the given values; in a JSON file
without rows, of the file. `figure` makes such a link, and `problems` lists those that differ from their file. The
number may be rounded, and its unit may be another one.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

Row = Mapping[str, Any]

#: Factor of a unit against the one that fields have.
_UNITS = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "%": 0.01, "min": 60.0}
_LINK = re.compile(r'\[([^\]]+)\]\(([^)\s]+\.jsonl?) "([^"]+)"\)')
_NUMBER = re.compile(r"(?P<number>\d[\d,]*(?:\.\d+)?)(?:\s*(?P<unit>ms|µs|min|s|%))?")
_CONDITION = re.compile(r"([\w.]+)=([^;]+)(?:; |$)")


def figure(text: str, page: Path, file: Path, field: str, **where: object) -> str:
    """Makes the link of a number, as it stands in a page."""
    target = os.path.relpath(file, page.parent)
    conditions = "; ".join(f"{name}={value}" for name, value in where.items())
    return f'[{text}]({target} "{field}{f" where {conditions}" if conditions else ""}")'


def problems(page: Path, text: str) -> list[str]:
    """Lists the figures of a page that their files do not have."""
    found = []
    for shown, target, title in _LINK.findall(text):
        try:
            value = value_of(page.parent / target, title)
        except (KeyError, ValueError, OSError) as error:
            found.append(f"{page.name}: [{shown}]: {target}, {title}: {error}")
            continue
        if not equal(shown, value):
            found.append(f"{page.name}: [{shown}]: {target} has {value:g} as {title}")
    return found


def value_of(file: Path, title: str) -> float:
    """Returns the value that a title names, in seconds if it is a time.

    Raises:
        KeyError: no such row or field.
        ValueError: the field is not a number.
    """
    field, _, conditions = title.partition(" where ")
    wanted = dict(_CONDITION.findall(conditions))
    text = file.read_text()
    rows = [json.loads(line) for line in text.splitlines() if line] if file.suffix == ".jsonl" else [json.loads(text)]
    matching = [row for row in rows if all(str(_field(row, name)) == value for name, value in wanted.items())]
    if not matching:
        raise KeyError("no such row")
    above, _, below = field.partition(" / ")
    value = _number(matching[-1], above)
    return value / _number(matching[-1], below) if below else value


def equal(shown: str, value: float) -> bool:
    """Tells whether a shown number is a value, to the digits that are shown."""
    match = _NUMBER.fullmatch(shown.strip())
    if match is None:
        return False
    digits = match["number"].replace(",", "")
    unit = _UNITS.get(match["unit"] or "", 1.0)
    decimals = len(digits.partition(".")[2])
    return abs(float(digits) - value / unit) <= 0.5000001 * 10**-decimals


def unnamed_numbers(text: str) -> list[str]:
    """Returns the numbers of a text that are not figures with a field. Percentiles and devices have numbers, too."""
    rest = _LINK.sub("", text)
    rest = re.sub(r"\]\([^)]*\)", "]", rest)
    rest = re.sub(r"p\d\d(\.\d)?|H[12]00", "", rest)
    return re.findall(r"\d[\d,.]*", rest)


def _number(row: Row, name: str) -> float:
    value = _field(row, name.strip())
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is not a number")
    for unit in ("ms", "us"):
        if name.strip().endswith(f"_{unit}") or f"_{unit}_" in name:
            return value * {"ms": 1e-3, "us": 1e-6}[unit]
    return float(value)


def _field(row: Row, name: str) -> Any:  # noqa: ANN401
    """Returns a field; `a.b` is b of a."""
    value: Any = row
    for part in name.split("."):
        value = value[part]
    return value
