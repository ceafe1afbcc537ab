"""Error that a fixed number of iterations leaves in the falling beam, by mesh: results/iterations-<backend>.json.

python -m accuracy.iterations [--backend cpu|cuda] [--cells N,..] [--name NAME]

Each mesh is compared with the same mesh, solved to 1e-6 in double precision. So the error is that of the linear solves
alone. The step and its time are those of the benchmarks' beam: St-Venant-Kirchhoff's law, 10 ms, float.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import tensormass as tm
from tensormass._src.launching import launch
from tensormass._src.scene_file import SceneFile

from . import record

if TYPE_CHECKING:
    import numpy.typing as npt

FOLDER = Path(__file__).parent / "results"
#: Cells along the beam: 43,200, 307,200 and 2,457,600 tetrahedra.
CELLS = {80: (10, 9), 160: (20, 16), 320: (40, 32)}
ITERATIONS = (10, 15, 25, 50, 100, 200)
#: Time that the beam falls [s]. Later, fine meshes invert elements at the fixed end.
FALL_S = 0.45


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, prog="accuracy.iterations", description=__doc__)
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--cells", default="80,160,320", help="cells along the beam: 80, 160, 320")
    parser.add_argument("--name", help="results/iterations-NAME.json; default: the backend")
    args = parser.parse_args()
    began = time.monotonic()
    rows: list[dict[str, float | str]] = []
    with launch(backend=args.backend, zenoh=False) as server:
        version = server.version()
        for cells in map(int, args.cells.split(",")):
            reference = _fall(server, cells, 2000, "double")[0]
            for iterations in ITERATIONS:
                positions, times, residual = _fall(server, cells, iterations, "float")
                rows.append(_row(cells, iterations, positions - reference, reference, times, residual))
                print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    head = record.Head.of_run(version, "accuracy.iterations", began)
    record.write(FOLDER / f"iterations-{args.name or args.backend}.json", head.head(), rows)
    print(table(rows))
    return 0


def _fall(
    server: tm.Server, cells: int, iterations: int, precision: Literal["float", "double"]
) -> tuple[npt.NDArray[np.float64], tm.DurationHistogram, float]:
    """Lets the beam fall twice, first step by step. Returns its positions at the end, the times of the second fall's
    steps, which were made in one call, and the mean residual of the linear solves."""
    scene = tm.Scene(message=SceneFile.read("beam").message())
    grid = scene.message.bodies[0].mesh.grid
    grid.cells_x = cells
    grid.cells_y, grid.cells_z = CELLS[cells]
    tolerance = 1e-6 if precision == "double" else 0.0
    scene.set_solver(precision=precision, cg_max_iterations=iterations, cg_tolerance=tolerance)
    with server.load(scene, lockstep=True) as running:
        steps = round(FALL_S / scene.message.stepping.dt_s)
        residuals = [record.cg_relative_residual for record in running.steps(steps)]
        positions, before = running.positions("beam"), running.step_times()
        running.reset()
        running.step(steps)
        return positions, running.step_times() - before, float(np.mean(residuals))


def _row(
    cells: int,
    iterations: int,
    difference: npt.NDArray[np.float64],
    reference: npt.NDArray[np.float64],
    times: tm.DurationHistogram,
    residual: float,
) -> dict[str, float | str]:
    nodes_y, nodes_z = (count + 1 for count in CELLS[cells])
    rest = np.stack(
        np.meshgrid(
            *(np.linspace(0, size, n) for size, n in ((8, cells + 1), (1, nodes_y), (0.8, nodes_z))), indexing="ij"
        ),
        axis=-1,
    ).reshape(-1, 3)
    moved = reference - rest
    return {
        "tetrahedra": 6 * cells * CELLS[cells][0] * CELLS[cells][1],
        "iterations": iterations,
        "error": float(np.linalg.norm(difference) / np.linalg.norm(moved)),
        "tip_error": float(abs(difference[-1, 2] / moved[-1, 2])),
        "sideways_m": float(np.abs(difference[:, 1]).max()),
        "residual": residual,
        "step_p50_ms": times.p50_s * 1e3,
        "step_p99_ms": times.p99_s * 1e3,
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the rows as a table in Markdown."""
    lines = [
        "| tetrahedra | iterations | error | tip | sideways | mean residual | step p50 / p99 |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['tetrahedra']:,} | {row['iterations']} | {100 * row['error']:.2g} % | {100 * row['tip_error']:.2g} % "
        f"| {1e3 * row['sideways_m']:.2g} mm | {row['residual']:.2g} "
        f"| {row['step_p50_ms']:.3g} / {row['step_p99_ms']:.3g} ms |"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
