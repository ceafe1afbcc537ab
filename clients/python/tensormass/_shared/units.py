"""Units of scene files: each field's unit is the end of its name, as in `young_modulus_pa`. All are SI."""

from __future__ import annotations

import math
import re

#: [end of a field's name]: unit. Longer ends come first, because `_per_s` also ends in `_s`.
_UNITS = {
    "_kg_per_m3": "kg/m³",
    "_m_per_s2": "m/s²",
    "_m_per_s": "m/s",
    "_pa_per_m": "Pa/m",
    "_n_per_m": "N/m",
    "_per_s": "1/s",
    "_n_m": "N m",
    "_hz": "Hz",
    "_pa": "Pa",
    "_kg": "kg",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
_PREFIXES = {"": 1.0, "G": 1e9, "M": 1e6, "k": 1e3, "d": 1e-1, "c": 1e-2, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6}
_QUANTITY = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([A-Za-zµμ]+)\s*")


def unit_of(field: str) -> str | None:
    """The unit of a field, by its name; None for one without a unit."""
    # Vectors carry the unit in their own name: x of gravity_m_per_s2.
    return next((unit for end, unit in _UNITS.items() if field.endswith(end)), None)


def in_si(text: str, unit: str) -> float | None:
    """The number that stands for a quantity: `5 kPa` in Pa is 5000. None if `text` is not a quantity of that unit."""
    match = _QUANTITY.fullmatch(text)
    if match is None or not match[2].endswith(unit) or match[2].removesuffix(unit) not in _PREFIXES:
        return None
    try:
        number = float(match[1]) * _PREFIXES[match[2].removesuffix(unit)]
    except ValueError:
        return None
    return number if math.isfinite(number) else None
