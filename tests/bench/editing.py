"""What a scene pays for being editable, and how long an edit takes.

    python tests/bench/editing.py [--backend cuda] [--steps N] [--commit HASH] >> tests/bench/results/editing.jsonl

The built-in scene `retract` under its scripted hand, without its skin, is stepped in lockstep three times: as it is,
with `editing` and no edit, and with an edit in every second step that takes one element more. The three take turns of
32 steps, so that a slower moment of the machine slows all. `edit_ms` is the time of the whole call, from the client and
back; a call that changes nothing (`call_ms`) is measured beside it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

import numpy as np

import tensormass as tm
from tensormass_tools.hand import HandScript, script_of
from tensormass_tools.presets import read_for_backend

_NAME = "retract"
_TURN = 32
_EDIT_EVERY = 2


def _scene(backend: str, *, editing: bool) -> tm.Scene:
    scene = read_for_backend(_NAME, backend) or tm.Scene.from_file(_NAME)
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
        server.load(_scene(backend, editing=False), name="plain", lockstep=True) as plain,
        server.load(_scene(backend, editing=True), name="ready", lockstep=True) as ready,
        server.load(_scene(backend, editing=True), name="edited", lockstep=True) as edited,
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
        print("editing: done", file=sys.stderr)


if __name__ == "__main__":
    main()
