"""`tensormass trade`: measures a scene over its knobs and writes the settings worth having."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tensormass import defaults
from tensormass.client import Server, launch
from tensormass.errors import InvalidArgumentError, NotConvergedError, TensormassError, naming
from tensormass.files import replacing
from tensormass.output import print_json
from tensormass.scene import SceneFile, is_mesh_file
from tensormass.trade import html, reference, report, sweep
from tensormass.trade.knobs import Knobs, Setting
from tensormass.trade.measures import compare
from tensormass.trade.reference import Reference
from tensormass.trade.script import PRESS_RADII, TIMED_STEPS, Recorder, Recording, Script, check_same_scene
from tensormass.trade.store import Machine, Measurement, Store, key_of
from tensormass.v1 import scene_pb2

_COMBINATIONS = 24
_QUICK_COMBINATIONS = 6
_REFERENCE_S = 600.0
_QUICK_REFERENCE_S = 60.0
_TIMES_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
# Of the options that are numbers; beyond it nothing is meant, and nothing would end.
_MOST = 1e6
# What the command writes, and runs once more.
_FASTEST, _MOST_ACCURATE = "fastest", "most_accurate"
# Of each of the two; where so many leave their limit, another is no likelier to keep it.
_CANDIDATES = 3
# For the times of a setting. What is run again gets so many times as long: there slow ones are timed over enough steps.
_TIMING_S, _QUICK_TIMING_S = 5.0, 0.5
_AGAIN = 4


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """The options of `tensormass trade`."""
    # A bare mesh, which other commands take, does not say what happens to it.
    parser.add_argument("scene", help=scene_help.replace(" a mesh file,", ""))
    parser.add_argument(
        "--budget", type=parse_time_s, metavar="TIME", help="for the median step of the scene, as 1ms; default: its dt"
    )
    parser.add_argument(
        "--tolerance", type=parse_share, default=0.02, metavar="SHARE", help="of the error, as 2%% (default)"
    )
    parser.add_argument("--backend", choices=("auto", "cpu", "cuda"), default="auto", help="default: %(default)s")
    parser.add_argument("--cpu-threads", type=int, metavar="N", help="threads of the scene on the CPU")
    parser.add_argument("--seconds", type=parse_number, metavar="T", help="simulated time of the test run")
    parser.add_argument(
        "--press",
        type=parse_number,
        default=PRESS_RADII,
        metavar="RADII",
        help="how deep the tool presses, against its radius; default: %(default)s",
    )
    parser.add_argument("--knobs", metavar="A,B", help="only these; default: all that the scene has")
    parser.add_argument("--combinations", type=int, metavar="N", help=f"of several knobs; default: {_COMBINATIONS}")
    parser.add_argument(
        "--reference-seconds",
        type=parse_number,
        metavar="T",
        help=f"refine the reference no longer than this; default: {_REFERENCE_S:g}",
    )
    parser.add_argument(
        "--timing-seconds",
        type=parse_number,
        metavar="T",
        help=f"for the times of each setting, over {TIMED_STEPS} steps where they suffice; {_AGAIN} times as long for "
        f"what is run again; default: {_TIMING_S:g}",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help=f"nearest values only, {_QUICK_COMBINATIONS} combinations, {_QUICK_REFERENCE_S:g} s for the reference, "
        f"{_QUICK_TIMING_S:g} s for the times of each setting",
    )
    parser.add_argument(
        "--confirm",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="scene files to run through the same script in the end; the two that the command writes always are",
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FOLDER", help="for results and report; a run goes on where it was stopped"
    )
    parser.description = (
        "Runs a scene through a script over and over, with other meshes, laws, steps and solvers, and compares each "
        "run with the same scene refined until it no longer moves. Prints a table and writes report.html, trade.json "
        "and as scene files the fastest setting within the tolerance (fastest.yaml) and the most accurate one within "
        "the budget (most_accurate.yaml), which it then reads and runs again; one that leaves its limit in that run "
        f"makes room for the next best, up to {_CANDIDATES} of each. The error is that of displacement (L2) or of the "
        "tool's force, whichever is larger."
    )


def parse_time_s(text: str) -> float:
    """`1ms`, `500us`, `0.001s` -> seconds."""
    match = re.fullmatch(r"([0-9.eE+-]+?)\s*(us|ms|s)", text.strip())
    number, unit_s = (match[1], _TIMES_S[match[2]]) if match else ("", 0.0)
    return _positive(number, unit_s, text, "a time such as 1ms")


def parse_share(text: str) -> float:
    """`2%`, `0.02` -> 0.02."""
    stripped = text.strip()
    return _positive(stripped.removesuffix("%"), 0.01 if stripped.endswith("%") else 1.0, text, "a share such as 2%")


def parse_number(text: str) -> float:
    """`0.5` -> 0.5."""
    return _positive(text, 1.0, text, f"a number above 0 and below {_MOST:g}")


def _positive(number: str, unit: float, text: str, what: str) -> float:
    try:
        value = float(number) * unit
    except ValueError:
        value = 0.0
    if not 0 < value < _MOST:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value


@dataclass(frozen=True)
class Dropped:
    """What was recommended until its file left the limit."""

    promised: Measurement
    again: Measurement
    why: str

    def to_plain(self) -> dict[str, Any]:
        setting = {"key": self.promised.key, "setting": self.promised.setting}
        return {**setting, "why": self.why, "again": self.again.to_plain()}


@dataclass(frozen=True)
class Outcome:
    """What a run found. `measurements`: the scene as it is, single knobs, combinations."""

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
    #: For what is recommended, by the name of its file, the best first.
    candidates: dict[str, list[Measurement]]
    #: None: no setting is within the limit.
    recommended: dict[str, Measurement | None]
    #: What the written files do when they are read and run again, by name; then those of `--confirm`.
    confirmed: dict[str, Measurement] = field(default_factory=dict)
    #: What was recommended before, the first one first.
    dropped: dict[str, list[Dropped]] = field(default_factory=dict)

    @property
    def fastest(self) -> Measurement | None:
        return self.recommended[_FASTEST]

    @property
    def most_accurate(self) -> Measurement | None:
        return self.recommended[_MOST_ACCURATE]

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


def run(args: argparse.Namespace) -> int:
    """Measures, prints and writes; 0 if a setting is within the tolerance and one within the budget."""
    if args.combinations is not None and args.combinations < 0:
        raise InvalidArgumentError(f"--combinations {args.combinations}: must not be negative")
    if is_mesh_file(args.scene):
        raise InvalidArgumentError(f"{args.scene}: a bare mesh; write a scene file that says what happens to it")
    file = SceneFile.read(args.scene)
    message = file.scene().message
    folder = args.out or Path(f"trade-{message.name}")
    others = _read_others(args.confirm, folder)
    with launch(backend=args.backend, cpu_threads=args.cpu_threads, zenoh=False) as server:
        # What the daemon checks, everything from here on takes for granted.
        server.inspect(message)
        knobs = Knobs(file, folder / "meshes")
        if args.knobs is not None:
            knobs.choose(name.strip() for name in args.knobs.split(","))
        script = Script.of(message, args.seconds, args.press)
        for path, other in others.items():
            with naming(f"--confirm {path}"):
                server.inspect(other)
                check_same_scene(other, message, script)
        with _writing_to(folder):
            folder.mkdir(parents=True, exist_ok=True)
            trade = _Trade(args, knobs, script, server, Store(folder))
            outcome = trade.measure(message.name)
            scenes = [written for name in outcome.recommended if (written := _write_scene(outcome, name, folder))]
            # Now already: what was measured is kept, whatever becomes of the runs that follow.
            files = [*_write_report(outcome, folder), *scenes]
            for scene_file in scenes:
                outcome = trade.confirm(outcome, scene_file)
            outcome = replace(outcome, confirmed=outcome.confirmed | trade.run_again(_by_name(others)))
            _write_report(outcome, folder)
    print_json(outcome.to_plain()) if args.json else print(report.text(outcome, files))
    return 0 if outcome.fastest is not None and outcome.most_accurate is not None else 1


def _read_others(files: Sequence[Path], folder: Path) -> dict[Path, scene_pb2.Scene]:
    """The scenes of `--confirm`."""
    own = [(folder / f"{stem}.yaml").resolve() for stem in (_FASTEST, _MOST_ACCURATE)]
    others = {}
    for path in files:
        if path.resolve() in own:
            raise InvalidArgumentError(
                f"--confirm {path}: the command writes this file itself and runs it in any case; leave it out"
            )
        with naming("--confirm"):
            others[path] = SceneFile.read(path).scene().message
    return others


def _by_name(others: Mapping[Path, scene_pb2.Scene]) -> dict[str, scene_pb2.Scene]:
    """By the stems of their files; where two have the same, or that of a file of the command's own, by whole paths."""
    stems = Counter([_FASTEST, _MOST_ACCURATE, *(path.stem for path in others)])
    return {path.stem if stems[path.stem] == 1 else str(path.resolve()): scene for path, scene in others.items()}


@contextlib.contextmanager
def _writing_to(folder: Path) -> Iterator[None]:
    """A full disk, or a folder of somebody else's, in words."""
    try:
        yield
    except (TensormassError, BrokenPipeError):
        raise  # some of ours are OSErrors too; a pipe is none of the folder's
    except OSError as error:
        raise InvalidArgumentError(
            f"--out {folder}: cannot be written to: {error.strerror or error}; make room or name another folder; in "
            "this one the same command goes on where it was stopped"
        ) from error


class _Trade:
    """One run of the command."""

    def __init__(self, args: argparse.Namespace, knobs: Knobs, script: Script, server: Server, store: Store) -> None:
        self._args = args
        self._knobs = knobs
        self._script = script
        self._store = store
        self._machine = Machine.of(server, args.cpu_threads)
        self._recorder = Recorder(server, knobs.message, script)
        self._dt_s = defaults.dt_s(knobs.message)
        self._timing_s: float = args.timing_seconds or (_QUICK_TIMING_S if args.quick else _TIMING_S)
        self._began = time.monotonic()
        self._compared_with: tuple[Reference, Recording]

    def measure(self, name: str) -> Outcome:
        args, knobs = self._args, self._knobs
        tolerance: float = args.tolerance
        limit_s = args.reference_seconds or (_QUICK_REFERENCE_S if args.quick else _REFERENCE_S)
        self._say(f"{name}: {self._script.text()}, on {self._machine.backend} ({self._machine.device})")
        own = self._own_recording()  # first: a scene that cannot be run needs no reference
        found = reference.find(
            knobs,
            self._script,
            self._recorder,
            self._store,
            self._machine,
            tolerance=tolerance,
            limit_s=limit_s,
            say=self._say,
        )
        for line in [*report.not_felt(self._script, found), *report.not_refined(knobs, found)]:
            self._say(f"warning: {line}")
        self._compared_with = found, own
        singles = sweep.one_at_a_time(knobs, args.quick)
        raw = self._all(singles, found, own, "one knob at a time")
        if raw[0].errors is None:
            raise InvalidArgumentError(f"the scene as it is cannot be run: {raw[0].failure}")
        count = args.combinations
        if count is None:
            count = _QUICK_COMBINATIONS if args.quick else _COMBINATIONS
        budget_s = args.budget or self._dt_s
        chosen, possible = sweep.combinations(knobs, sweep.at_one_speed(raw), count, tolerance, budget_s)
        raw += self._all(chosen, found, own, f"combinations, of {possible} that are possible")
        while True:
            measured = sweep.at_one_speed(raw)
            candidates = {
                _FASTEST: sweep.fastest_within(measured, tolerance, knobs),
                _MOST_ACCURATE: sweep.most_accurate_within(measured, budget_s, tolerance, knobs),
            }
            # Whether what is best now is so by chance: only the same, solved better, can tell.
            telling = [knobs.solved_better(of[0].setting) for of in candidates.values() if of]
            telling = [of for of in telling if of not in [one.setting for one in raw]]
            if not telling:
                break
            raw += self._all(telling[:1], found, own, "solved better than what would be recommended")
        return Outcome(
            scene=name,
            knobs=knobs,
            script=self._script,
            machine=self._machine,
            reference=found,
            measurements=measured,
            combinations=len(chosen),
            possible_combinations=possible,
            tolerance=tolerance,
            budget_s=budget_s,
            candidates=candidates,
            recommended={name: next(iter(of), None) for name, of in candidates.items()},
        )

    def confirm(self, outcome: Outcome, path: Path) -> Outcome:
        """Reads and runs a recommendation; while it leaves its limit, writes the next candidate in its place.

        One that keeps the limit stays, though it be slower than before: so would be those that follow it."""
        name = path.stem
        limits = report.limits_of(outcome.tolerance, outcome.budget_s)[name]
        while True:
            again = self.run_again({name: SceneFile.read(path).scene().message})[name]
            promised, dropped = outcome.recommended[name], outcome.dropped.get(name, [])
            assert promised is not None
            best = None
            if left := report.beyond(again, limits):
                if len(dropped) + 1 < _CANDIDATES:
                    best = sweep.next_after(promised, again, outcome.candidates[name], limits.cost_s)
                instead = f"next: {report.setting_text(best.setting)}" if best else "no other takes its place"
                self._say(f"{report.file_of(name)} leaves its limit: {left}; {instead}")
            if best is None:
                return replace(outcome, confirmed={**outcome.confirmed, name: again})
            dropped = [*dropped, Dropped(promised, again, report.missed(promised, again, limits))]
            outcome = replace(
                outcome,
                recommended={**outcome.recommended, name: best},
                dropped={**outcome.dropped, name: dropped},
            )
            _write_scene(outcome, name, path.parent)
            _write_report(outcome, path.parent)  # names what lies there, whatever becomes of its run

    def run_again(self, scenes: Mapping[str, scene_pb2.Scene]) -> dict[str, Measurement]:
        """Runs scenes as their files have them, by name, against the same reference; never what the store knows of
        them. Their times can be compared: they are taken in turns."""
        if scenes:
            self._say(f"running {', '.join(map(report.file_of, scenes))} again{', in turns' * (len(scenes) > 1)}")
        recordings = self._recorder.measure(list(scenes.values()), _AGAIN * self._timing_s)
        again = {
            name: self._measurement(name, scene, recording, *self._compared_with)
            for (name, scene), recording in zip(scenes.items(), recordings, strict=True)
        }
        for name, of in again.items():
            self._say(f"{report.file_of(name)}: {of.failure or report.brief(of)}")
        return again

    def _own_recording(self) -> Recording:
        """Of the scene as it is: what a choice by itself changes is told against it."""
        key = key_of(self._knobs.message, self._script, self._machine, "own")
        recording = self._store.recording(key)
        if recording is None:
            recording = self._recorder.record(self._knobs.message)
            self._store.keep(key, recording)
        return recording

    def _all(self, settings: Sequence[Setting], found: Reference, own: Recording, what: str) -> list[Measurement]:
        measured = []
        for number, setting in enumerate(settings, 1):
            measurement = self._of_setting(setting, found, own)
            measured.append(measurement)
            result = measurement.failure or report.brief(measurement)
            self._say(f"{what}, {number}/{len(settings)}: {report.setting_text(setting)}: {result}")
        return measured

    def _of_setting(self, setting: Setting, found: Reference, own: Recording) -> Measurement:
        """From the store, if it is there."""
        scene = self._knobs.apply(setting).scene().message
        key = key_of(scene, self._script, self._machine, f"{found.key} {self._timing_s} {dict(setting)}")
        if (known := self._store.get(key)) is not None:
            return known
        beside = [self._knobs.message] if setting else []
        recording, *turns = self._recorder.measure([scene], self._timing_s, beside=beside)
        measurement = replace(self._measurement(key, scene, recording, found, own), setting=dict(setting))
        of_own = turns[0] if turns else recording
        if isinstance(of_own, Recording):  # else there is no room for both
            costs = of_own.costs
            measurement = replace(measurement, own_p50_s=costs.step_p50_s, own_p99_s=costs.step_p99_s)
        self._store.put(measurement)
        return measurement

    def _measurement(
        self,
        key: str,
        scene: scene_pb2.Scene,
        recording: Recording | TensormassError,
        found: Reference,
        own: Recording,
    ) -> Measurement:
        if not isinstance(recording, TensormassError) and self._knobs.quasi_static and recording.unconverged_steps:
            # As `tensormass solve` has it: what is no equilibrium is no result.
            recording = NotConvergedError("ended above newton_tolerance")
        if isinstance(recording, TensormassError):
            return Measurement(key, {}, self._machine, failure=str(recording))
        weights = self._recorder.weights
        steps_of_own = 1.0 if self._script.one_step else self._dt_s / defaults.dt_s(scene)
        return Measurement(
            key,
            {},
            self._machine,
            element_count=recording.element_count,
            errors=compare(recording, found.recording, weights),
            costs=recording.costs,
            moved=compare(recording, own, weights).displacement,
            cost_s=recording.costs.step_p50_s * steps_of_own,
            unconverged_steps=recording.unconverged_steps,
            min_det_f=recording.min_det_f,
            outside_share=recording.outside_share,
            warnings=recording.warnings,
        )

    def _say(self, text: str) -> None:
        minutes, seconds = divmod(int(time.monotonic() - self._began), 60)
        print(f"[{minutes:3d}:{seconds:02d}] {text}", file=sys.stderr, flush=True)


def _write_scene(outcome: Outcome, name: str, folder: Path) -> Path | None:
    """A setting that was asked for, as a file; None: there is none."""
    path = folder / f"{name}.yaml"
    measurement = outcome.recommended[name]
    if measurement is None:
        path.unlink(missing_ok=True)  # of an earlier run
        return None
    what = {
        _FASTEST: f"The fastest setting within {outcome.tolerance:.3g} of the reference",
        _MOST_ACCURATE: f"The most accurate setting within {1e3 * outcome.budget_s:.3g} ms by its median",
    }
    comment = [
        f"{what[name]}, made by `tensormass trade {outcome.scene}`.",
        f"{report.setting_text(measurement.setting)}: {report.brief(measurement)}",
        f"Measured on {outcome.machine.backend} ({outcome.machine.device}).",
    ]
    for of in outcome.dropped.get(name, []):
        tried = report.setting_text(of.promised.setting)
        comment.append(f"In place of one that left this limit when run again: {tried}")
    outcome.knobs.write(measurement.setting, path, "\n".join(comment))
    return path


def _write_report(outcome: Outcome, folder: Path) -> list[Path]:
    texts = {"report.html": html.page(outcome), "trade.json": json.dumps(outcome.to_plain(), indent=1) + "\n"}
    for name, text in texts.items():
        with replacing(folder / name) as aside:
            aside.write_text(text, "utf-8")
    return [folder / name for name in texts]
