"""Pose to force and missed deadlines of a whole run: a scene in real time under haptic clients and viewers.

    python tests/bench/whole_run.py --seconds 3600 >> tests/bench/results/whole-run.jsonl
    python tests/bench/whole_run.py --backend cuda --steps 500000 >> tests/bench/results/whole-run.jsonl
    python tests/bench/whole_run.py --backend cuda --scenes 1,2,3 --seconds 60 >> tests/bench/results/whole-run.jsonl

The scene is what `tensormass run` makes of it on the backend, unless --resolution or --rate say otherwise. The clients
are those of `tensormass load-test`: each scene has a haptic client of its own, which presses and lifts its tool at 1
kHz. Every figure of a row is of the whole run: histograms of all steps and of all answered poses, and all deadlines.
With several numbers of scenes, each is a run and a row; `kept_least` is the share of deadlines that the worst scene
kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensormass._shared import defaults
from tensormass._src.packing import body_mesh
from tensormass._src.scene import Scene
from tensormass._src.scene_file import SceneFile
from tensormass_tools import load_arguments, load_report, load_test
from tensormass_tools.presets import FOR_BACKEND
from tensormass_tools.trade.knobs import Knobs, Setting

#: Histograms of the load test that a row keeps.
_KEPT = ("pose_to_force", "answered_pose_age", *load_report.PARTS_OF_THE_AGE, "frame_age")


def setting_of(args: argparse.Namespace) -> Setting:
    """What the command changes in the scene file."""
    setting = dict(FOR_BACKEND.get(args.backend, {}).get(args.scene, {}))
    if args.resolution is not None:
        setting["resolution"] = args.resolution
    if args.rate is not None:
        setting["dt_s"] = 1 / args.rate
    return setting


def measure(args: argparse.Namespace, scenes: int, scene_file: Path, seconds: float) -> dict[str, Any]:
    """Runs one load test and returns its row."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    load_arguments.add_arguments(parser)
    options = ["--scene", str(scene_file), "--backend", args.backend, "--transport", args.transport]
    options += ["--scenes", str(scenes), "--haptic", str(scenes), "--viewers", str(args.viewers)]
    report = load_test.load_test(parser.parse_args([*options, "--seconds", str(seconds)]))
    message = Scene.from_file(scene_file).message
    return {
        "case": f"whole run: {args.scene}",
        "elements": sum(body_mesh(body).element_count for body in message.bodies),
        "dt_ms": round(1e3 * defaults.dt_s(message), 4),
        "viewers": args.viewers,
        "transport": args.transport,
        **row_of(report),
    }


def row_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a load test's report: counts of all scenes together, and percentiles over all of them."""
    scenes, steps = report["scenes"], sum(scene["steps"] for scene in report["scenes"])
    missed = sum(scene["missed_deadlines"] for scene in scenes)
    times = load_report.merged_histogram(scene["step_times"] for scene in scenes)
    if steps and not times["count"]:
        sys.exit("the daemon does not count step times; start one of this version")
    return {
        "scenes": len(scenes),
        "haptic_clients": len(report["haptic"]),
        "seconds": round(report["seconds"], 1),
        "target_rate_hz": round(scenes[0]["target_rate_hz"], 3),
        "steps": steps,
        "missed_deadlines": missed,
        "missed_per_million": round(1e6 * missed / steps, 1) if steps else None,
        "kept_least": round(min(1 - scene["missed_fraction"] for scene in scenes), 6),
        "step_ms_median": _ms(times["p50_s"]),
        "step_ms_p99": _ms(times["p99_s"]),
        "step_ms_p999": _ms(times["p999_s"]),
        "step_ms_max": _ms(times["max_s"]),
        "largest_force_n": round(max((client["max_force_n"] for client in report["haptic"]), default=0.0), 3),
        **{name: _in_ms(report[name]) for name in _KEPT},
        "errors": report["errors"],
        "cpu_count": report["cpu_count"],
        "backend": report["server"]["backend"],
        "device": report["server"]["device"],
    }


def _in_ms(summary: Mapping[str, float]) -> dict[str, float]:
    percentiles = ((name.removesuffix("_s") + "_ms", _ms(value)) for name, value in summary.items() if name != "count")
    return {"count": summary["count"], **dict(percentiles)}


def _ms(seconds: float) -> float:
    return round(1e3 * seconds, 4)


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--scene", default="demo", help="a built-in scene; default: %(default)s")
    parser.add_argument("--resolution", type=float, help="cells along an edge, relative to the scene's file")
    parser.add_argument("--rate", type=float, metavar="HZ", help="steps a second")
    parser.add_argument("--scenes", default="1", metavar="N,..", help="numbers of scenes; default: %(default)s")
    parser.add_argument("--viewers", type=int, default=2, help="of all scenes together; default: %(default)s")
    parser.add_argument("--transport", choices=("mixed", "zeromq", "zenoh"), default="zeromq", help="%(default)s")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--seconds", type=float, default=60.0, help="of each run; default: %(default)g")
    length.add_argument("--steps", type=int, help="of each scene, instead")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as folder:
        knobs = Knobs(SceneFile.read(args.scene), Path(folder) / "meshes")
        scene_file = Path(folder) / f"{args.scene}.yaml"
        knobs.write(setting_of(args), scene_file, "made by whole_run.py")
        dt_s = defaults.dt_s(Scene.from_file(scene_file).message)
        for scenes in map(int, args.scenes.split(",")):
            row = measure(args, scenes, scene_file, args.steps * dt_s if args.steps else args.seconds)
            command = " ".join(["python tests/bench/whole_run.py", *sys.argv[1:]]).replace(
                f" --commit {args.commit}", ""
            )
            print(json.dumps({**row, "commit": args.commit, "command": command}), flush=True)
            failed |= bool(row["errors"])
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
