"""Checks of the requests of browsers."""

from __future__ import annotations

import json
import math
from typing import Any

from google.protobuf import json_format

PARSE_ERRORS = (json_format.ParseError, RecursionError, OverflowError)
"""Raised by protobuf for JSON of a stranger. The last one: a whole number that no float holds."""
MAX_COORDINATE_M = 1e6
"""Largest coordinate of a pose. The daemon has the same limit."""


class ProtocolError(Exception):
    """A browser broke the protocol. The text is sent back as the reason for closing."""


def is_name(text: str) -> bool:
    return 0 < len(text) <= 64 and all(c.isascii() and (c.isalnum() or c in "_-") for c in text)


def printable(text: str) -> str:
    """Returns a text for a message of protobuf, which takes no halves of characters.

    A browser may send one, and the name of a file that is not UTF-8 has some.
    """
    return text.encode("utf-8", "backslashreplace").decode()


def read_request(text: str) -> dict[str, Any]:
    """Parses the JSON object of a request.

    Raises:
        ProtocolError: not a JSON object, or nested deeper than Python's parser allows.
    """
    try:
        request = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ProtocolError("a message is not JSON, or is nested too deep") from error
    if not isinstance(request, dict):
        raise ProtocolError("a message is not a JSON object")
    return request


def finite_number(value: object) -> float | None:
    """Returns `value` if it is a finite number, else None. Python's parser also accepts NaN and Infinity."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return None
    try:
        number = float(value)
    except OverflowError:  # whole numbers in JSON have no bounds
        return None
    return number if math.isfinite(number) else None


def finite_numbers(value: object, count: int) -> tuple[float, ...] | None:
    """Returns `value` if it is a list of `count` finite numbers, else None."""
    if not isinstance(value, list) or len(value) != count:
        return None
    numbers = [finite_number(each) for each in value]
    return tuple(number for number in numbers if number is not None) if None not in numbers else None


def rotation(value: object) -> tuple[float, ...]:
    """Returns the unit quaternion (w, x, y, z) along `value`. Raises ProtocolError if `value` has no direction."""
    numbers = finite_numbers(value, 4)
    if numbers is None or not any(numbers):
        raise ProtocolError("orientation is not four finite numbers [w, x, y, z], at least one of them not zero")
    # Scales first, because squares of very large or very small numbers leave the range of floats.
    largest = max(map(abs, numbers))
    scaled = [number / largest for number in numbers]
    length = math.hypot(*scaled)
    return tuple(number / length for number in scaled)
