"""What a case is: an extreme, what must hold there, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import tensormass as tm

if TYPE_CHECKING:
    from accuracy.engine import Engine

HOLDS = "holds"
REFUSED = "refused at load"
CAUGHT = "caught while running"  # a fault, or the warning in the status that names what went wrong
SHORT = "falls short"
BROKEN = "broken"  # the case itself

# Of the reference: no hand and no eye tells one percent.
FELT = 1e-2

# What the status warns of (server/world/findings.cpp), by the words that only this warning has.
OUT_OF_RANGE = "has left its range of strains"
SOFTER = "gets softer where it is pressed"
INVERTED = "elements are turned inside out"
IMBALANCE = "ended with an imbalance of"
CURVATURE = "direction of negative curvature"
# A fault that is the machine's (server/world/runner.cpp).
DEVICE_FAILED = "the device failed"


@dataclass(frozen=True)
class Check:
    """Holds where value <= bound; a value that is no number does not."""

    label: str
    value: float
    bound: float

    @property
    def share(self) -> float:
        """Of the bound."""
        if not math.isfinite(self.value):
            return math.inf
        if self.bound == 0:
            return 0.0 if self.value <= 0 else math.inf
        return self.value / self.bound


@dataclass(frozen=True)
class Found:
    """warnings: what the scene's status said when the checks were made, whatever it has to do with them. note: for the
    page, also where all holds.
    """

    checks: Sequence[Check]
    warnings: Sequence[str] = ()
    note: str = ""


@dataclass(frozen=True)
class Group:
    """A section of docs/stability.md. text: what is done and what must hold."""

    name: str
    title: str
    text: str


@dataclass(frozen=True)
class Case:
    """expects: the outcomes that keep the promise. short: why it may fall short or be caught besides, by precision or
    by outcome; "" stands for all. names: the warnings that say what goes wrong here when a check fails; any other
    explains nothing.

    long: only with --long. quick: also a test of `make test`. solves: about how many a row makes; those of few come
    first, so that a limit of time leaves out few rows. together: cases of the same one, if any, look at the same run.
    """

    group: Group
    name: str
    law: str
    shape: str
    run: Callable[[Engine], Found] = field(repr=False)
    expects: tuple[str, ...] = (HOLDS,)
    short: dict[str, str] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    long: bool = False
    quick: bool = False
    solves: int = 1
    together: str = ""
    precisions: tuple[str, ...] = ("double", "float")

    @property
    def key(self) -> str:
        return f"{self.group.name}/{self.name}/{self.law}/{self.shape}"

    def reason(self, outcome: str, precision: str) -> str:
        """Why this outcome, which the promise does not expect."""
        if outcome not in (SHORT, CAUGHT) or outcome in self.expects:
            return ""
        return self.short.get(precision) or self.short.get(outcome) or self.short.get("", "")

    def explains(self, outcome: str, precision: str) -> bool:
        """Whether this outcome is what the page says of the case."""
        return outcome in self.expects or bool(self.reason(outcome, precision))


@dataclass(frozen=True)
class Verdict:
    """share: of its bound that the worst check takes; NaN without checks. text: the refusal, fault or warning; by how
    much it falls short; a note.
    """

    outcome: str
    share: float = math.nan
    text: str = ""


def judge(case: Case, engine: Engine) -> Verdict:
    """Runs a case. Also one that breaks has a verdict, so that the others still run."""
    try:
        found = case.run(engine)
    except tm.InvalidArgumentError as refusal:
        return Verdict(REFUSED, text=str(refusal))
    except tm.FailedPreconditionError as fault:
        return Verdict(BROKEN if DEVICE_FAILED in str(fault) else CAUGHT, text=str(fault))
    except Exception as error:
        return Verdict(BROKEN, text=f"{type(error).__name__}: {error}")
    worst = max(found.checks, key=lambda check: check.share)
    if worst.share <= 1:
        return Verdict(HOLDS, worst.share, found.note)
    missed = f"{worst.label} {worst.value:.2g}, bound {worst.bound:g}"
    telling = [warning for warning in found.warnings if any(words in warning for words in case.names)]
    if telling:
        return Verdict(CAUGHT, worst.share, f"{telling[-1]} ({missed})")
    unrelated = [f"the status says only: {warning}" for warning in found.warnings[-1:]]
    return Verdict(SHORT, worst.share, "; ".join(filter(None, (missed, found.note, *unrelated))))
