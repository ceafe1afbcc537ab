"""The output of `tensormass trade` on a terminal, and the texts that the HTML page shares with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tensormass_tools.output import table
from tensormass_tools.trade import sweep
from tensormass_tools.trade.knobs import Knob, Knobs, Setting
from tensormass_tools.trade.outcome import Outcome
from tensormass_tools.trade.recorder import TIMED_STEPS
from tensormass_tools.trade.reference import Reference
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Measurement

#: Headings of `cells`.
HEADS = [
    "setting",
    "elements",
    "error",
    "displacement",
    "worst node",
    "force",
    "force held",
    "force moving",
    "angle",
    "work",
    "frequency",
    "damping",
    "volume",
    "cost",
    "step p50",
    "step p99",
    "latency",
    "memory",
    "energy",
    "moved",
]
#: Headings of `knob_rows`.
KNOB_HEADS = ["knob", "value", "cost", "error", "displacement", "force", "moved"]


def setting_text(setting: Setting) -> str:
    """Names a setting: `dt_s 0.01, law hencky`."""
    parts = [
        f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in setting.items()
    ]
    return ", ".join(parts) or "as it is"


def brief(measurement: Measurement) -> str:
    """Describes error and cost in a few words."""
    errors = measurement.errors
    if errors is None:
        return measurement.failure
    force = "" if errors.force is None else f", force {percent(errors.force)}"
    times = f"{ms(measurement.cost_s)} a step of the scene (median; p99 {ms(measurement.slow_s)})"
    return f"displacement {percent(errors.displacement)}{force}; {times}"


def cells(of: Measurement) -> list[str]:
    """Returns a row of a table under `HEADS`."""
    if of.errors is None or of.costs is None:
        return [setting_text(of.setting), *["–"] * (len(HEADS) - 1)]
    errors, costs = of.errors, of.costs
    energy = costs.step_energy_j
    return [
        setting_text(of.setting),
        str(of.element_count),
        percent(errors.judged),
        percent(errors.displacement),
        percent(errors.worst_node),
        percent(errors.force),
        " / ".join(percent(of) for of in (errors.force_held_shallow, errors.force_held) if of is not None) or "–",
        percent(errors.force_moving),
        "–" if errors.force_angle_rad is None else f"{math.degrees(errors.force_angle_rad):.2g}°",
        percent(errors.work),
        percent(errors.frequency),
        "–" if errors.damping is None else f"{errors.damping:+.3f}",
        percent(errors.volume),
        ms(of.cost_s),
        ms(costs.step_p50_s),
        ms(costs.step_p99_s),
        ms(costs.latency_p50_s),
        f"{costs.memory_bytes / 1e6:.3g} MB",
        "–" if energy is None else f"{1e3 * energy:.3g} mJ",
        percent(of.moved),
    ]


def knob_rows(knobs: Sequence[Knob], measurements: Sequence[Measurement]) -> list[tuple[list[str], str]]:
    """Returns a row for each value of each knob alone. Costs are factors of the unmodified scene's, the first
    measurement. Rows of the scene's own values are marked "front"."""
    base = measurements[0]
    alone = {next(iter(of.setting.items())): of for of in measurements if len(of.setting) == 1}
    rows = []
    for knob in knobs:
        for value in knob.values:
            of = base if value == knob.own else alone.get((knob.name, value))
            if of is None or of.errors is None:
                continue
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            cells = [knob.name, shown, f"× {of.cost_s / base.cost_s:.2f}", percent(of.errors.judged)]
            cells += [percent(of.errors.displacement), percent(of.errors.force), percent(of.moved)]
            rows.append((cells, "front" if of is base else ""))
    return rows


def percent(share: float | None) -> str:
    if share is None:
        return "–"
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"


def ms(time_s: float) -> str:
    return f"{1e3 * time_s:.3g} ms"


def words() -> list[str]:
    """Explains the columns."""
    return [
        "error: of displacement (L2 over volume and time) or of the force on the tool, whichever is larger",
        "force held: over the time for which the tool stays in (with two depths: shallow / deep); force moving: over "
        "the rest",
        "worst node: the largest difference of any point, against the largest displacement",
        "work: of pressing in; frequency and damping: of the free motion under the loads; volume: change of V / V0",
        f"step p50 and p99: over at least {TIMED_STEPS} steps of the repeated script, or as many as there was time "
        "for; for the unmodified scene, the medians of all its turns",
        "latency: pose to force over the control plane, in lockstep",
        "cost: median time to compute as much as one step of the scene simulates. Each setting is timed alternately "
        "with the unmodified scene and scaled by the machine's speed at that moment; times of second runs are not "
        "scaled",
        "energy: of the whole GPU for a step without pauses, with the tool at its deepest; if contact makes steps "
        "slow, these are slower than the median; –: not counted",
        "moved: displacement against the unmodified scene, changed by the choice alone",
    ]


def not_felt(script: Script, reference: Reference) -> list[str]:
    """Warns if the tool never touches the tissue, because its force is then not judged."""
    if script.tool is None or reference.recording.force.any():
        return []
    return [
        f"{script.tool!r} touches nothing in the reference: there is no force to compare, and every error is that of "
        "displacement alone; press deeper (--press), give it more time (--seconds) or speed (max_speed_m_per_s), or "
        "let it start closer"
    ]


def not_refined(knobs: Knobs, reference: Reference) -> list[str]:
    """Warns if the reference has the scene's own mesh."""
    if reference.refines_mesh:
        return []
    why = f"the mesh is not refined ({knobs.without['resolution']}): the reference has the same one"
    if reference.raises_order:
        return [
            f"{why} in quadratic tetrahedra; how far these are from the limit is not known, and the reference's own "
            "error leaves it out; compare with a finer mesh of your own"
        ]
    return [
        f"{why}, and every error, the reference's own too, leaves out that of the mesh, which may be larger than all "
        "of them; compare with a finer mesh of your own"
    ]


def findings(outcome: Outcome) -> list[str]:
    """Returns warnings about the result."""
    reference = outcome.reference
    lines = [*not_felt(outcome.script, reference), *not_refined(outcome.knobs, reference)]
    if reference.error > outcome.tolerance / 3:
        lines.append(
            f"the reference itself may be off by {percent(reference.error)}: errors of that size say little; give it "
            "--reference-seconds, or a machine that is faster"
        )
    if not reference.is_approached:
        lines.append(
            f"{reference.other_name} do not come closer to the reference when they are refined: the two do not have "
            "the same limit, or are not fine enough to show it; give it --reference-seconds"
        )
    if reference.levels[-1].min_det_f <= 0:
        lines.append(
            "the reference has inverted elements: the scene leaves the range of its law, and there "
            "is no answer to converge to; press less (--press), or take a law that stands compression"
        )
    broken = [of for of in outcome.measurements if of.errors is None]
    lines += [f"{setting_text(of.setting)} could not be run: {of.failure}" for of in broken]
    unconverged = [of for of in outcome.measurements if of.unconverged_steps]
    if unconverged:
        lines.append(f"{len(unconverged)} settings have steps that ended above their newton_tolerance")
    chosen = outcome.most_accurate
    if chosen is not None and chosen.slow_s > outcome.budget_s:
        lines.append(
            f"the most accurate within {ms(outcome.budget_s)} is so by its median; its p99 is {ms(chosen.slow_s)}, and "
            "a loop of a fixed rate misses such steps"
        )
    return lines


# Largest change of a time in the second run, as a factor. Less is the scatter of a shared machine.
_SAME_TIME = 1.5
_SAME_ERROR = 1.01


@dataclass(frozen=True)
class Limits:
    """Limits that a recommended setting must keep in its second run. Times like `Measurement.cost_s` [s]."""

    error: float = math.inf
    cost_s: float = math.inf
    slow_s: float = math.inf


def limits_of(tolerance: float, budget_s: float) -> dict[str, Limits]:
    """Returns the limits of each recommended file, by its name."""
    return {"fastest": Limits(error=tolerance), "most_accurate": Limits(cost_s=budget_s)}


def beyond(again: Measurement, limits: Limits) -> str:
    """Says by how much a run leaves the limits, or why it has no result; empty if it keeps them."""
    if again.errors is None:
        return again.failure
    off = [
        _above("error", again.errors.judged, limits.error, percent),
        _above("median", again.cost_s, limits.cost_s, ms),
        _above("p99", again.slow_s, limits.slow_s, ms),
    ]
    return "; ".join(filter(None, off))


def missed(promised: Measurement, again: Measurement, limits: Limits) -> str:
    """Says by how much a second run leaves the limits, or the results of the first run (error to 1 %, time to half);
    empty if it is confirmed."""
    if promised.errors is None or again.errors is None:
        return promised.failure or again.failure
    error, before = again.errors.judged, promised.errors.judged
    off = [beyond(again, limits)]
    if error > _SAME_ERROR * before:
        off.append(f"error {percent(error)}, {percent(before)} before")
    if again.cost_s > _SAME_TIME * promised.cost_s:
        off.append(f"median {ms(again.cost_s)}, {ms(promised.cost_s)} before")
    return "; ".join(filter(None, off))


def _above(what: str, value: float, limit: float, shown: Callable[[float], str]) -> str:
    return f"{what} {percent(value / limit - 1)} above {shown(limit)}" if value > limit else ""


def file_of(name: str) -> str:
    """Returns the scene file of a confirmation, by its stem or its whole path."""
    return name if Path(name).is_absolute() else f"{name}.yaml"


def confirmations(outcome: Outcome) -> list[str]:
    """Describes the second runs of the written files, including settings that were replaced."""
    limits = limits_of(outcome.tolerance, outcome.budget_s)
    lines = []
    for name in dict.fromkeys([*outcome.recommended, *outcome.confirmed]):
        file = file_of(name)
        for of in outcome.dropped.get(name, []):
            what = f"dropped from {file}, read and run again: {setting_text(of.promised.setting)}"
            lines.append(_run_again([what, of.why], of.again))
        if (again := outcome.confirmed.get(name)) is None:
            continue  # not run yet
        said = [f"{file}, read and run again"]
        if (was := outcome.recommended.get(name)) is not None:
            off = missed(was, again, limits[name])
            said += ["NOT CONFIRMED", off] if off else ["confirmed"]
        lines.append(_run_again(said, again))
    return lines


def _run_again(said: Sequence[str], again: Measurement) -> str:
    return ": ".join(dict.fromkeys([*said, brief(again)]))  # for a failed run, both are the failure


def picks(outcome: Outcome) -> list[tuple[str, str]]:
    """Describes the two recommended settings and what they reach."""
    wanted = [
        (f"fastest within {percent(outcome.tolerance)}", outcome.fastest, "none is that accurate"),
        (f"most accurate within {ms(outcome.budget_s)}, by the median", outcome.most_accurate, "none is that fast"),
    ]
    return [
        (what, f"{setting_text(of.setting)}: {brief(of)}" if of is not None else missing)
        for what, of, missing in wanted
    ]


def table_head(reference: Reference) -> list[str]:
    """Returns the text above the settings."""
    if reference.refines_mesh:
        return []
    if reference.raises_order:
        return ["errors against the same mesh in quadratic tetrahedra, which the reference does not refine"]
    return ["errors without that of the mesh, which the reference does not refine"]


def text(outcome: Outcome, written: Sequence[Path]) -> str:
    """Returns the report for a terminal."""
    front = {of.key for of in sweep.front(outcome.measurements)}
    rows = [["", *HEADS]]
    for of in sorted(outcome.measurements, key=lambda of: of.cost_s):
        rows.append(["*" if of.key in front else "", *cells(of)])
    machine = outcome.machine
    sections = [
        f"{outcome.scene}: {outcome.script.text()}\non {machine.backend} ({machine.device}), tensormassd "
        f"{machine.version}, build {machine.build}",
        "reference:\n" + "\n".join(f"  {line}" for line in outcome.reference.text()),
        "\n".join(
            [*table_head(outcome.reference), table(rows), "* on the front: no other is both faster and more accurate"]
        ),
        "\n".join(words()),
        "not varied:\n" + "\n".join(f"  {name}: {why}" for name, why in outcome.knobs.without.items()),
        f"measured: {len(outcome.measurements)} settings, {outcome.combinations} of them combinations of "
        f"{outcome.possible_combinations} that are possible",
    ]
    if lines := findings(outcome):
        sections.append("warnings:\n" + "\n".join(f"  {line}" for line in lines))
    sections.append("\n".join([*(f"{what}: {reached}" for what, reached in picks(outcome)), *confirmations(outcome)]))
    sections.append("written: " + ", ".join(map(str, written)))
    return "\n\n".join(sections)
