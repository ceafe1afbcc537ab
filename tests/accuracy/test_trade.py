"""Which measured settings become presets, and what the page says of a second run."""

from __future__ import annotations

from dataclasses import asdict, replace

from tensormass.trade.measures import Errors
from tensormass.trade.script import Costs
from tensormass.trade.store import Machine, Measurement

from .trade import OWN, Trade, _confirmations

MACHINE = Machine("cpu", "some processor", None, "1", "abc")


def measurement(setting: dict, cost_s: float, displacement: float, force: float, p99: float = 1.0) -> Measurement:
    costs = Costs(cost_s, p99 * cost_s, cost_s, 10, 20, 5, 0.1)
    errors = Errors(displacement, displacement, 0, force)
    return Measurement(repr(setting), setting, MACHINE, 6, errors, costs, cost_s=cost_s)


MEASURED = [
    measurement({}, 10.0, 0.08, 0.40),
    measurement({"law": "hooke"}, 2.0, 0.08, 0.30),  # another tissue
    measurement({"cg_max_iterations": 10}, 3.0, 0.20, 0.10),  # seen, if not felt
    measurement({"cg_tolerance": 0.1}, 4.0, 0.082, 0.41),  # nobody tells the difference
    measurement({"newton_max_iterations": 2}, 9.0, 0.08, 0.35),
    measurement({"newton_max_iterations": 5}, 8.0, 0.08, 0.20, p99=9.0),  # slow when it matters
    measurement({"resolution": 1.4}, 19.0, 0.06, 0.15),
    measurement({"resolution": 2.0}, 90.0, 0.05, 0.05),
]


def test_a_preset_keeps_the_law_and_is_no_worse_in_what_is_seen_or_felt() -> None:
    chosen = Trade({}, MEASURED).chosen()
    assert {name: of.setting for name, of in chosen.items()} == {
        "fast": {"cg_tolerance": 0.1},
        "balanced": {"newton_max_iterations": 2},
        "accurate": {"resolution": 1.4},
    }
    alone = Trade({}, MEASURED[:3]).chosen()
    assert all(of.setting == {} for of in alone.values())


def test_the_page_says_what_a_second_run_did() -> None:
    again = {OWN: MEASURED[0], "fast": replace(MEASURED[3], cost_s=7.0), "fastest": MEASURED[6]}
    head = {
        "machine": asdict(MACHINE),
        "tolerance": 0.2,
        "budget_s": 1.0,
        "fastest": MEASURED[6].key,
        "most_accurate": None,
        "confirmed": {name: {**of.to_plain(), "machine": None} for name, of in again.items()},
    }
    lines = _confirmations(Trade(head, MEASURED))
    assert any(line.startswith("| as it is | as it is | 40 % | 40 % |") and "| confirmed |" in line for line in lines)
    assert any(line.startswith("| preset fast | cg tolerance 0.1 |") and "**not confirmed**" in line for line in lines)
    assert any(line.startswith("| the fastest within 20 % | resolution 1.4 |") for line in lines)
    assert lines[-1].strip() == "The most accurate within 1e+03 ms: no setting."
