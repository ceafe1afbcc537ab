"""Checks of what a browser sends."""

from __future__ import annotations

import math

from tensormass_gateway.outbox import ProtocolError

MAX_COORDINATE_M = 1e6
"""The daemon refuses poses beyond it as well."""


def is_name(text: str) -> bool:
    return 0 < len(text) <= 64 and all(c.isascii() and (c.isalnum() or c in "_-") for c in text)


def finite_numbers(value: object, count: int) -> tuple[float, ...] | None:
    """`value` if it is a list of `count` finite numbers, else None."""
    if not isinstance(value, list) or len(value) != count:
        return None
    if not all(isinstance(number, int | float) and not isinstance(number, bool) for number in value):
        return None
    try:
        numbers = tuple(float(number) for number in value)
    except OverflowError:  # JSON's whole numbers have no bounds
        return None
    return numbers if all(map(math.isfinite, numbers)) else None


def rotation(value: object) -> tuple[float, ...]:
    """A unit quaternion (w, x, y, z) along `value`. Raises ProtocolError where there is none."""
    numbers = finite_numbers(value, 4)
    if numbers is None or not any(numbers):
        raise ProtocolError("orientation is not four finite numbers [w, x, y, z], at least one of them not zero")
    # Scaled first: the squares of very large or very small numbers leave the range of floats.
    largest = max(map(abs, numbers))
    scaled = [number / largest for number in numbers]
    length = math.hypot(*scaled)
    return tuple(number / length for number in scaled)
