"""What a case is: one number of ours against one from elsewhere, with the error that it may have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .engine import Engine


@dataclass(frozen=True)
class Outcome:
    """error: as the case's group says how it is measured. details: further rows of (label, value, error)."""

    value: float
    reference: float
    error: float
    details: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class Group:
    """A section of docs/accuracy.md. text: what is solved and how the error is measured."""

    name: str
    title: str
    text: str


@dataclass(frozen=True)
class Case:
    """bounds: the largest error that passes, by precision; None: any, no claim is made. A precision that is not
    named is not run.

    quick: also a test of `make test`.
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
    return abs(value - reference) / abs(reference)
