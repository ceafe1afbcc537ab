"""Runs the cases against daemons of its own and writes results/<backend>.json.

python -m stability [--backend cpu|cuda] [--long] [--only TEXT] [--precision double|float] [--jobs N] [--scenes N]
                    [--devices A,B] [--limit SECONDS] [--fresh] [--update]
python -m stability --merge JOURNAL...      runs nothing: makes results from journals of other machines

A run that was stopped, by `--limit` or otherwise, continues from build/stability/<backend>.jsonl; rows that broke run
again. By default a GPU gets one daemon with SCENES_OF_GPU scenes, and the CPU one daemon of one scene for each
processor.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import tensormass as tm
from accuracy import record
from accuracy.engine import PRECISIONS

from . import journal, report
from .case import HOLDS, Case
from .cases import all_cases
from .journal import Entry, Journal
from .run import run, tasks_of

# Parallel scenes of one daemon. Each scene's thread spins while it waits, so there are fewer than processors.
SCENES_OF_GPU = max(2, min(14, (os.cpu_count() or 1) - 2))


def main() -> int:
    parser = argparse.ArgumentParser(
        allow_abbrev=False, prog="python -m stability", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--backend", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--long", action="store_true", help="also 10⁶ steps, an hour, millions of elements")
    parser.add_argument(
        "--only", default="", help="run only cases whose key contains this text; writes results only with --update"
    )
    parser.add_argument(
        "--precision", choices=tuple(PRECISIONS), help="run only this precision; writes results only with --update"
    )
    parser.add_argument("--update", action="store_true", help="replace the rows of --only in the results")
    parser.add_argument("--jobs", type=int, help="daemons at a time; default: one a processor, or one a GPU")
    parser.add_argument("--scenes", type=int, help="scenes of each daemon at a time; default: 1, on a GPU up to 14")
    parser.add_argument("--devices", default="", metavar="A,B", help="GPUs, as CUDA numbers them; default: the first")
    parser.add_argument(
        "--limit", type=float, default=math.inf, metavar="SECONDS", help="start no case after this time"
    )
    parser.add_argument("--fresh", action="store_true", help="run everything again")
    parser.add_argument("--merge", nargs="+", type=Path, metavar="JOURNAL", help="run nothing, merge these journals")
    arguments = parser.parse_args()
    if arguments.merge:
        head, entries = journal.merged(arguments.merge)
        return _finish(head, entries, [case for case in all_cases() if head["long"] or not case.long])
    chosen = [case for case in all_cases() if arguments.only in case.key and (arguments.long or not case.long)]
    # Long cases first, so that none runs alone at the end. Of the others the cheap ones first, for the sake of --limit.
    chosen.sort(key=lambda case: (not case.long, case.solves))
    devices = [device for device in arguments.devices.split(",") if device]
    on_gpu = arguments.backend == "cuda"
    wanted = tasks_of(chosen, [arguments.precision] if arguments.precision else tuple(PRECISIONS))
    cases = {case.key: case for case in chosen}
    part = bool(arguments.only or arguments.precision)
    log = None if part else Journal(_path(arguments.backend), _head(arguments), arguments.fresh)
    entries = log.entries if log else {}
    missing = journal.missing(wanted, entries)
    if len(missing) < len(wanted):
        print(f"{len(wanted) - len(missing)} rows exist already; --fresh runs them again", flush=True)
    start = time.monotonic()

    def take(entry: Entry) -> None:
        if log:
            log.add(entry)
        else:
            entries[entry.row.task] = entry
        row = entry.row
        explained = cases[row.key].explains(row.verdict.outcome, row.precision)
        if part or not explained:
            print(row.line(explained, entry.seconds), flush=True)
        if len(entries) % 500 == 0:
            print(f"{len(entries)} of {len(wanted)} rows, {time.monotonic() - start:.0f} s", flush=True)

    run(
        missing,
        backend=arguments.backend,
        jobs=arguments.jobs or (max(1, len(devices)) if on_gpu else os.cpu_count() or 1),
        scenes=arguments.scenes or (SCENES_OF_GPU if on_gpu else 1),
        devices=devices,
        limit_s=arguments.limit,
        take=take,
    )
    print(f"{time.monotonic() - start:.0f} s")
    if log is None:
        rows = [entry.row for entry in entries.values()]
        held = sum(row.verdict.outcome == HOLDS for row in rows)
        unexplained = sum(not cases[row.key].explains(row.verdict.outcome, row.precision) for row in rows)
        if arguments.update:
            print(f"wrote {report.updated(_head(arguments), arguments.only, rows).write()}")
        print(f"{len(rows)} rows, {held} hold, {unexplained} unexplained")
        return int(unexplained > 0)
    log.close()
    return _finish(log.head, entries, chosen)


def _path(backend: str) -> Path:
    return journal.FOLDER / f"{backend}.jsonl"


def _head(arguments: argparse.Namespace) -> dict[str, Any]:
    with tm.launch(backend=arguments.backend, zenoh=False) as server:
        device = server.version().device
    return {
        "backend": arguments.backend,
        "device": device,
        "machine": record.machine(),
        "commit": record.commit(),
        "command": f"python -m stability --backend {arguments.backend}" + (" --long" if arguments.long else ""),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "long": arguments.long,
        "build": journal.build(),
        "cases": journal.cases_digest(),
    }


def _finish(head: dict[str, Any], entries: dict[tuple[str, str], Entry], cases: list[Case]) -> int:
    """Writes the results in the order of `all_cases` and prints what is missing; 1 if a row is unexplained."""
    of_page = {key: place for place, key in enumerate(case.key for case in all_cases())}
    wanted = sorted(tasks_of(cases), key=lambda task: of_page[task[0]])
    there = [entries[task] for task in wanted if task in entries]
    run_ = report.Run(
        **{name: head[name] for name in ("backend", "device", "machine", "commit", "command", "date")},
        seconds=round(sum(entry.seconds for entry in there)),
        rows=[entry.row for entry in there],
    )
    if not any(case.long for case in cases):
        run_ = report.with_long_rows(run_, {case.key for case in all_cases() if case.long})
    unexplained = report.unexplained_rows(run_)
    print(f"{len(there)} of {len(wanted)} rows, {len(unexplained)} unexplained")
    print(f"wrote {run_.write()}")
    return int(bool(unexplained))


if __name__ == "__main__":
    sys.exit(main())
