"""The fronts of results/trade-*.jsonl as rows for CSV files, and their part of docs/accuracy.md.

Words used here: the *own* setting is the unmodified scene. *Judged* error is the larger of the errors of displacement
and of force on the tool. *Cost* is the median time to compute as much as one step of the unmodified scene simulates;
*p99* is the same for the 99th percentile.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Any

from tensormass_tools import presets
from tensormass_tools.trade import report
from tensormass_tools.trade.knobs import Setting
from tensormass_tools.trade.store import Measurement

from . import trade, trade_calculix
from .tables import Cell, markdown
from .trade import OWN, PRESETS_BACKEND, SCENES, Trade

Row = dict[str, Cell]

_COLUMNS = (
    "Columns of the `trade` files. Errors are shares of the reference's value: 0.01 is one per cent.",
    "",
    "| column | meaning |",
    "|---|---|",
    "| `front` | no other setting is both cheaper and more accurate |",
    "| `error` | the larger of `displacement` and `force` |",
    "| `displacement` | L2 norm over volume and time |",
    "| `worst_node` | largest difference of any point at any time, relative to the largest displacement |",
    "| `force`, `force_angle_deg` | force on the tool: RMS error of its size, mean error of its direction |",
    "| `force_held`, `force_moving` | as `force`, while the tool stays in and while it moves; not in older results |",
    "| `force_held_shallow` | as `force_held`, at the first of two depths |",
    "| `work` | work of pressing the tool in |",
    "| `frequency`, `damping` | of the free motion under the loads: relative error, difference of damping ratios |",
    "| `volume` | largest difference of V / V₀ |",
    "| `moved` | displacement relative to the unmodified scene: the change that the setting alone makes |",
    "| `cost_ms`, `cost_p99_ms` | time to compute what one step of the unmodified scene simulates, scaled by the "
    "machine's speed at that moment; second runs are not scaled |",
    "| `cost_factor` | `cost_ms` relative to the unmodified scene |",
    "| `step_p50_ms`, `step_p99_ms` | time of one step of the setting |",
    "| `latency_ms` | from a tool pose to its force over the control plane, in lockstep |",
    "| `energy_mj` | energy of the whole GPU for one step of the unmodified scene, with the tool at its deepest |",
    "| `unconverged_steps` | steps that ended above `newton_tolerance` |",
)


def read(backends: Sequence[str]) -> list[Trade]:
    """All fronts that were measured, scene by scene."""
    return [of for scene in SCENES for backend in backends if (of := Trade.read(scene, backend))]


def settings(of: Trade) -> list[Row]:
    """One row for each setting, the cheapest first; settings that could not be run come last."""
    named = preset_names(of)
    front = {one.key for one in of.front()}
    rows = []
    for measured in sorted(of.measurements, key=lambda one: (one.errors is None, one.cost_s)):
        errors, costs = measured.errors, measured.costs
        angle = errors.force_angle_rad if errors else None
        energy = costs.step_energy_j if costs else None
        rows.append(
            {
                **_where(of),
                "setting": report.setting_text(measured.setting),
                "preset": " ".join(named.get(measured.key, [])),
                "front": measured.key in front,
                "elements": measured.element_count,
                "error": errors.judged if errors else None,
                "displacement": errors.displacement if errors else None,
                "worst_node": errors.worst_node if errors else None,
                "force": errors.force if errors else None,
                "force_held": errors.force_held if errors else None,
                "force_held_shallow": errors.force_held_shallow if errors else None,
                "force_moving": errors.force_moving if errors else None,
                "force_angle_deg": None if angle is None else math.degrees(angle),
                "work": errors.work if errors else None,
                "frequency": errors.frequency if errors else None,
                "damping": errors.damping if errors else None,
                "volume": errors.volume if errors else None,
                "moved": measured.moved if errors else None,
                "cost_ms": 1e3 * measured.cost_s if costs else None,
                "cost_p99_ms": 1e3 * measured.slow_s if costs else None,
                "step_p50_ms": 1e3 * costs.step_p50_s if costs else None,
                "step_p99_ms": 1e3 * costs.step_p99_s if costs else None,
                "latency_ms": 1e3 * costs.latency_p50_s if costs else None,
                "timed_steps": costs.timed_steps if costs else None,
                "memory_mb": costs.memory_bytes / 1e6 if costs else None,
                "energy_mj": None if energy is None else 1e3 * energy,
                "unconverged_steps": measured.unconverged_steps,
                "failure": measured.failure,
            }
        )
    return rows


def knobs(of: Trade) -> list[Row]:
    """One row for each value of each knob turned alone. `cost_factor` is relative to the unmodified scene."""
    own = of.measurements[0]
    alone = {next(iter(one.setting.items())): one for one in of.measurements if len(one.setting) == 1}
    rows = []
    for knob in of.knobs():
        for value in knob.values:
            measured = own if value == knob.own else alone.get((knob.name, value))
            if measured is None or measured.errors is None:
                continue
            rows.append(
                {
                    **_where(of),
                    "knob": knob.name,
                    "value": value,
                    "own": measured is own,
                    "cost_factor": measured.cost_s / own.cost_s,
                    "error": measured.errors.judged,
                    "displacement": measured.errors.displacement,
                    "force": measured.errors.force,
                    "moved": measured.moved,
                }
            )
    return rows


def confirmations(of: Trade) -> list[Row]:
    """One row for each recommended setting: the sweep's result, and that of a second run from the written file."""
    head = of.head
    by_key = {one.key: one for one in of.measurements}
    promised = {OWN: of.measurements[0], **of.chosen()}
    promised |= {name: by_key[head[name]] for name in ("fastest", "most_accurate") if head[name]}
    what = {
        "fastest": f"the fastest within {report.percent(head['tolerance'])}",
        "most_accurate": f"the most accurate within {report.ms(head['budget_s'])} by the median",
    }
    confirmed = {
        name: Measurement.from_plain({**one, "machine": head["machine"]}) for name, one in head["confirmed"].items()
    }
    limits = trade.limits(head, promised, confirmed[OWN])
    offered = presets.all_presets().get(head["scene"], {})
    rows = []
    for name, again in confirmed.items():
        was = promised.get(name)
        preset = f"preset {name}" if head["machine"]["backend"] == PRESETS_BACKEND else f"{name} of these results"
        if was is None:  # a preset chosen from another machine's results
            short = name.removeprefix(trade.FOREIGN)
            title = name if offered.get(short) == head["presets"][short] else f"former {name}"
            rows.append(_foreign(of, title, head["presets"][short], again, confirmed[OWN]))
            continue
        title = what.get(name, preset if name != OWN else OWN)
        for dropped in head["dropped"].get(name, []):
            then = Measurement.from_plain({**dropped["again"], "machine": head["machine"]})
            verdict = f"not confirmed: {dropped['why']}"
            rows.append(_again(of, f"{title}, dropped", by_key[dropped["key"]], then, verdict))
        off = report.missed(was, again, limits.get(name, report.Limits()))
        rows.append(_again(of, title, was, again, f"not confirmed: {off}" if off else "confirmed"))
    missing = [what[name] for name in ("fastest", "most_accurate") if not head[name]]
    return rows + [_confirmation(of, text, "", verdict="no setting") for text in missing]


def doubt(reference: dict[str, Any], tolerance: float) -> str:
    """Which errors the reference is too coarse to judge; empty if it is fine enough for the tolerance."""
    known = [("displacement", reference["displacement_error"]), ("force", reference["force_error"] or 0.0)]
    words = [f"of {what} below {report.percent(error)}" for what, error in known if error > tolerance / 3]
    return f"errors {' and '.join(words)} say little" if words else ""


def files(backends: Sequence[str]) -> dict[str, list[Row]]:
    """Rows by the name of their CSV file."""
    trades = read(backends)
    tables = {"trade": settings, "trade-knobs": knobs, "trade-confirmed": confirmations}
    found = {name: [row for of in trades for row in rows_of(of)] for name, rows_of in tables.items()}
    # Older results have none, and a shallow press is an option.
    found["trade"] = _without_empty(found["trade"], ("force_held", "force_held_shallow", "force_moving"))
    return {name: rows for name, rows in (found | {"trade-calculix": trade_calculix.table()}).items() if rows}


def _without_empty(rows: list[Row], columns: Sequence[str]) -> list[Row]:
    """Rows without those of the columns in which no row has a value."""
    empty = {name for name in columns if all(row[name] is None for row in rows)}
    return [{name: value for name, value in row.items() if name not in empty} for row in rows]


def section(backends: Sequence[str]) -> list[str]:
    """Lines of docs/accuracy.md: what the fronts reach, how well each reference is known, what did not hold."""
    trades = read(backends)
    if not trades:
        return []
    heads = ["scene", "device", "commit", "reference error", "unmodified", "fastest in tolerance", "most accurate"]
    lines = [
        "",
        "## Accuracy against time",
        "",
        "`tensormass trade` compares each setting of a scene with the same scene, refined until it no longer moves. "
        "Error is that of displacement or of force on the tool, whichever is larger. Cost is the median time to "
        f"compute one step of the unmodified scene. Tolerance is {trade.TOLERANCE}.",
        "",
        *markdown(heads, [_front_row(of) for of in trades]),
        "",
        "Pictures: " + ", ".join(f"[{scene}]({trade.picture(scene)})" for scene in _scenes(trades)) + ".",
    ]
    unconfirmed = [row for of in trades for row in confirmations(of) if str(row["verdict"]).startswith("not ")]
    lines[-1] += (
        f" A second run did not confirm {len(unconfirmed)} of the settings that the sweeps recommended "
        "(`trade-confirmed.csv`, with their successors)."
        if unconfirmed
        else " A second run confirmed every recommended setting."
    )
    return [*lines, *trade_calculix.summary()]


def readme(backends: Sequence[str]) -> list[str]:
    """Lines of results/README.md: script, reference and command of each front, and which knobs were not varied."""
    lines = ["## Fronts", "", *_COLUMNS]
    for of in read(backends):
        head, reference = of.head, of.head["reference"]
        finest = reference["levels"][-1]
        force = "" if reference["force_error"] is None else f", force {report.percent(reference['force_error'])}"
        timed = [one.costs.timed_steps for one in of.measurements if one.costs]
        unsure = doubt(reference, head["tolerance"])
        lines += [
            "",
            f"### {head['scene']}, {head['machine']['backend']}",
            "",
            f"* Script: {head['script']}.",
            f"* Run: `{head['command']}`, commit `{head['commit']}`, {head['date']}, on "
            f"{'; '.join(dict.fromkeys((head['machine']['device'], head['host'])))}.",
            f"* Reference: {finest['element_count']} elements, {finest['step_count']} steps. Its own error by "
            f"Richardson extrapolation of order {reference['order']:.2f}: displacement "
            f"{report.percent(reference['displacement_error'])}{force}. It ended because: {reference['ended']}."
            + (f" So {unsure}." if unsure else ""),
            f"* Settings: {len(of.measurements)}, including {head['combinations']['measured']} combinations of "
            f"{head['combinations']['possible']} possible; each timed over {min(timed)} to {max(timed)} steps.",
            *(f"* Not varied: {name}: {why}" for name, why in head["not_varied"].items()),
        ]
    return lines


def preset_names(of: Trade) -> dict[str, list[str]]:
    """Names of the presets by the key of the setting that each of them has; only those measured here."""
    by_setting = {json.dumps(one.setting, sort_keys=True): one for one in of.measurements}
    named: dict[str, list[str]] = {}
    for name, setting in presets.all_presets().get(of.head["scene"], {}).items():
        if one := by_setting.get(json.dumps(setting, sort_keys=True)):
            named.setdefault(one.key, []).append(name)
    return named


def _front_row(of: Trade) -> list[str]:
    head, reference = of.head, of.head["reference"]
    by_key = {one.key: one for one in of.measurements}
    force = "" if reference["force_error"] is None else f", force {report.percent(reference['force_error'])}"

    def reached(measured: Measurement | None) -> str:
        if measured is None or measured.errors is None:
            return "no setting"
        return f"{report.percent(measured.errors.judged)} in {report.ms(measured.cost_s)}"

    fastest, best = (by_key.get(head[name]) for name in ("fastest", "most_accurate"))
    return [
        head["scene"],
        head["machine"]["device"],
        f"`{head['commit']}`",
        f"{report.percent(reference['displacement_error'])}{force}",
        reached(of.measurements[0]),
        reached(fastest),
        f"{reached(best)} (budget {report.ms(head['budget_s'])})",
    ]


def _scenes(trades: Sequence[Trade]) -> list[str]:
    return list(dict.fromkeys(of.head["scene"] for of in trades))


def _where(of: Trade) -> Row:
    return {"scene": of.head["scene"], "backend": of.head["machine"]["backend"]}


def _confirmation(
    of: Trade,
    recommended: str,
    setting: str,
    *,
    was: Measurement | None = None,
    again: Measurement | None = None,
    verdict: str,
) -> Row:
    def pair(name: str, value_of: Callable[[Measurement], float]) -> Row:
        return {
            name: value_of(was) if was and was.errors else None,
            f"{name}_again": value_of(again) if again and again.errors else None,
        }

    return {
        **_where(of),
        "recommended": recommended,
        "setting": setting,
        **pair("error", lambda one: one.errors.judged if one.errors else math.nan),
        **pair("cost_ms", lambda one: 1e3 * one.cost_s),
        **pair("cost_p99_ms", lambda one: 1e3 * one.slow_s),
        "verdict": verdict,
    }


def _again(of: Trade, title: str, was: Measurement, again: Measurement, verdict: str) -> Row:
    """A row for a setting of these results that was run once more."""
    if not was.errors or not again.errors:
        verdict = again.failure
    return _confirmation(of, title, report.setting_text(was.setting), was=was, again=again, verdict=verdict)


def _foreign(of: Trade, name: str, setting: Setting, again: Measurement, own: Measurement) -> Row:
    """A row for a preset that was chosen from another machine's results."""
    verdict = again.failure or f"{again.cost_s / own.cost_s:.2f} times as long as the unmodified scene"
    title = f"{name}, of the {PRESETS_BACKEND}'s results"
    return _confirmation(of, title, report.setting_text(setting), again=again, verdict=verdict)
