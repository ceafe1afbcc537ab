"""Force on a probe of 5 mm that roams over the demo organ: its error against the time of a step. results/roam.jsonl

python -m accuracy.roam [--backend cpu|cuda] [--only PART] >> accuracy/results/roam.jsonl
python -m accuracy.roam --reference fine|coarse [--backend cuda] [--minutes M]

The first command steps the demo at its built-in resolutions along the committed path (roam_path.py), and compares the
force with that of the reference, 60 times a second. Errors are shares of the reference's largest force. Steps are timed
in further runs, many steps a call; their times are those of all steps.

The second command makes a reference, references/roam-<name>.json: quadratic tetrahedra, graded along the path
(roam_mesh.py), in double precision, with up to three Newton iterations in each of its 480 steps a second. The distance
of the coarse reference from the fine one says how well the fine one is known. If --minutes end before the reference
does, the state is kept, and the same command goes on from it. A reference covers the path up to `until_s`, which takes
nine minutes of an H200. Errors are of that part.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import tensormass as tm
from tensormass._shared.cache import cache_folder
from tensormass._src import mesh_files
from tensormass._src.launching import launch
from tensormass._src.meshes import FloatArray
from tensormass._src.organ import ORGANS, liver
from tensormass._src.scene_file import SceneFile
from tensormass.v1 import control_pb2, scene_pb2, stream_pb2
from tensormass_tools.trade.knobs import Knobs

from . import record, roam_mesh, roam_path

FOLDER = Path(__file__).parent
REFERENCES = FOLDER / "references"
#: A 99th percentile of fewer steps scatters.
_LEAST_TIMED_STEPS = 2000


@dataclass(frozen=True)
class Setting:
    """The demo as it is stepped. resolution: cells along an edge relative to the demo's file."""

    backend: str
    resolution: float
    rate_hz: float
    graded: bool = True
    newton_iterations: int = 1

    @property
    def name(self) -> str:
        kind = "graded at the demo's probe" if self.graded else "uniform"
        newton = f", {self.newton_iterations} Newton iterations" if self.newton_iterations > 1 else ""
        return f"{kind}, resolution {self.resolution:g}, {self.rate_hz:g} Hz{newton}"


SETTINGS = [
    *(Setting("cpu", resolution, 60) for resolution in (0.7, 0.8, 1.0, 1.2)),
    Setting("cpu", 1.0, 60, graded=False),
    Setting("cpu", 0.8, 60, newton_iterations=2),
    *(Setting("cuda", resolution, 960) for resolution in (1.0, 1.5, 1.8, 2.1, 2.5)),
    *(Setting("cuda", resolution, 960, graded=False) for resolution in (1.4, 1.7, 2.0)),
]


@dataclass(frozen=True)
class Reference:
    """A reference.

    resolution: of the uniform mesh that is refined within `bands_m` (roam_mesh.refine). until_s: its end on the path.
    """

    resolution: float
    bands_m: tuple[tuple[float, float], ...]
    rate_hz: float
    until_s: float = 4.36


MADE = {
    "fine": Reference(1.2, ((0.016, 0.0042), (0.009, 0.0021)), 480),
    "coarse": Reference(1.0, ((0.016, 0.0052), (0.009, 0.0030)), 480),
    # For a test that the command works.
    "rough": Reference(0.5, ((0.010, 0.0120),), 60),
}


# --- the scene --------------------------------------------------------------------------------------------------------


def reported(handle: tm.SceneHandle) -> control_pb2.SceneReport:
    """The report of a scene that this program loaded."""
    assert handle.report is not None
    return handle.report


def candidate(setting: Setting, path: roam_path.Path3) -> tm.Scene:
    knobs = Knobs(SceneFile.read("demo"), cache_folder() / "presets")
    values = {
        "resolution": setting.resolution,
        "grading": "graded" if setting.graded else "uniform",
        "dt_s": 1 / setting.rate_hz,
        "newton_max_iterations": setting.newton_iterations,
    }
    return _with_probe(knobs.apply(values).message(), path)


def refined(reference: Reference, path: roam_path.Path3, folder: Path) -> tm.Scene:
    organ = ORGANS["liver"]
    uniform = replace(organ, cell_m=organ.cell_m / reference.resolution).volume(graded=False)
    mesh = roam_mesh.refine(uniform, liver, path.touched_m, reference.bands_m)
    mesh_files.write_mesh(folder / "roam.msh", mesh)
    file = SceneFile.read("demo")
    fields = copy.deepcopy(file.fields)
    (body,) = fields["bodies"]
    body["mesh"]["file"] = str(folder / "roam.msh")
    body |= {"quadrature": "full", "element_order": "quadratic"}
    fields["stepping"] = {"dt_s": 1 / reference.rate_hz}
    scene = _with_probe(replace(file, fields=fields).message(), path)
    scene.set_solver(
        precision="double",
        newton_max_iterations=3,
        newton_tolerance=1e-3,
        cg_tolerance=1e-3,
        cg_max_iterations=1000,
    )
    return scene


def _with_probe(message: scene_pb2.Scene, path: roam_path.Path3) -> tm.Scene:
    """Replaces the demo's probe by that of the path, which may follow it at any speed."""
    (tool,) = message.tools
    tool.spherical_probe.radius_m = roam_path.RADIUS_M
    tool.max_speed_m_per_s = 1.0
    tool.position_m.x, tool.position_m.y, tool.position_m.z = path.positions_m[0]
    return tm.Scene(message=message)


# --- runs -------------------------------------------------------------------------------------------------------------


class Run:
    """A loaded scene that is stepped along the path."""

    def __init__(self, handle: tm.SceneHandle, path: roam_path.Path3, rate_hz: float) -> None:
        self.handle = handle
        self._tool = handle.topology().tools[0].name
        steps_a_sample = round(roam_path.SAMPLE_S * rate_hz)
        times_s = np.arange(1, steps_a_sample * len(path.times_s) + 1) / rate_hz
        self.poses: list[tuple[FloatArray, None, tuple[float, ...]]] = [(at, None, ()) for at in path.at(times_s)]
        self._samples = range(0, len(self.poses), steps_a_sample)
        self._steps_a_sample = steps_a_sample

    def forces(self, done: int = 0) -> Iterator[tuple[FloatArray, stream_pb2.SceneStatus]]:
        """Steps along the path after its first `done` samples. Yields force [3] N and status after each sample."""
        for first in self._samples[done:]:
            status = self.handle.follow(self._tool, self.poses[first : first + self._steps_a_sample])
            (force,) = (tool.force_n for tool in status.tools if tool.tool == self._tool)
            yield np.array([force.x, force.y, force.z]), status

    def times(self) -> tm.DurationHistogram:
        """Steps along the whole path until there are enough steps, and returns the times of all of them."""
        before = self.handle.step_times()
        while (times := self.handle.step_times() - before).count < _LEAST_TIMED_STEPS:
            self.handle.reset()
            self.handle.follow(self._tool, self.poses)
        return times


def errors(forces: FloatArray, reference: FloatArray) -> dict[str, float]:
    """Returns root mean square and largest error of the force vector, as shares of the reference's largest force.

    forces: [m, 3] N; reference: [n, 3] N with n ≤ m, of the first samples.
    """
    off = np.linalg.norm(forces[: len(reference)] - reference, axis=1)
    peak = float(np.linalg.norm(reference, axis=1).max())
    return {"force_error_rms": float(np.sqrt((off**2).mean())) / peak, "force_error_max": float(off.max()) / peak}


def measure(server: tm.Server, setting: Setting, path: roam_path.Path3, reference: FloatArray) -> dict[str, Any]:
    with server.load(candidate(setting, path), lockstep=True) as handle:
        run = Run(handle, path, setting.rate_hz)
        found = list(run.forces())
        times = run.times()
        (body,) = reported(handle).bodies
        iterations = [status.cg_iterations for _, status in found]
    return {
        "case": f"roam: {setting.name}",
        "elements": body.element_count,
        "dt_ms": round(1e3 / setting.rate_hz, 4),
        "steps": times.count,
        "compared_s": round(len(reference) * roam_path.SAMPLE_S, 2),
        **{name: round(value, 5) for name, value in errors(np.array([force for force, _ in found]), reference).items()},
        "step_ms_median": round(1e3 * times.p50_s, 4),
        "step_ms_p99": round(1e3 * times.p99_s, 4),
        "step_ms_p999": round(1e3 * times.p999_s, 4),
        "step_ms_max": round(1e3 * times.max_s, 4),
        "cg_iterations": float(np.median(iterations)),
        "min_det_f": round(min(status.min_det_f for _, status in found), 3),
    }


def make_reference(server: tm.Server, name: str, path: roam_path.Path3, minutes: float) -> bool:
    """Makes a reference, or goes on with it. Returns whether it is done."""
    began = time.monotonic()
    kept = cache_folder() / f"roam-{name}.npz"
    forces: list[FloatArray] = []
    unconverged_before, unconverged, seconds = 0, 0, 0.0
    samples = round(MADE[name].until_s / roam_path.SAMPLE_S)
    with (
        tempfile.TemporaryDirectory() as folder,
        server.load(refined(MADE[name], path, Path(folder)), lockstep=True) as handle,
    ):
        run = Run(handle, path, MADE[name].rate_hz)
        if kept.exists():
            with np.load(kept) as state:
                forces, seconds = list(state["forces"]), float(state["seconds"])
                unconverged_before = int(state["unconverged"])
                handle.restore(state["snapshot"].tobytes())
        for force, status in run.forces(len(forces)):
            forces.append(force)
            unconverged = unconverged_before + status.unconverged_steps  # a restored scene counts anew
            print(f"{len(forces)} of {samples}, {np.linalg.norm(force):.4f} N", file=sys.stderr, flush=True)
            if len(forces) == samples:
                break
            if time.monotonic() - began > 60 * minutes:
                kept.parent.mkdir(parents=True, exist_ok=True)
                snapshot = np.frombuffer(handle.snapshot(), np.uint8)
                seconds += time.monotonic() - began
                np.savez(kept, snapshot=snapshot, forces=forces, unconverged=unconverged, seconds=seconds)
                return False
        head = record.Head.of_run(server.version(), "accuracy.roam", began - seconds).head()
        (body,) = reported(handle).bodies
        head |= {"elements": body.element_count, "unconverged_steps": unconverged}
    rows = [
        {"time_s": round(float(at), 6), "force_n": [float(f) for f in force]}
        for at, force in zip(path.times_s[:samples], forces, strict=True)
    ]
    record.write(REFERENCES / f"roam-{name}.json", head, rows)
    kept.unlink(missing_ok=True)
    return True


# --- results ----------------------------------------------------------------------------------------------------------


def reference_forces(name: str) -> FloatArray:
    content = json.loads((REFERENCES / f"roam-{name}.json").read_text())
    return np.array([row["force_n"] for row in content["rows"]])


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--only", default="", metavar="PART", help="settings whose names contain this")
    parser.add_argument("--against", choices=tuple(MADE), default="fine", help="the reference; default: %(default)s")
    parser.add_argument("--reference", choices=tuple(MADE), help="make this reference instead")
    parser.add_argument("--minutes", type=float, default=8.0, metavar="M", help="time for it; default: %(default)g")
    args = parser.parse_args()
    path = roam_path.read()
    with launch(backend=args.backend, zenoh=False) as server:
        if args.reference:
            done = make_reference(server, args.reference, path, args.minutes)
            print("done" if done else "not done; the same command goes on", file=sys.stderr)
            return 0 if done else 3
        reference = reference_forces(args.against)
        said = server.version()
        for setting in SETTINGS:
            if setting.backend != args.backend or args.only not in setting.name:
                continue
            row = measure(server, setting, path, reference)
            where = {"backend": said.backend, "device": said.device, "machine": record.machine()}
            command = f"python -m accuracy.roam --backend {args.backend}"
            made = {"commit": record.commit(), "command": command, "against": args.against}
            print(json.dumps({**row, **where, **made}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
