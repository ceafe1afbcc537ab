"""Runs the cases against a daemon of its own and writes results/<backend>.json.

python -m stability [--backend cpu|cuda] [--long] [--only TEXT] [--precision double|float]
"""

from __future__ import annotations

import argparse
import sys
import time

import tensormass as tm
from accuracy import record
from accuracy.engine import PRECISIONS, Engine

from . import report
from .case import HOLDS, judge
from .cases import all_cases


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m stability", description=__doc__.splitlines()[0])
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--long", action="store_true", help="also 10⁶ steps, an hour, millions of elements")
    parser.add_argument("--only", default="", help="cases whose key holds this text; writes no results")
    parser.add_argument("--precision", choices=tuple(PRECISIONS), help="one of them; writes no results")
    arguments = parser.parse_args()
    chosen = [case for case in all_cases() if arguments.only in case.key and (arguments.long or not case.long)]
    rows: list[report.Row] = []
    unexplained = 0
    start = time.monotonic()
    with tm.launch(backend=arguments.backend, zenoh=False) as server:
        device = server.version().device
        engines = {name: Engine(server, name) for name in PRECISIONS if arguments.precision in (None, name)}
        for case in chosen:
            for precision in case.precisions:
                if precision not in engines:
                    continue
                began = time.monotonic()
                row = report.Row(case.key, precision, judge(case, engines[precision]))
                rows.append(row)
                explained = case.explains(row.verdict.outcome, precision)
                unexplained += not explained
                if arguments.only or row.verdict.outcome != HOLDS:
                    print(row.line(explained, time.monotonic() - began), flush=True)
    print(f"{len(rows)} rows, {unexplained} unexplained, {time.monotonic() - start:.0f} s")
    if not arguments.only and not arguments.precision:
        run = report.Run(
            backend=arguments.backend,
            device=device,
            machine=record.machine(),
            commit=record.commit(),
            command=f"python -m stability --backend {arguments.backend}" + (" --long" if arguments.long else ""),
            date=time.strftime("%Y-%m-%d", time.gmtime()),
            seconds=round(time.monotonic() - start),
            rows=rows,
        )
        print(f"wrote {run.write()}")
    return int(unexplained > 0)


if __name__ == "__main__":
    sys.exit(main())
