"""A case: one number of the server, compared with a reference from elsewhere, and the largest error that passes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .engine import Engine


@dataclass(frozen=True)
class Outcome:
    """Result of a case. The text of its group defines `error`. details: (label, value, error) of each refinement."""

    value: float
    reference: float
    error: float
    details: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class Group:
    """A section of the report. text: what is solved and how the error is measured."""

    name: str
    title: str
    text: str


@dataclass(frozen=True)
class Case:
    """One comparison.

    bounds: the largest error that passes, by precision. None means that no claim is made and every error passes. A
    precision without an entry is not run.
    run: Callable[[Engine], Outcome]; called once for each precision, with an engine of that precision.
    quick: `make test` runs the case too.
    """

    group: Group
    shape: str
    law: str
    name: str
    quantity: str
    source: str
    bounds: Mapping[str, float | None]
    run: Callable[[Engine], Outcome] = field(repr=False)
    quick: bool = False

    @property
    def key(self) -> str:
        return f"{self.group.name}/{self.name}/{self.shape}/{self.law}"


def relative(value: float, reference: float) -> float:
    """Relative error."""
    return abs(value - reference) / abs(reference)
