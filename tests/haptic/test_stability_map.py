"""docs/haptics.md agrees with the committed map, and the map shows what the page says."""

from __future__ import annotations

import json

import pytest
import stability_map

MOST_WORDS = 1000  # two screens


def test_the_page_is_that_of_the_results() -> None:
    text = stability_map.PAGE.read_text()
    assert stability_map.page() == text, "run `python tests/haptic/stability_map.py --draw-only`"
    assert len(text.replace("|", " ").split()) <= MOST_WORDS


def test_nothing_grows_unless_half_of_the_messages_are_lost() -> None:
    rows = stability_map.read()
    assert len(rows) == 4752
    grown = [row for row in rows if row["full"] == "g"]
    assert all(row["loss"] == 0.5 and row["server_rate_hz"] == 60 for row in grown)
    assert len(grown) <= 4


def test_a_held_device_rests_without_loss_up_to_35_ms() -> None:
    held = [row for row in stability_map.read() if row["loss"] == 0 and row["hand"] in stability_map.HELD]
    restless = [row for row in held if row["full"] != "r" and row["delay_ms"] <= 35]
    assert len(restless) <= 1
    assert all(row["amplitude_mm"] < 0.1 for row in restless)


@pytest.mark.parametrize("chain", ["no secant", "no controller", "transmitted with controller", "transmitted"])
def test_each_part_of_the_client_lets_more_cases_rest(chain: str) -> None:
    rows = stability_map.read()
    assert sum(row[chain] == "r" for row in rows) < sum(row["full"] == "r" for row in rows) - 500


def test_lines_of_the_program_become_a_row_for_each_case() -> None:
    line = dict.fromkeys(stability_map.CASE, 1) | {
        "motion": "grows",
        "kinetic_energy_j": [1e-3, 2e-3, 3e-3],
        "amplitude_m": 1e-3,
        "generated_energy_j": 4e-3,
        "min_observer_energy_j": -4e-3,
        "max_force_n": 2.0,
    }
    lines = [json.dumps(line | {"chain": chain}) for chain in stability_map.CHAINS]
    (row,) = stability_map.cases(lines)
    assert [row[chain] for chain in stability_map.CHAINS] == ["g"] * 5
    assert row["last_uj"] == 3000
    assert [total["grows"] for total in stability_map.totals(lines)] == [1] * 5
