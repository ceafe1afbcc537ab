"""What 1 % costs: boxes that fall under their weight, the time of a step and iterations of its solves against error.

    python tests/bench/bodies.py [--backend cuda] [--commit HASH] >> tests/bench/results/bodies.jsonl

    beam       8 × 1 × 0.8 m, 1 MPa            organ      100 × 50 × 40 mm, 20 kPa
    ligament   40 × 5 × 4 mm, 1 MPa            (ν 0.4, 1000 kg/m³, stable neo-Hookean, clamped at x = 0)

A run makes 100 steps of 10 ms (implicit Euler) from the shape at rest. `error_percent` is |u − u*| / |u*| over all
nodes, the largest after 10, 20, 50 and 100 steps. u* is this server's own solution in double precision, Newton's
method to 1e-8.

    default          as a scene is that says nothing of its solver
    newton           two linearizations a step, otherwise the default
    linearized       one, solved to 1e-9 in double precision: the error that is left if each solve is exact
    plain, coarse    two linearizations and N iterations a solve, without and with the coarse level

`iterations_to_1_percent` is the smallest N of a list whose error is at most 1 % above that of two exact linearizations.
Times are the daemon's own, of all steps of a run made in one call.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

import tensormass as tm

_CHECKPOINTS = (10, 20, 50, 100)
_ITERATIONS = (5, 7, 10, 14, 20, 28, 40, 56, 80, 112, 160, 224, 320, 448, 640)
_EXACT: dict[str, Any] = {
    "precision": "double",
    "cg_max_iterations": 5000,
    "cg_tolerance": 1e-9,
    "newton_max_iterations": 50,
    "newton_tolerance": 1e-8,
}
_TWO = {"newton_max_iterations": 2, "newton_tolerance": 1e-12}


@dataclass(frozen=True)
class Body:
    name: str
    size_m: tuple[float, float, float]
    young_modulus_pa: float
    cells: dict[int, tuple[int, int, int]]  # by the number of tetrahedra


_SLENDER = {1920: (20, 4, 4), 43_200: (60, 12, 10), 307_200: (160, 20, 16)}
_BODIES = (
    Body("beam", (8.0, 1.0, 0.8), 1e6, _SLENDER),
    Body("organ", (0.1, 0.05, 0.04), 20e3, {1920: (10, 8, 4), 43_200: (30, 16, 15), 307_200: (64, 32, 25)}),
    Body("ligament", (0.04, 0.005, 0.004), 1e6, _SLENDER),
)


@dataclass
class Run:
    fields: list[npt.NDArray[np.float64]]
    times: Any
    iterations: int  # the last step's
    stopped: str = ""


def _scene(body: Body, size: int, solver: dict[str, Any]) -> tm.Scene:
    mesh = tm.grid(body.cells[size], body.size_m)
    nodes = np.asarray(mesh.nodes)
    scene = tm.Scene.from_arrays(
        nodes,
        mesh.blocks[0].nodes,
        name="bodies",
        law="stable_neo_hookean",
        young_modulus_pa=body.young_modulus_pa,
        poisson_ratio=0.4,
        density_kg_per_m3=1000.0,
        fixed_nodes=nodes[:, 0] < 1e-9,
        gravity_m_per_s2=(0, 0, -9.81),
    )
    scene.set_solver(**solver)
    scene.set_stepping(dt_s=0.01)
    return scene


def _run(server: tm.Server, body: Body, size: int, solver: dict[str, Any], *, timed: bool = True) -> Run:
    scene = _scene(body, size, solver)
    rest = np.asarray(tm.grid(body.cells[size], body.size_m).nodes)
    fields: list[npt.NDArray[np.float64]] = []
    with server.load(scene, lockstep=True) as handle:
        try:
            for begin, end in zip((0, *_CHECKPOINTS), _CHECKPOINTS, strict=False):
                handle.step(end - begin)
                fields.append(handle.positions("body") - rest)
        except tm.TensormassError as error:
            return Run(fields, None, 0, str(error))
        if not timed:
            return Run(fields, handle.step_times(), handle.status().cg_iterations)
    with server.load(scene, lockstep=True) as handle:
        handle.step(_CHECKPOINTS[-1])
        return Run(fields, handle.step_times(), handle.status().cg_iterations)


def _error_percent(run: Run, exact: Run) -> float:
    if len(run.fields) < len(_CHECKPOINTS):
        return float("inf")
    far = (np.linalg.norm(u - v) / np.linalg.norm(v) for u, v in zip(run.fields, exact.fields, strict=True))
    return float(f"{100 * max(far):.4g}")


def _settings() -> Iterator[tuple[str, dict[str, Any]]]:
    yield "default", {}
    yield "newton", _TWO
    yield "linearized", {**_EXACT, "newton_max_iterations": 1}


def _rows(server: tm.Server, body: Body, size: int) -> Iterator[dict[str, Any]]:
    exact = _run(server, body, size, _EXACT, timed=False)
    if exact.stopped:
        print(f"{body.name} {size}: the reference stopped: {exact.stopped}", file=sys.stderr)
        return
    case = {"case": f"body: {body.name} {size}", "elements": size}
    of_newton = _error_percent(_run(server, body, size, {**_EXACT, **_TWO}, timed=False), exact)
    for setting, solver in _settings():
        run = _run(server, body, size, solver)
        yield {**case, "setting": setting, **_measured(run), "error_percent": _error_percent(run, exact)}
    for setting, coarse in (("plain", False), ("coarse", True)):
        for count in _ITERATIONS:
            run = _run(
                server, body, size, {**_TWO, "cg_max_iterations": count, "cg_tolerance": 0.0, "coarse_level": coarse}
            )
            error = _error_percent(run, exact)
            if error > 1 + of_newton and count != _ITERATIONS[-1]:
                continue
            yield {
                **case,
                "setting": setting,
                **_measured(run),
                "error_percent": error,
                "iterations_to_1_percent": count if error <= 1 + of_newton else None,
            }
            break


def _measured(run: Run) -> dict[str, Any]:
    if run.times is None:
        return {"stopped": run.stopped}
    return {
        "step_ms_median": round(1e3 * run.times.p50_s, 4),
        "step_ms_p99": round(1e3 * run.times.p99_s, 4),
        "cg_iterations_last": run.iterations,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu", help="default: %(default)s")
    parser.add_argument("--sizes", default="1920,43200,307200", help="default: %(default)s")
    parser.add_argument("--commit", default="", help="commit of the daemon, for the result")
    args = parser.parse_args()
    command = f"python tests/bench/bodies.py --backend {args.backend} --sizes {args.sizes}"
    warnings.simplefilter("ignore", tm.FindingWarning)  # N iterations are meant to be too few
    with tm.launch(backend=args.backend, zenoh=False) as server:
        said = server.version()
        where = {"backend": said.backend, "device": said.device, "commit": args.commit, "command": command}
        for size in map(int, args.sizes.split(",")):
            for body in _BODIES:
                for row in _rows(server, body, size):
                    print(json.dumps({**row, **where}), flush=True)


if __name__ == "__main__":
    main()
