"""The result of a run of `tensormass trade`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from tensormass_tools.trade import sweep
from tensormass_tools.trade.knobs import Knobs
from tensormass_tools.trade.reference import Reference
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine, Measurement

# Names of the files that the command writes and runs once more.
FASTEST, MOST_ACCURATE = "fastest", "most_accurate"


@dataclass(frozen=True)
class Dropped:
    """A setting that was recommended until its file left the limit."""

    promised: Measurement
    again: Measurement
    why: str

    def to_plain(self) -> dict[str, Any]:
        setting = {"key": self.promised.key, "setting": self.promised.setting}
        return {**setting, "why": self.why, "again": self.again.to_plain()}


@dataclass(frozen=True)
class Outcome:
    """Result of a run. `measurements`: the unmodified scene, then single knobs, then combinations."""

    scene: str
    knobs: Knobs
    script: Script
    machine: Machine
    reference: Reference
    measurements: list[Measurement]
    combinations: int
    possible_combinations: int
    tolerance: float
    budget_s: float
    #: Candidates for each recommended file, by its name, the best first.
    candidates: dict[str, list[Measurement]]
    #: Recommended setting for each file; None if no setting is within the limit.
    recommended: dict[str, Measurement | None]
    #: Measurements of the written files, read and run again, by name; then those of `--confirm`.
    confirmed: dict[str, Measurement] = field(default_factory=dict)
    #: Settings that were recommended before, in order.
    dropped: dict[str, list[Dropped]] = field(default_factory=dict)

    @property
    def fastest(self) -> Measurement | None:
        return self.recommended[FASTEST]

    @property
    def most_accurate(self) -> Measurement | None:
        return self.recommended[MOST_ACCURATE]

    def to_plain(self) -> dict[str, Any]:
        def plain(of: Measurement | None) -> dict[str, Any] | None:
            return of.to_plain() if of is not None else None

        return {
            "scene": self.scene,
            "machine": self.machine.__dict__,
            "script": self.script.text(),
            "reference": self.reference.to_plain(),
            "knobs": {name: {"own": of.own, "values": list(of.values)} for name, of in self.knobs.knobs.items()},
            "not_varied": self.knobs.without,
            "tolerance": self.tolerance,
            "budget_s": self.budget_s,
            "combinations": {"measured": self.combinations, "possible": self.possible_combinations},
            **{name: plain(of) for name, of in self.recommended.items()},
            "confirmed": {name: of.to_plain() for name, of in self.confirmed.items()},
            "dropped": {name: [of.to_plain() for of in dropped] for name, dropped in self.dropped.items()},
            "front": [of.key for of in sweep.front(self.measurements)],
            "measurements": [of.to_plain() for of in self.measurements],
        }
