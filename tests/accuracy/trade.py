"""What the demo scenes' settings cost and reach: results/trade-<scene>-<backend>.jsonl, and the presets made of them.

python -m accuracy.trade [--backend cpu|cuda] [--quick] [--scene NAME]   measures; goes on where it was stopped
python -m accuracy.trade --presets                                       only makes the presets of the results anew
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

from tensormass import presets
from tensormass.cli import main as tensormass
from tensormass.processes import BUILD_BIN
from tensormass.scene import SceneFile
from tensormass.trade import report, sweep
from tensormass.trade.knobs import Knob, Knobs, Setting
from tensormass.trade.store import Measurement

from . import record

FOLDER = Path(__file__).parent / "results"
#: By name: options of `tensormass trade`. The probe presses the organ by its whole radius: the less of the surface it
#: touches, the more a force is one of the mesh. The beam sinks by a third of its length in the time given; later its
#: law, which softens under compression, turns it inside out, and there is no answer to converge to.
SCENES: dict[str, list[str]] = {"demo": ["--press", "1"], "beam": ["--seconds", "0.8"], "cantilever": []}
#: The machine whose results the presets are chosen from.
PRESETS_BACKEND = "cpu"
TOLERANCE = "2%"
#: The name under which the scene as it is is run again, beside the presets.
OWN = "as it is"
#: Before the name of a preset that is run on another machine than that whose results it is chosen from.
_FOREIGN = "preset "
#: Errors that differ by less are the same to anybody.
SAME_ERROR = 1.05
#: How many times as long as the scene as it is a preset takes at most, in median and in 99th percentile.
TIMES = {"fast": 1.0, "balanced": 1.0, "accurate": 2.0}


@dataclass(frozen=True)
class Trade:
    """One file of results. `head`: everything but the measurements."""

    head: dict
    measurements: list[Measurement]

    @staticmethod
    def read(scene: str, backend: str) -> Trade | None:
        path = _path(scene, backend)
        if not path.exists():
            return None
        head, *rows = (json.loads(line) for line in path.read_text().splitlines())
        return Trade(head, [Measurement.from_plain({**row, "machine": head["machine"]}) for row in rows])

    def chosen(self) -> dict[str, Measurement]:
        """What keeps the promises of the presets' names, in median and in 99th percentile; the first measurement, the
        scene as it is, does. None has another law, which would be another tissue, and none is one that left the promise
        when it was run again."""
        best = {"fast": lambda of: of.cost_s, "balanced": _error, "accurate": _error}
        kept = {
            name: [of for of in self._within(factor) if of.key not in self.dropped(name)]
            for name, factor in TIMES.items()
        }
        return {name: min(of, key=best[name]) for name, of in kept.items()}

    def dropped(self, name: str) -> list[str]:
        """Keys of what was recommended under a name and left its limit when it was run again."""
        return [of["key"] for of in self.head.get("dropped", {}).get(name, [])]

    def _within(self, factor: float) -> list[Measurement]:
        """Those that take at most so many times as long as the scene as it is, their slow steps too, and that are no
        less accurate, neither in what is seen nor in what is felt."""
        own = self.measurements[0]
        return [
            of
            for of in self.measurements
            if of.errors
            and "law" not in of.setting
            and of.cost_s <= factor * own.cost_s
            and of.slow_s <= factor * own.slow_s
            and _no_worse(of, own)
        ]


def _error(of: Measurement) -> float:
    assert of.errors
    return of.errors.judged


def _no_worse(of: Measurement, than: Measurement) -> bool:
    assert of.errors
    assert than.errors
    pairs = zip(of.errors.of_tolerance, than.errors.of_tolerance, strict=True)
    return all(ours <= SAME_ERROR * theirs for ours, theirs in pairs)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m accuracy.trade", description=__doc__.splitlines()[0])
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--scene", choices=SCENES, help="one of them")
    parser.add_argument("--quick", action="store_true", help="as `tensormass trade --quick`")
    parser.add_argument("--reference-seconds", default="1200", help="as of `tensormass trade`")
    parser.add_argument("--timing-seconds", default="5", help="as of `tensormass trade`")
    parser.add_argument("--presets", action="store_true", help="measure nothing")
    arguments = parser.parse_args()
    if not arguments.presets:
        for scene in [arguments.scene] if arguments.scene else SCENES:
            _measure(scene, arguments)
    _write_presets()
    return 0


def _measure(scene: str, arguments: argparse.Namespace) -> None:
    folder = folder_of(scene, arguments.backend)
    options = ["--tolerance", TOLERANCE, *SCENES[scene], *(["--quick"] if arguments.quick else [])]
    options += ["--reference-seconds", arguments.reference_seconds, "--timing-seconds", arguments.timing_seconds]
    content = _run(scene, arguments.backend, folder, options)
    # The presets, and what they would be by this front, are run once more as scene files; all else is there already.
    # One that leaves its promise makes room for the next.
    measurements = [Measurement.from_plain(row) for row in content["measurements"]]
    foreign = presets.all_presets().get(scene, {}) if arguments.backend != PRESETS_BACKEND else {}
    dropped: dict[str, list[dict]] = {}
    while True:
        chosen = Trade({"dropped": dropped}, measurements).chosen()
        settings = {OWN: {}, **{name: of.setting for name, of in chosen.items()}}
        files = _scene_files(scene, folder, settings | {_FOREIGN + name: of for name, of in foreign.items()})
        content = _run(scene, arguments.backend, folder, [*options, "--confirm", *map(str, files)])
        if not {file.stem for file in files} <= content["confirmed"].keys():  # it ended before; why has been said
            sys.exit(1)
        left = _leaving(content, chosen)
        if not left:
            break
        for name, of in left.items():
            dropped.setdefault(name, []).append(of)
    content["dropped"] |= dropped
    rows = content.pop("measurements")
    for name in ("fastest", "most_accurate"):
        content[name] = content[name] and content[name]["key"]
    again = [of["again"] for several in content["dropped"].values() for of in several]
    for of in [*content["confirmed"].values(), *again]:
        del of["machine"]
    del content["front"]
    head = {
        "scene": content.pop("scene"),
        "command": f"tensormass trade {scene} --backend {arguments.backend} {' '.join(options)}",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "commit": record.commit(),
        "host": record.machine(),
        "presets": foreign,
        **content,
    }
    lines = [head, *({name: of for name, of in row.items() if name != "machine"} for row in rows)]
    path = _path(scene, arguments.backend)
    path.write_text("".join(json.dumps(_rounded(line), ensure_ascii=False) + "\n" for line in lines))
    print(f"wrote {path}")


def _leaving(content: dict, chosen: dict[str, Measurement]) -> dict[str, dict]:
    """What left the promise of its name in the second run of trade.json, as `Dropped` has it."""
    confirmed = {name: Measurement.from_plain(of) for name, of in content["confirmed"].items()}
    limits = _limits(content, chosen, confirmed[OWN])
    return {
        name: {"key": of.key, "setting": of.setting, "why": why, "again": content["confirmed"][name]}
        for name, of in chosen.items()
        if of.setting and (why := report.beyond(confirmed[name], limits.get(name, report.Limits())))
    }


def _run(scene: str, backend: str, folder: Path, options: list[str]) -> dict:
    """trade.json of the command."""
    result = folder / "trade.json"
    result.unlink(missing_ok=True)
    tensormass(["trade", scene, "--backend", backend, "--out", str(folder), *options])
    if not result.exists():  # what was wrong has been said; that no setting is good enough is no error here
        sys.exit(1)
    return json.loads(result.read_text())


def _scene_files(scene: str, folder: Path, settings: dict[str, Setting]) -> list[Path]:
    knobs = Knobs(SceneFile.read(scene), folder / "meshes")
    files = [folder / f"{name}.yaml" for name in settings]
    for file, setting in zip(files, settings.values(), strict=True):
        knobs.write(setting, file, f"{file.stem} of {scene}, to be run again")
    return files


def _write_presets() -> None:
    chosen = {
        scene: {name: dict(of.setting) for name, of in trade.chosen().items()}
        for scene in SCENES
        if (trade := Trade.read(scene, PRESETS_BACKEND))
    }
    comment = (
        f"# Made by `make trade` of tests/accuracy/results/trade-*-{PRESETS_BACKEND}.jsonl; do not edit.\n"
        "# docs/accuracy.md says what each costs and reaches.\n"
    )
    presets.FILE.write_text(comment + yaml.safe_dump(chosen, sort_keys=False))
    print(f"wrote {presets.FILE}")


def section(backends: tuple[str, ...]) -> list[str]:
    """Of docs/accuracy.md."""
    trades = [trade for scene in SCENES for backend in backends if (trade := Trade.read(scene, backend))]
    if not trades:
        return []
    promises = "; ".join(f"`{name}` is {promise}" for name, promise in presets.PROMISES.items())
    lines = [
        "",
        "## Accuracy against time",
        "",
        "Made by `make trade`, which runs `tensormass trade` on the demo scenes: each setting against the same scene "
        f"refined until it no longer moves. Of the settings measured here on the {PRESETS_BACKEND} that keep the law, "
        f"{promises}; also in its slow steps (p99). They are points of the front of four: error of displacement, error "
        "of force, median and p99 of cost. No setting with the same law is as good in all of them and better in one, "
        "but for those that left the promise when they were run again and were dropped. The fronts below are other "
        "ones, of two: the larger error and the median, whatever the law. A preset need not be on them.",
        "",
        *(f"* {words}" for words in report.words()),
    ]
    for scene in dict.fromkeys(trade.head["scene"] for trade in trades):
        lines += ["", f"![Error against time, {scene}]({picture(scene)})"]
    for trade in trades:
        lines += _scene(trade)
    return lines


def picture(scene: str) -> str:
    """From docs/."""
    return f"images/trade-{scene}.svg"


def _scene(trade: Trade) -> list[str]:
    head = trade.head
    reference = head["reference"]
    force = "" if reference["force_error"] is None else f", of force {report.percent(reference['force_error'])}"
    finest = reference["levels"][-1]
    where = "; ".join(dict.fromkeys((head["machine"]["device"], head["host"])))
    by_setting = {json.dumps(of.setting, sort_keys=True): of for of in trade.measurements}
    named: dict[str, list[str]] = {}
    for name, setting in presets.all_presets().get(head["scene"], {}).items():
        if of := by_setting.get(json.dumps(setting, sort_keys=True)):  # else not measured on this machine
            named.setdefault(of.key, []).append(name)
    lines = [
        "",
        f"### {head['scene']}, {head['machine']['backend']}",
        "",
        f"{head['script']}. {where}; {head['date']}, commit `{head['commit']}`, `{head['command']}`.",
        "",
        f"Reference: {finest['element_count']} elements, {finest['step_count']} steps; its own error by Richardson "
        f"extrapolation of order {reference['order']:.2f}: of displacement "
        f"{report.percent(reference['displacement_error'])}{force}; {reference['ended']}. "
        f"{len(trade.measurements)} settings, {head['combinations']['measured']} of them combinations of "
        f"{head['combinations']['possible']} that are possible, each timed over {_timed(trade.measurements)} steps.",
        *_doubt(reference, head["tolerance"]),
        "",
        "The scene as it is, the front, and the presets:",
        "",
    ]
    shown = {trade.measurements[0].key, *(of.key for of in sweep.front(trade.measurements)), *named}
    by_cost = sorted((of for of in trade.measurements if of.key in shown), key=lambda of: of.cost_s)
    rows = [[", ".join(named.get(of.key, [])), *report.cells(of)] for of in by_cost]
    lines += _table(["preset", *report.HEADS], rows)
    lines += _confirmations(trade)
    knobs = [Knob(name, "", of["own"], tuple(of["values"])) for name, of in head["knobs"].items()]
    rows = [cells for cells, _ in report.knob_rows(knobs, trade.measurements)]
    lines += ["", "One knob at a time (× 1.00 is the scene as it is):", "", *_table(report.KNOB_HEADS, rows)]
    lines += ["", *(f"* not varied: {name}: {why}" for name, why in head["not_varied"].items())]
    return lines


def _timed(measurements: list[Measurement]) -> str:
    """How many steps the percentiles are of."""
    counts = [of.costs.timed_steps for of in measurements if of.costs]
    return f"{min(counts)} to {max(counts)}"


def _doubt(reference: dict, tolerance: float) -> list[str]:
    """Below which an error says nothing, where the reference could not be refined enough."""
    known = [("displacement", reference["displacement_error"]), ("force", reference["force_error"] or 0.0)]
    words = [f"of {what} below {report.percent(error)}" for what, error in known if error > tolerance / 3]
    if not words:
        return []
    return ["", f"**The reference is known no better than this: errors {' and '.join(words)} say little.**"]


def _confirmations(trade: Trade) -> list[str]:
    """What was recommended and then read from its file and run again, beside what it had promised."""
    head = trade.head
    by_key = {of.key: of for of in trade.measurements}
    own = trade.measurements[0]
    promised = {OWN: own, **trade.chosen()}
    promised |= {name: by_key[head[name]] for name in ("fastest", "most_accurate") if head[name]}
    what = {
        "fastest": f"the fastest within {report.percent(head['tolerance'])}",
        "most_accurate": f"the most accurate within {report.ms(head['budget_s'])} by the median",
    }
    confirmed = {
        name: Measurement.from_plain({**of, "machine": head["machine"]}) for name, of in head["confirmed"].items()
    }
    limits = _limits(head, promised, confirmed[OWN])
    offered = presets.all_presets().get(head["scene"], {})
    rows = []
    for name, again in confirmed.items():
        was = promised.get(name)
        preset = f"preset {name}" if head["machine"]["backend"] == PRESETS_BACKEND else f"{name} of these results"
        if was is None:
            short = name.removeprefix(_FOREIGN)
            is_now = offered.get(short) == head["presets"][short]
            rows.append(_foreign(name if is_now else f"former {name}", head["presets"][short], again, confirmed[OWN]))
            continue
        title = what.get(name, preset if name != OWN else OWN)
        for of in head["dropped"].get(name, []):
            then = Measurement.from_plain({**of["again"], "machine": head["machine"]})
            rows.append(_again(f"{title}, dropped", by_key[of["key"]], then, f"**not confirmed**: {of['why']}"))
        off = report.missed(was, again, limits.get(name, report.Limits()))
        rows.append(_again(title, was, again, f"**not confirmed**: {off}" if off else "confirmed"))
    heads = ["recommended", "setting", "error", "again", "cost", "again", "p99", "again", ""]
    missing = [what[name] for name in ("fastest", "most_accurate") if not head[name]]
    lines = ["", "What is recommended, written as a scene file, then read and run once more:", "", *_table(heads, rows)]
    return lines + [f"\n{text[0].upper()}{text[1:]}: no setting." for text in missing]


def _again(what: str, was: Measurement, again: Measurement, verdict: str) -> list[str]:
    """A row for a setting of these results that was run once more."""
    row = [what, report.setting_text(was.setting)]
    if not was.errors or not again.errors:
        return [*row, *["–"] * 6, f"**{again.failure}**"]
    row += [report.percent(was.errors.judged), report.percent(again.errors.judged)]
    return [*row, *(report.ms(of) for of in (was.cost_s, again.cost_s, was.slow_s, again.slow_s)), verdict]


def _limits(head: dict, promised: dict[str, Measurement], own: Measurement) -> dict[str, report.Limits]:
    """By name; those of presets are against `own`, the scene as it is run beside them, unless they are it."""
    within = {
        name: report.Limits(cost_s=factor * own.cost_s, slow_s=factor * own.slow_s)
        for name, factor in TIMES.items()
        if promised[name].setting and own.costs
    }
    return within | report.limits_of(head["tolerance"], head["budget_s"])


def _foreign(name: str, setting: Setting, of: Measurement, own: Measurement) -> list[str]:
    """A row for a preset that is not chosen from these results."""
    start = [f"{name}, of the {PRESETS_BACKEND}'s results", report.setting_text(setting)]
    if of.errors is None:
        return [*start, *["–"] * 6, f"**{of.failure}**"]
    times = f"{of.cost_s / own.cost_s:.2f} times as long as the scene as it is"
    return [*start, "–", report.percent(of.errors.judged), "–", report.ms(of.cost_s), "–", report.ms(of.slow_s), times]


def _table(heads: list[str], rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return lines + ["| " + " | ".join(cell.replace("_", " ") for cell in row) + " |" for row in rows]


def folder_of(scene: str, backend: str) -> Path:
    """Where a run is kept while it goes on, with the recording of its reference."""
    return BUILD_BIN.parent / "trade" / f"{scene}-{backend}"


def _path(scene: str, backend: str) -> Path:
    return FOLDER / f"trade-{scene}-{backend}.jsonl"


def _rounded(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        # Settings are exact: they are written into scene files.
        return {name: of if name in ("setting", "knobs", "presets") else _rounded(of) for name, of in value.items()}
    return [_rounded(of) for of in value] if isinstance(value, list) else value


if __name__ == "__main__":
    sys.exit(main())
