"""The tables of choosing.md and decisions/trade.md, made of the measured fronts; their prose is written by hand.

A table stands between `<!-- made: NAME -->` and `<!-- end -->`, where NAME is one of `TABLES`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tensormass_tools.presets import FOR_BACKEND, all_presets
from tensormass_tools.trade import report
from tensormass_tools.trade.store import Measurement

from . import press, trade_tables
from .tables import filled, markdown
from .trade import FOREIGN, OWN, PRESETS_BACKEND, Trade

PAGE = Path(__file__).parents[2] / "docs" / "choosing.md"
DETAILS = PAGE.parent / "decisions" / "trade.md"
#: The demo in real time under the probe of a haptic client, as `tensormass run` steps it on a GPU.
BENCH = Path(__file__).parents[1] / "bench" / "results" / "nvidia-h200-demo-default.jsonl"


class NotMeasuredError(Exception):
    """The advice names a setting that the results do not have."""


@dataclass(frozen=True)
class Use:
    """A row of the decision table. setting: edits of the scene, as `tensormass trade` names them."""

    use: str
    scene: str
    backend: str
    setting: dict[str, Any] = field(default_factory=dict)


_BDF2 = {"integrator": "bdf2", "cg_max_iterations": 25, "cg_tolerance": 0.1}
_LOOSE = {"newton_tolerance": 0.01, "precision": "float"}
_TETRAHEDRA = {"shape": "tetrahedron", **_LOOSE}
USES = (
    Use("trainer, 60 Hz", "demo", "cpu"),
    Use("free motion, fast", "beam", "cpu", {"resolution": 0.5, "quadrature": "selective", "dt_s": 0.02, **_BDF2}),
    Use(
        "free motion, accurate",
        "beam",
        "cpu",
        {"shape": "hexahedron", "quadrature": "selective", "integrator": "bdf2"},
    ),
    Use(
        "free motion, fast",
        "beam",
        "cuda",
        {"resolution": 0.5, "quadrature": "selective", "dt_s": 0.02, **_BDF2, "cg_max_iterations": 10},
    ),
    Use(
        "free motion, accurate",
        "beam",
        "cuda",
        {"resolution": 1.4, "shape": "hexahedron", "quadrature": "selective", "integrator": "bdf2"},
    ),
    Use("analysis, fast", "cantilever", "cpu", {"resolution": 0.7, **_TETRAHEDRA}),
    Use("analysis", "cantilever", "cpu", _TETRAHEDRA),
    Use("analysis, fast", "cantilever", "cuda", {"cg_tolerance": 0.001, **_LOOSE}),
    Use("analysis", "cantilever", "cuda", {"resolution": 1.4, "cg_tolerance": 0.001, **_TETRAHEDRA}),
)
#: Single knobs that the second table shows: name and value.
KNOBS = (
    ("grading", "uniform"),
    ("element_order", "quadratic"),
    ("quadrature", "full"),
    ("resolution", 0.5),
    ("resolution", 1.4),
    ("resolution", 2.0),
    ("dt_s", "half"),
    ("integrator", "bdf2"),
    ("integrator", "quasi_static"),
    ("shape", "quadratic_tetrahedron"),
    ("newton_max_iterations", 5),
    ("newton_tolerance", 0.01),
    ("cg_max_iterations", 25),
    ("cg_tolerance", 0.1),
    ("precision", "double"),
    ("precision", "float"),
)


def outputs(backends: Sequence[str]) -> dict[Path, str]:
    """Both pages with their tables made anew."""
    trades = {(of.head["scene"], of.head["machine"]["backend"]): of for of in trade_tables.read(backends)}
    tables = {name: table(trades) for name, table in TABLES.items()}
    return {page: filled(page.read_text(), tables) for page in (PAGE, DETAILS)}


Trades = dict[tuple[str, str], Trade]


def sources(trades: Trades) -> list[str]:
    """Names the commit and the device of each front."""
    devices = dict.fromkeys(_device(of) for of in trades.values())
    said = []
    for device in devices:
        fronts = [(scene, of) for (scene, _), of in trades.items() if _device(of) == device]
        said.append(f"on {device}: " + ", ".join(f"`{scene}` `{of.head['commit']}`" for scene, of in fronts))
    return [
        f"Figures in the tables come from [committed fronts](../tests/accuracy/results/trade.csv), {'; '.join(said)}. "
        "Errors are relative to the same scene, refined."
    ]


def uses(trades: Trades) -> list[str]:
    """The decision table."""
    rows = [_haptic_row(trades["demo", PRESETS_BACKEND])]
    for use in USES:
        of = trades[use.scene, use.backend]
        measured = find(of, use.setting)
        assert measured.errors
        assert measured.costs
        values = {**_own(of), **use.setting}
        names = trade_tables.preset_names(of).get(measured.key, [])
        step = f"{report.ms(measured.costs.step_p50_s)} ({report.ms(measured.costs.step_p99_s)})"
        rows.append(
            [
                use.use,
                _device(of),
                ", ".join(f"`{use.scene} --preset {name}`" for name in names) or f"`{use.scene}`",
                _setting(values, measured.element_count),
                step,
                _error(measured),
            ]
        )
    return markdown(["use", "on", "scene", "mesh; law; time; solver", "step, median (p99)", "error"], rows)


def knobs(trades: Trades) -> list[str]:
    """Cost factor on each device and error of single knobs, scene by scene."""
    scenes = list(dict.fromkeys(scene for scene, _ in trades))
    rows = [["unmodified", *(_knob_cell(trades, scene, {}) for scene in scenes)]]
    for name, value in KNOBS:
        cells = []
        for scene in scenes:
            own = _own(trades[scene, PRESETS_BACKEND])
            meant = own.get(name, 0.0) / 2 if value == "half" else value
            cells.append("–" if own.get(name) == meant else _knob_cell(trades, scene, {name: meant}))
        rows.append([f"`{name}: {value}`" if value != "half" else "half the `dt_s`", *cells])
    return markdown(["setting", *(f"`{scene}`" for scene in scenes)], rows)


def presets(trades: Trades) -> list[str]:
    """Presets with their second run on each device, relative to the unmodified scene of the same run."""
    rows = []
    devices = list(dict.fromkeys(_device(of) for of in trades.values()))
    for scene in dict.fromkeys(scene for scene, _ in trades):
        fronts = {_device(of): of for (name, _), of in trades.items() if name == scene}
        by_setting: dict[str, list[str]] = {}
        for name, setting in all_presets().get(scene, {}).items():
            by_setting.setdefault(json.dumps(setting, sort_keys=True), []).append(name)
        for text, names in by_setting.items():
            setting = json.loads(text)
            cells = [_again(fronts[of], names[0], setting) if of in fronts else "not measured" for of in devices]
            own = "" if setting else " (unmodified)"
            rows.append([f"`{scene}`", ", ".join(f"`{name}`" for name in names) + own, *cells])
    return markdown(["scene", "preset", *devices], rows)


TABLES = {"sources": sources, "uses": uses, "knobs": knobs, "presets": presets}


def find(of: Trade, setting: dict[str, Any]) -> Measurement:
    """The measurement of a setting.

    Raises:
        NotMeasuredError: the results have no such setting, or it could not be run.
    """
    for measured in of.measurements:
        if measured.setting == setting and measured.errors:
            return measured
    where = f"{of.head['scene']} on {of.head['machine']['backend']}"
    raise NotMeasuredError(f"{where}: {report.setting_text(setting)} has no results; change it in advice.py")


def _own(of: Trade) -> dict[str, Any]:
    """Values of the unmodified scene. Scenes that are not varied in them are meshes of linear tetrahedra in full
    quadrature, or ask for equilibrium."""
    fixed = {
        "shape": "tetrahedron",
        "element_order": "as_given",
        "quadrature": "full",
        "integrator": "quasi_static",
    }
    return {**fixed, **{knob.name: knob.own for knob in of.knobs()}}


def _device(of: Trade) -> str:
    return str(of.head["machine"]["device"])


def _setting(values: dict[str, Any], element_count: int) -> str:
    dt = "" if values["integrator"] == "quasi_static" else f" of {1e3 * values['dt_s']:.3g} ms"
    time = _words(values["integrator"]) + dt
    return "; ".join([_mesh(values, element_count), _words(values["law"]), time, _solver(values)])


def _mesh(values: dict[str, Any], element_count: int) -> str:
    quadrature = "" if values["quadrature"] == "full" else f", {values['quadrature']} quadrature"
    resolution = values["resolution"]
    edge = "" if resolution == 1 else f", `resolution` {resolution:g}"
    order = "quadratic " if values["element_order"] == "quadratic" else ""
    return (
        _words(f"{element_count} {order}{values['shape']}s{quadrature}{edge}")
        .replace("hexahedrons", "hexahedra")
        .replace("tetrahedrons", "tetrahedra")
    )


def _solver(values: dict[str, Any]) -> str:
    newton = f"Newton {values['newton_max_iterations']}"
    if "newton_tolerance" in values:
        newton += f" to {values['newton_tolerance']:g}"
    return f"{newton}, CG {values['cg_max_iterations']} to {values['cg_tolerance']:g}, {values['precision']}"


def _error(measured: Measurement) -> str:
    assert measured.errors
    force = "" if measured.errors.force is None else f", force {report.percent(measured.errors.force)}"
    return report.percent(measured.errors.displacement) + force


def _words(text: str) -> str:
    return text.replace("_", " ")


def _haptic_row(of: Trade) -> list[str]:
    """The demo as `tensormass run` steps it on a GPU: times in real time, errors of the same setting in press.py."""
    bench = json.loads(BENCH.read_text().splitlines()[0])
    times = bench["step_time"]  # all answered poses; step_ms_median is of the run's last moment, without contact
    errors = press.row_of_default()
    assert errors["elements"] == bench["elements"]
    values = {**_own(of), **FOR_BACKEND["cuda"]["demo"]}
    return [
        "trainer, 1 kHz",
        bench["device"],
        "`demo`",
        _setting({**values, "dt_s": 1e-3 * bench["dt_ms"]}, bench["elements"]),
        f"{times['p50_ms']:.3g} ms ({times['p99_ms']:.3g} ms)",
        f"{report.percent(errors['displacement'])}, force {report.percent(errors['force'])}",
    ]


def _knob_cell(trades: Trades, scene: str, setting: dict[str, Any]) -> str:
    """`× 0.12 / 0.78: 23 %, force 86 %`: cost factors of the devices, error of the first that has measured it."""
    factors, errors = [], ""
    for of in (of for (name, _), of in trades.items() if name == scene):
        try:
            measured = find(of, setting)
        except NotMeasuredError:
            factors.append("–")
            continue
        cost = measured.cost_s / of.measurements[0].cost_s
        factors.append(f"{cost:.2g}" if setting else f"{1e3 * measured.cost_s:.3g}")
        errors = errors or _error(measured)
    start, unit = ("× ", "") if setting else ("", " ms")
    return f"{start}{' / '.join(factors)}{unit}: {errors}" if errors else "–"


def _again(of: Trade, name: str, setting: dict[str, Any]) -> str:
    """Cost relative to the unmodified scene, and error, in the second run."""
    head = of.head
    ours = head["machine"]["backend"] == PRESETS_BACKEND
    run = of.chosen()[name].setting if ours else head["presets"].get(name)
    confirmed = head["confirmed"].get(name if ours else FOREIGN + name)
    own = head["confirmed"].get(OWN)
    if run != setting or confirmed is None or own is None or not confirmed["errors"]:
        return "not measured"
    again, base = (Measurement.from_plain({**one, "machine": head["machine"]}) for one in (confirmed, own))
    return f"× {again.cost_s / base.cost_s:.2g}: {_error(again)}"
