"""Cost and error of the demo scenes' settings: results/trade-<scene>-<backend>.jsonl; presets and fits made of them.

python -m accuracy.trade [--backend cpu|cuda] [--quick] [--scene NAME]   measures; continues where it was stopped
python -m accuracy.trade --presets                                       only makes the presets from the results again
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tensormass._shared.processes import BUILD_BIN
from tensormass._src.scene_file import SceneFile
from tensormass_tools import presets
from tensormass_tools.cli import main as tensormass
from tensormass_tools.trade import report, sweep
from tensormass_tools.trade.knobs import Knob, Knobs, Setting
from tensormass_tools.trade.store import Measurement

from . import fits, record

FOLDER = Path(__file__).parent / "results"
#: By name: options of `tensormass trade`. The probe presses the organ by its whole radius, because the force depends
#: more on the mesh the less of the surface it touches. The beam sinks by a third of its length in the time given. Later
#: its law, which softens under compression, lets elements invert, and there is no answer to converge to.
SCENES: dict[str, list[str]] = {"demo": ["--press", "1"], "beam": ["--seconds", "0.8"], "cantilever": []}
#: The machine whose results the presets are chosen from.
PRESETS_BACKEND = "cpu"
TOLERANCE = "2%"
#: The name under which the unmodified scene runs again, beside the presets.
OWN = "as it is"
#: Prefix of a preset that was chosen from the results of another machine.
FOREIGN = "preset "
#: Errors within this factor count as equal.
SAME_ERROR = 1.05
#: The largest cost of a preset relative to the unmodified scene, in median and in 99th percentile.
TIMES = {"fast": 1.0, "balanced": 1.0, "accurate": 2.0}


@dataclass(frozen=True)
class Trade:
    """One file of results. head: everything but the measurements. The first measurement is the unmodified scene."""

    head: dict[str, Any]
    measurements: list[Measurement]

    @staticmethod
    def read(scene: str, backend: str) -> Trade | None:
        path = _path(scene, backend)
        if not path.exists():
            return None
        head, *rows = (json.loads(line) for line in path.read_text().splitlines())
        return Trade(head, [Measurement.from_plain({**row, "machine": head["machine"]}) for row in rows])

    def chosen(self) -> dict[str, Measurement]:
        """The best measurement for each preset that keeps its promise in median and in 99th percentile.

        The unmodified scene always keeps it. Other laws are excluded, because they are other tissues. So are settings
        that broke the promise in a second run."""
        best = {"fast": lambda of: of.cost_s, "balanced": _error, "accurate": _error}
        kept = {
            name: [of for of in self._within(factor) if of.key not in self.dropped(name)]
            for name, factor in TIMES.items()
        }
        return {name: min(of, key=best[name]) for name, of in kept.items()}

    def front(self) -> list[Measurement]:
        """The measurements to which no other is both cheaper and more accurate."""
        return sweep.front(self.measurements)

    def knobs(self) -> list[Knob]:
        """The knobs that the sweep turned, with the values that it tried."""
        return [Knob(name, "", knob["own"], tuple(knob["values"])) for name, knob in self.head["knobs"].items()]

    def dropped(self, name: str) -> list[str]:
        """Keys of settings that were recommended under a name and exceeded its limit in a second run."""
        return [of["key"] for of in self.head.get("dropped", {}).get(name, [])]

    def _within(self, factor: float) -> list[Measurement]:
        """Measurements within `factor` times the cost of the unmodified scene, by median and by p99, and no less
        accurate than it in displacement and in force. They keep its law."""
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
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m accuracy.trade", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--scene", choices=SCENES, help="one of them")
    parser.add_argument("--quick", action="store_true", help="as in `tensormass trade`")
    parser.add_argument("--reference-seconds", default="1200", help="as in `tensormass trade`")
    parser.add_argument("--timing-seconds", default="5", help="as in `tensormass trade`")
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
    # Presets, and the presets that this front would choose, run once more as scene files. One that breaks its promise
    # is replaced by the next best.
    measurements = [Measurement.from_plain(row) for row in content["measurements"]]
    foreign = presets.all_presets().get(scene, {}) if arguments.backend != PRESETS_BACKEND else {}
    dropped: dict[str, list[dict[str, Any]]] = {}
    while True:
        chosen = Trade({"dropped": dropped}, measurements).chosen()
        settings = {OWN: {}, **{name: of.setting for name, of in chosen.items()}}
        files = _scene_files(scene, folder, settings | {FOREIGN + name: of for name, of in foreign.items()})
        content = _run(scene, arguments.backend, folder, [*options, "--confirm", *map(str, files)])
        if not {file.stem for file in files} <= content["confirmed"].keys():  # it ended early and said why
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


def _leaving(content: dict[str, Any], chosen: dict[str, Measurement]) -> dict[str, dict[str, Any]]:
    """Settings that broke the promise of their name in the second run of trade.json, in the form of `Dropped`."""
    confirmed = {name: Measurement.from_plain(of) for name, of in content["confirmed"].items()}
    within = limits(content, chosen, confirmed[OWN])
    return {
        name: {"key": of.key, "setting": of.setting, "why": why, "again": content["confirmed"][name]}
        for name, of in chosen.items()
        if of.setting and (why := report.beyond(confirmed[name], within.get(name, report.Limits())))
    }


def _run(scene: str, backend: str, folder: Path, options: list[str]) -> dict[str, Any]:
    """Runs the command and returns its trade.json."""
    result = folder / "trade.json"
    result.unlink(missing_ok=True)
    tensormass(["trade", scene, "--backend", backend, "--out", str(folder), *options])
    if not result.exists():  # the command said why: perhaps no setting qualifies, which is not an error here
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
        "# docs/choosing.md says what each costs and how accurate it is.\n"
    )
    presets.FILE.write_text(comment + yaml.safe_dump(chosen, sort_keys=False))
    print(f"wrote {presets.FILE}")
    fits.write()


def picture(scene: str) -> str:
    """Path of the picture of a scene's fronts, relative to docs/."""
    return f"images/trade-{scene}.svg"


def limits(head: dict[str, Any], promised: dict[str, Measurement], own: Measurement) -> dict[str, report.Limits]:
    """Limits by name. Those of presets are relative to `own`, the unmodified scene timed beside them; the unmodified
    scene itself has none."""
    within = {
        name: report.Limits(cost_s=factor * own.cost_s, slow_s=factor * own.slow_s)
        for name, factor in TIMES.items()
        if promised[name].setting and own.costs
    }
    return within | report.limits_of(head["tolerance"], head["budget_s"])


def folder_of(scene: str, backend: str) -> Path:
    """Folder of a run in progress, with the recording of its reference."""
    return BUILD_BIN.parent / "trade" / f"{scene}-{backend}"


def _path(scene: str, backend: str) -> Path:
    return FOLDER / f"trade-{scene}-{backend}.jsonl"


def _rounded(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        # Settings stay exact, because they are written into scene files.
        return {name: of if name in ("setting", "knobs", "presets") else _rounded(of) for name, of in value.items()}
    return [_rounded(of) for of in value] if isinstance(value, list) else value


if __name__ == "__main__":
    sys.exit(main())
