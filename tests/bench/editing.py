"""What a scene pays for being editable, and how long an edit takes.

    python tests/bench/editing.py [--backend cuda] [--steps N] [--commit HASH] >> tests/bench/results/editing.jsonl

The built-in scene `retract` under its scripted hand, without its skin, is stepped in lockstep three times: as it is,
with `editing` and no edit, and with an edit in every second step that takes one element more. The three take turns of
32 steps, so that a slower moment of the machine slows all. `edit_ms` is the time of the whole call, from the client and
back; a call that changes nothing (`call_ms`) is measured beside it.

A second row has `retract` in real time under its hand: five seconds without a change, five with ten changes of
stiffness a second, as a slider makes them, and five with ten ablations a second, in turns, three times. It says how
many deadlines each misses, and how long a change takes from the call to the answer. The next step has it then.

A third row has the scene `cut` in real time: its hand draws the scalpel through the liver, and through the air above
it, in turns, with a reset before each. Cuts are compiled beside the scene that steps.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of
from tensormass_tools.presets import read_for_backend

_NAME = "retract"
_TURN = 32
_EDIT_EVERY = 2
_CUT = "cut"
_ABOVE_M = 0.3
_WINDOW_S = 5.0
_BETWEEN_CHANGES_S = 0.1
_ROUNDS = 3
_POSES_HZ = 250


def _scene(name: str, backend: str, *, editing: bool) -> tm.Scene:
    scene = read_for_backend(name, backend) or tm.Scene.from_file(name)
    for body in scene.message.bodies:
        body.ClearField("skin")
        body.ClearField("texture")
    if editing:
        scene.message.editing.SetInParent()
    return scene


def _percentiles(prefix: str, seconds: list[float]) -> dict[str, float]:
    return {
        f"{prefix}_median": round(1e3 * float(np.percentile(seconds, 50)), 4),
        f"{prefix}_p99": round(1e3 * float(np.percentile(seconds, 99)), 4),
    }


def _measure(server: tm.Server, backend: str, steps: int) -> dict[str, Any]:
    path = script_of(_NAME)
    assert path is not None
    script = HandScript.read(path)
    random = np.random.default_rng(7)
    with (
        server.load(_scene(_NAME, backend, editing=False), name="plain", lockstep=True) as plain,
        server.load(_scene(_NAME, backend, editing=True), name="ready", lockstep=True) as ready,
        server.load(_scene(_NAME, backend, editing=True), name="edited", lockstep=True) as edited,
    ):
        message = plain.message
        assert message is not None
        assert edited.report is not None
        dt_s = message.stepping.dt_s if message.stepping.HasField("dt_s") else 1 / 60
        body = edited.report.bodies[0]
        burnt = iter(random.permutation(body.element_count).tolist())
        calls: list[float] = []
        edits: list[float] = []
        for first in range(0, steps, _TURN):
            poses = [script.at(step * dt_s) for step in range(first, min(first + _TURN, steps))]
            for scene in (plain, ready):
                scene.follow(script.tool, poses)
            for number, pose in enumerate(poses):
                edited.follow(script.tool, [pose])
                begin = time.perf_counter()
                edited.status()
                calls.append(time.perf_counter() - begin)
                if number % _EDIT_EVERY == 0:
                    begin = time.perf_counter()
                    edited.edit(ablate={body.name: [next(burnt)]})
                    edits.append(time.perf_counter() - begin)
        row: dict[str, Any] = {"case": f"editing: {_NAME}", "elements": body.element_count, "steps": steps}
        for name, scene in (("plain", plain), ("editing", ready), ("edited", edited)):
            of = scene.step_times()
            row |= {f"{name}_ms_median": round(1e3 * of.p50_s, 4), f"{name}_ms_p99": round(1e3 * of.p99_s, 4)}
        status = edited.status()
        return {
            **row,
            **_percentiles("call_ms", calls),
            **_percentiles("edit_ms", edits),
            "edits": len(edits),
            "removed_mm3": round(1e9 * status.removed_volume_m3, 1),
        }


@contextmanager
def _moving(scene: tm.SceneHandle, script: HandScript, above_m: float = 0.0) -> Iterator[None]:
    """The hand of the script in real time, on a thread. above_m: higher than the script says"""
    ends = threading.Event()

    def move() -> None:
        begin = time.monotonic()
        while not ends.wait(1 / _POSES_HZ):
            pose = script.at(time.monotonic() - begin)
            x, y, z = pose[0]
            scene.move_tool(script.tool, (x, y, z + above_m), *pose[1:])

    mover = threading.Thread(target=move)
    mover.start()
    try:
        yield
    finally:
        ends.set()
        mover.join()


def _measure_in_real_time(server: tm.Server, backend: str) -> dict[str, Any]:
    path = script_of(_NAME)
    assert path is not None
    script = HandScript.read(path)
    with server.load(_scene(_NAME, backend, editing=True), name="real-time", lockstep=False) as scene:
        assert scene.report is not None
        body = scene.report.bodies[0]
        random = np.random.default_rng(7)
        burnt = iter(random.permutation(body.element_count).tolist())
        factors = iter(1 + 0.1 * random.random(10_000))
        changes: dict[str, Callable[[], object]] = {
            "plain": lambda: None,
            "stiffness": lambda: scene.adjust(stiffness_factor={body.name: next(factors)}),
            "ablation": lambda: scene.edit(ablate={body.name: [next(burnt)]}),
        }
        seconds: dict[str, list[float]] = defaultdict(list)
        missed: dict[str, int] = defaultdict(int)
        steps: dict[str, int] = defaultdict(int)
        with _moving(scene, script):
            time.sleep(_WINDOW_S)
            for kind in list(changes) * _ROUNDS:
                before, end = scene.status(), time.monotonic() + _WINDOW_S
                while time.monotonic() < end:
                    time.sleep(_BETWEEN_CHANGES_S)
                    begin = time.perf_counter()
                    changes[kind]()
                    seconds[kind].append(time.perf_counter() - begin)
                after = scene.status()
                missed[kind] += after.missed_deadlines - before.missed_deadlines
                steps[kind] += after.step - before.step
        row: dict[str, Any] = {"case": f"editing: {_NAME} in real time", "elements": body.element_count}
        for kind in changes:
            row |= {f"{kind}_steps": steps[kind], f"{kind}_missed_deadlines": missed[kind]}
            if kind != "plain":
                row |= _percentiles(f"{kind}_call_ms", seconds[kind])
        return row


def _measure_cut(server: tm.Server, backend: str) -> dict[str, Any]:
    path = script_of(_CUT)
    assert path is not None
    script = HandScript.read(path)
    scene_ = read_for_backend(_CUT, backend) or tm.Scene.from_file(_CUT)
    times: dict[str, Any] = {}
    missed: dict[str, int] = defaultdict(int)
    with server.load(scene_, name="cut", lockstep=False) as scene:
        assert scene.report is not None
        time.sleep(1)
        area_m2 = 0.0
        for kind in ("air", "tissue") * _ROUNDS:
            scene.reset()
            before, steps = scene.status(), scene.step_times()
            with _moving(scene, script, _ABOVE_M if kind == "air" else 0.0):
                time.sleep(float(script.times_s[-1]))
            after = scene.status()
            of = scene.step_times() - steps
            times[kind] = of if kind not in times else times[kind] + of
            missed[kind] += after.missed_deadlines - before.missed_deadlines
            area_m2 = max(area_m2, after.cut_area_m2)
        row: dict[str, Any] = {
            "case": f"editing: {_CUT} in real time",
            "elements": scene.report.bodies[0].element_count,
        }
        row["cut_area_mm2"] = round(1e6 * area_m2, 1)
        for kind, of in times.items():
            row |= {f"{kind}_steps": of.count, f"{kind}_missed_deadlines": missed[kind]}
            row |= {f"{kind}_ms_median": round(1e3 * of.p50_s, 4), f"{kind}_ms_p99": round(1e3 * of.p99_s, 4)}
        return row


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=1024, help="steps of each scene; default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    with tm.launch(backend=args.backend, zenoh=False) as server:
        said = server.version()
        command = f"python tests/bench/editing.py --backend {args.backend} --steps {args.steps}"
        where = {"backend": said.backend, "device": said.device, "commit": args.commit, "command": command}
        print(json.dumps({**_measure(server, args.backend, args.steps), **where}), flush=True)
        print(json.dumps({**_measure_in_real_time(server, args.backend), **where}), flush=True)
        print(json.dumps({**_measure_cut(server, args.backend), **where}), flush=True)
        print("editing: done", file=sys.stderr)


if __name__ == "__main__":
    main()
