"""Runs the cases against a daemon of its own and writes results/<backend>.json.

python -m accuracy [--backend cpu|cuda] [--together] [--only TEXT] [--precision double|float]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import tensormass as tm

from . import record, report
from .case import Case
from .cases import all_cases
from .engine import PRECISIONS, Engine


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, prog="python -m accuracy", description=__doc__.splitlines()[0])
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--together", action="store_true", help="both precisions at a time, each on its own daemon")
    parser.add_argument("--only", default="", help="cases whose key holds this text; writes no results")
    parser.add_argument("--precision", choices=tuple(PRECISIONS), help="one of them; writes no results")
    arguments = parser.parse_args()
    chosen = [case for case in all_cases() if arguments.only in case.key]
    precisions = [arguments.precision] if arguments.precision else list(PRECISIONS)
    start = time.monotonic()
    device, rows = measure(chosen, precisions, arguments.backend, together=arguments.together)
    failed = sum(not row.passed for row in rows)
    print(f"{len(rows)} rows, {failed} failed, {time.monotonic() - start:.0f} s")
    if not arguments.only and not arguments.precision:
        run_info = report.Run(
            backend=arguments.backend,
            device=device,
            machine=record.machine(),
            commit=record.commit(),
            command=f"python -m accuracy --backend {arguments.backend}" + " --together" * arguments.together,
            date=time.strftime("%Y-%m-%d", time.gmtime()),
            seconds=round(time.monotonic() - start),
            rows=rows,
        )
        print(f"wrote {run_info.write()}")
    return int(failed > 0)


def measure(
    cases: Sequence[Case], precisions: Sequence[str], backend: str, *, together: bool
) -> tuple[str, list[report.Row]]:
    """Name of the device, and all rows, precision by precision. together: precisions run at the same time, because a
    GPU spends most of these small cases waiting for the host."""

    def one(precision: str) -> tuple[str, list[report.Row]]:
        with tm.launch(backend=backend, zenoh=False) as server:
            engine = Engine(server, precision)
            return server.version().device, [run(case, engine) for case in cases if precision in case.bounds]

    with ThreadPoolExecutor(max_workers=len(precisions) if together else 1) as pool:
        parts = list(pool.map(one, precisions))
    return parts[0][0], [row for _, rows in parts for row in rows]


def run(case: Case, engine: Engine) -> report.Row:
    """The row of a case. A case that raises becomes a failed row."""
    try:
        outcome = case.run(engine)
    except Exception as error:  # a broken case is a failed row, and the others still run
        row = report.Row.broken(case, engine.precision, f"{type(error).__name__}: {error}")
    else:
        row = report.Row.of(case, engine.precision, outcome)
    verdict = "ok    " if row.passed else "FAILED"
    said = row.failure or f"{row.value:.9g}, error {row.error:.1e}, bound {row.bound}"
    print(f"{verdict} {engine.precision:6} {case.key}: {said}", flush=True)
    return row


if __name__ == "__main__":
    sys.exit(main())
