"""One run of `tensormass trade`: measures, chooses, and runs again what was chosen."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from tensormass import InvalidArgumentError, NotConvergedError, SceneFile, Server, TensormassError
from tensormass._shared import defaults
from tensormass.v1 import scene_pb2
from tensormass_tools.trade import reference, report, sweep
from tensormass_tools.trade.arguments import (
    AGAIN,
    CANDIDATES,
    COMBINATIONS,
    QUICK_COMBINATIONS,
    QUICK_REFERENCE_S,
    QUICK_TIMING_S,
    REFERENCE_S,
    TIMING_S,
)
from tensormass_tools.trade.files import write_report, write_scene
from tensormass_tools.trade.knobs import Knobs, Setting
from tensormass_tools.trade.measures import compare
from tensormass_tools.trade.outcome import FASTEST, MOST_ACCURATE, Dropped, Outcome
from tensormass_tools.trade.recorder import Recorder
from tensormass_tools.trade.recording import Recording
from tensormass_tools.trade.reference import Reference
from tensormass_tools.trade.script import Script
from tensormass_tools.trade.store import Machine, Measurement, Store, key_of


class Trade:
    """One run of the command."""

    def __init__(self, args: argparse.Namespace, knobs: Knobs, script: Script, server: Server, store: Store) -> None:
        self._args = args
        self._knobs = knobs
        self._script = script
        self._store = store
        self._machine = Machine.of(server, args.cpu_threads)
        self._recorder = Recorder(server, knobs.message, script)
        self._dt_s = defaults.dt_s(knobs.message)
        self._timing_s: float = args.timing_seconds or (QUICK_TIMING_S if args.quick else TIMING_S)
        self._began = time.monotonic()
        self._compared_with: tuple[Reference, Recording]

    def measure(self, name: str) -> Outcome:
        args, knobs = self._args, self._knobs
        tolerance: float = args.tolerance
        limit_s = args.reference_seconds or (QUICK_REFERENCE_S if args.quick else REFERENCE_S)
        self._say(f"{name}: {self._script.text()}, on {self._machine.backend} ({self._machine.device})")
        own = self._own_recording()  # first, because a scene that cannot be run needs no reference
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
            raise InvalidArgumentError(f"the unmodified scene cannot be run: {raw[0].failure}")
        count = args.combinations
        if count is None:
            count = QUICK_COMBINATIONS if args.quick else COMBINATIONS
        budget_s = args.budget or self._dt_s
        chosen, possible = sweep.combinations(knobs, sweep.at_one_speed(raw), count, tolerance, budget_s)
        raw += self._all(chosen, found, own, f"combinations, of {possible} that are possible")
        while True:
            measured = sweep.at_one_speed(raw)
            candidates = {
                FASTEST: sweep.fastest_within(measured, tolerance, knobs),
                MOST_ACCURATE: sweep.most_accurate_within(measured, budget_s, tolerance, knobs),
            }
            # The best setting may be close to the reference by chance. Only the same setting, solved better, shows
            # that.
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
        """Reads and runs a recommended file. While it leaves its limit, replaces it by the next candidate.

        A setting that keeps the limit stays even if it was slower than before, because the next ones would be too.
        """
        name = path.stem
        limits = report.limits_of(outcome.tolerance, outcome.budget_s)[name]
        while True:
            again = self.run_again({name: SceneFile.read(path).message()})[name]
            promised, dropped = outcome.recommended[name], outcome.dropped.get(name, [])
            assert promised is not None
            best = None
            if left := report.beyond(again, limits):
                if len(dropped) + 1 < CANDIDATES:
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
            write_scene(outcome, name, path.parent)
            write_report(outcome, path.parent)  # the report names the written file even if its run fails

    def run_again(self, scenes: Mapping[str, scene_pb2.Scene]) -> dict[str, Measurement]:
        """Runs scenes by name against the same reference, without stored results. Their times can be compared, because
        they are taken in turns."""
        if scenes:
            self._say(f"running {', '.join(map(report.file_of, scenes))} again{', in turns' * (len(scenes) > 1)}")
        recordings = self._recorder.measure(list(scenes.values()), AGAIN * self._timing_s)
        again = {
            name: self._measurement(name, scene, recording, *self._compared_with)
            for (name, scene), recording in zip(scenes.items(), recordings, strict=True)
        }
        for name, of in again.items():
            self._say(f"{report.file_of(name)}: {of.failure or report.brief(of)}")
        return again

    def _own_recording(self) -> Recording:
        """Returns the recording of the unmodified scene, against which the change by each choice is measured."""
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
        """Measures a setting, or takes it from the store."""
        scene = self._knobs.apply(setting).message()
        key = key_of(scene, self._script, self._machine, f"{found.key} {self._timing_s} {dict(setting)}")
        if (known := self._store.get(key)) is not None:
            return known
        beside = [self._knobs.message] if setting else []
        recording, *turns = self._recorder.measure([scene], self._timing_s, beside=beside)
        measurement = replace(self._measurement(key, scene, recording, found, own), setting=dict(setting))
        of_own = turns[0] if turns else recording
        if isinstance(of_own, Recording):  # otherwise the device has no room for both
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
            # As in `tensormass solve`, a step without equilibrium is not a result.
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
            errors=compare(recording, found.recording, weights, self._script.held()),
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
