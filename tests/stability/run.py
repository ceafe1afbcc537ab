"""Runs cases in parallel: each job is a process with its own daemon, each scene a thread of that process.

On a GPU the time of a small step is its launch time. Scenes of one daemon run in parallel there, while daemons take
turns. So a GPU gets one job with many scenes.

A row that breaks runs once more at the end, alone. A daemon that dies or a device that fails also breaks the rows that
run at the same time.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence

import tensormass as tm
from accuracy.engine import PRECISIONS, Engine

from .case import BROKEN, DEVICE_FAILED, Case, Verdict, judge
from .cases import all_cases
from .journal import Entry
from .report import Row

Task = tuple[str, str]  # key and precision


class _Daemon:
    """A daemon that is started again if it has died."""

    def __init__(self, backend: str) -> None:
        self._backend = backend
        self._lock = threading.Lock()
        self._server: tm.Server | None = None

    def engine(self, precision: str) -> Engine:
        with self._lock:
            if self._server is None or self._server.process is None or not self._server.process.running:
                self.close()
                self._server = tm.launch(backend=self._backend, zenoh=False)
            return Engine(self._server, precision)

    def replace(self, engine: Engine) -> None:
        """Ends the daemon of an engine whose device has failed."""
        with self._lock:
            if self._server is engine.server:
                self.close()

    def close(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)  # the daemon ends with this process


def run_case(case: Case, engine: Engine) -> Entry:
    began = time.monotonic()
    row = Row(case.key, engine.precision, judge(case, engine))
    return Entry(row, time.monotonic() - began)


def _work(
    backend: str,
    device: str | None,
    scenes: int,
    tasks: multiprocessing.Queue[list[Task] | None],
    done: multiprocessing.Queue[Entry],
) -> None:
    """Runs tasks until each thread takes a None, or the parent process ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.setswitchinterval(1e-3)  # a thread with an answer must not wait long for one that computes
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device
    # One hardware queue for each scene's stream: streams that share a queue wait for each other.
    os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")
    cases = {case.key: case for case in all_cases()}
    daemon = _Daemon(backend)

    def loop() -> None:
        while (together := tasks.get()) is not None:
            for key, precision in together:
                try:
                    engine = daemon.engine(precision)
                    entry = run_case(cases[key], engine)
                    if DEVICE_FAILED in entry.row.verdict.text:
                        daemon.replace(engine)
                except Exception as error:  # no daemon: the row is broken, the other jobs continue
                    entry = Entry(Row(key, precision, Verdict(BROKEN, text=f"{type(error).__name__}: {error}")), 0.0)
                done.put(entry)

    threads = [threading.Thread(target=loop) for _ in range(scenes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    daemon.close()


def run(
    wanted: Sequence[Task],
    *,
    backend: str,
    jobs: int,
    scenes: int,
    limit_s: float,
    take: Callable[[Entry], None],
    devices: Sequence[str] = (),
) -> None:
    """Runs the tasks and calls `take(entry)` in this process as each row arrives, in any order.

    limit_s: no task starts later than this. devices: CUDA's numbers, given to the jobs in turn; empty lets CUDA choose.
    """
    began = time.monotonic()
    context = multiprocessing.get_context("spawn")  # a fork would copy a gRPC channel without its threads
    tasks: multiprocessing.Queue[list[Task] | None] = context.Queue()
    done: multiprocessing.Queue[Entry] = context.Queue()
    workers = [
        context.Process(
            target=_work,
            args=(backend, devices[job % len(devices)] if devices else None, scenes, tasks, done),
            daemon=True,
        )
        for job in range(jobs)
    ]
    for worker in workers:
        worker.start()

    def entries_of(bundles: list[list[Task]], ahead: int) -> Iterator[Entry]:
        """Yields entries in any order; `ahead` bundles are queued before the first one is done."""
        waiting, ends = iter(bundles), {bundle[-1] for bundle in bundles}
        rows = 0

        def feed() -> int:
            bundle = next(waiting, []) if time.monotonic() - began < limit_s else []
            if bundle:
                tasks.put(bundle)
            return len(bundle)

        for _ in range(ahead):
            rows += feed()
        while rows > 0:
            try:
                entry = done.get(timeout=1.0)
            except queue.Empty:
                if not any(worker.is_alive() for worker in workers):
                    raise RuntimeError("all jobs ended; their last words are above") from None
                continue
            rows += (feed() if entry.row.task in ends else 0) - 1
            yield entry

    broken: dict[Task, Entry] = {}
    # A few bundles ahead: no thread waits, and few are left in the queue at the limit.
    for entry in entries_of(bundles_of(wanted), ahead=jobs * (scenes + 2)):
        if entry.row.verdict.outcome == BROKEN:
            print(f"to be run again, alone: {entry.row.line(False, entry.seconds)}", flush=True)
            broken[entry.row.task] = entry
        else:
            take(entry)
    for entry in entries_of(bundles_of(list(broken)), ahead=1):
        del broken[entry.row.task]
        take(entry)
    for entry in broken.values():
        take(entry)
    for _ in range(jobs * scenes):
        tasks.put(None)
    for worker in workers:
        worker.join()


def bundles_of(tasks: Sequence[Task]) -> list[list[Task]]:
    """Puts the tasks that share a run (`Case.together`) into one bundle for one thread; any other task is alone."""
    together_of = {case.key: case.together for case in all_cases()}
    bundles: dict[tuple[str, ...], list[Task]] = {}
    for key, precision in tasks:
        together = together_of[key]
        bundles.setdefault((together, precision) if together else (key, precision, ""), []).append((key, precision))
    return list(bundles.values())


def tasks_of(cases: Sequence[Case], precisions: Sequence[str] = tuple(PRECISIONS)) -> list[Task]:
    return [(case.key, precision) for case in cases for precision in case.precisions if precision in precisions]
