"""A case: an extreme, what must hold there, and the verdict."""

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

# Relative difference that neither hand nor eye notices.
FELT = 1e-2

# Warnings of the status (server/world/findings.cpp). Each is recognized by words that no other warning has.
OUT_OF_RANGE = "has left its range of strains"
SOFTER = "gets softer where it is pressed"
INVERTED = "elements are inverted"
NOT_CONVERGED = "ended with a residual of"
CURVATURE = "direction of negative curvature"
# Fault of the machine, not of the scene (server/world/loop.cpp).
DEVICE_FAILED = "the device failed"


@dataclass(frozen=True)
class Check:
    """Holds if value <= bound; NaN does not hold."""

    label: str
    value: float
    bound: float

    @property
    def share(self) -> float:
        """The value as a multiple of its bound; infinite if the value is not finite."""
        if not math.isfinite(self.value):
            return math.inf
        if self.bound == 0:
            return 0.0 if self.value <= 0 else math.inf
        return self.value / self.bound


@dataclass(frozen=True)
class Found:
    """The checks of a case.

    warnings: every warning of the status at that time, related to the checks or not. note: text for the results, also
    if all checks hold.
    """

    checks: Sequence[Check]
    warnings: Sequence[str] = ()
    note: str = ""


@dataclass(frozen=True)
class Group:
    """A section of docs/stability.md.

    must_hold: the bounds in a few words, for the page. text: what is done and what must hold, for results/README.md.
    """

    name: str
    title: str
    must_hold: str
    text: str


@dataclass(frozen=True)
class Case:
    """One row of the results for each precision.

    run: called with an engine of one precision; loads and steps scenes, and returns the checks.
    expects: outcomes that keep the promise.
    short: why the case may otherwise fall short or be caught, by precision or by outcome; "" stands for all.
    names: warnings that explain a failed check. Any other warning explains nothing.
    long: runs only with --long. quick: also a test of `make test`.
    solves: rough number of solves of a row. Rows with few solves run first, so a time limit leaves out few rows.
    together: cases with the same non-empty text check one shared run.
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
        """Why the case may have this outcome although its promise does not expect it; empty if it may not."""
        if outcome not in (SHORT, CAUGHT) or outcome in self.expects:
            return ""
        return self.short.get(precision) or self.short.get(outcome) or self.short.get("", "")

    def explains(self, outcome: str, precision: str) -> bool:
        """Whether the outcome keeps the promise or has a reason."""
        return outcome in self.expects or bool(self.reason(outcome, precision))


@dataclass(frozen=True)
class Verdict:
    """The outcome of a case.

    share: largest multiple of a bound among the checks; NaN without checks. text: the refusal, fault, warning, missed
    bound or note.
    """

    outcome: str
    share: float = math.nan
    text: str = ""


def judge(case: Case, engine: Engine) -> Verdict:
    """Runs a case. An exception becomes a verdict too, so that the other cases still run."""
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
