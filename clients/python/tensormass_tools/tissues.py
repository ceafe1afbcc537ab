"""Moduli of tissues, kept in tissues.yaml with their sources."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from tensormass import InvalidArgumentError
from tensormass._shared.names import suggestion

FILE = Path(__file__).resolve().parent / "tissues.yaml"


@dataclass(frozen=True)
class Number:
    """A constant and why it has its value, for a comment beside it."""

    value: float
    why: str


@dataclass(frozen=True)
class Tissue:
    """An isotropic tissue."""

    name: str
    young_modulus_pa: Number
    poisson_ratio: Number
    density_kg_per_m3: Number


@cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = yaml.safe_load(FILE.read_text("utf-8"))
    return table


def known() -> list[str]:
    """Returns the names of all tissues."""
    return list(_table()["tissues"])


def by_name(name: str) -> Tissue:
    """Returns a tissue.

    Raises:
        InvalidArgumentError: it is not in the table.
    """
    table = _table()
    if name not in table["tissues"]:
        raise InvalidArgumentError(
            f"--tissue {name}: {suggestion(name, known())}; or give --young-modulus, with a source of your own"
        )
    entry = table["tissues"][name]
    poisson = _number(entry.get("poisson_ratio", table["poisson_ratio"]))
    density = _number(entry["density_kg_per_m3"])
    ratio = 2 * (1 + poisson.value)
    if "shear_modulus_pa" in entry:
        measured = _number(entry["shear_modulus_pa"])
        young = Number(ratio * measured.value, f"2 (1 + nu) times a shear modulus: {measured.why}")
    else:
        measured = _number(entry["shear_wave_speed_m_per_s"])
        shear_pa = density.value * measured.value**2
        young = Number(ratio * shear_pa, f"2 (1 + nu) rho c^2 of a shear wave: {measured.why}")
    return Tissue(name, young, poisson, density)


def by_hand(young_modulus_pa: float) -> Tissue:
    """Returns a tissue whose modulus the user gives."""
    table = _table()
    return Tissue(
        "given by hand",
        Number(young_modulus_pa, "given by --young-modulus"),
        _number(table["poisson_ratio"]),
        _number(table["density_kg_per_m3"]),
    )


def of_segment(name: str, term: str) -> Tissue | None:
    """Returns the tissue that a segment's name or its term of a terminology names; None if none or several do."""
    table = _table()
    for text in (name, term):
        words = set(re.findall(r"[a-z]+", text.lower()))
        if words & set(table["not_the_organ"]):
            return None
        found = [tissue for tissue, entry in table["tissues"].items() if words & set(entry["words"])]
        if len(found) == 1:
            return by_name(found[0])
        if found:
            return None
    return None


def _number(entry: dict[str, Any]) -> Number:
    parts = [entry["note"]] if "note" in entry else []
    if "source" in entry:
        source = _table()["sources"][entry["source"]]
        parts.append(f"{source['text']}, doi:{source['doi']} (read: {source['read']})")
    return Number(float(entry["value"]), "; ".join(parts))
