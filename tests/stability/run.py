"""Cases side by side: each job a process with a daemon of its own, each scene a thread of it.

On a GPU a step takes as long as its launches, however small the scene. The scenes of one daemon run side by side there,
those of several take turns: one job a device, with many scenes.

A row that breaks is run once more in the end, alone: a daemon that dies, or a device that fails, breaks all beside it.
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
    """One at a time, anew when it is gone."""

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
        """Its device has failed: nothing that comes from it is of use."""
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
    os._exit(1)  # its daemon ends with it


def run_case(case: Case, engine: Engine) -> Entry:
    began = time.monotonic()
    row = Row(case.key, engine.precision, judge(case, engine))
    return Entry(row, time.monotonic() - began)


def _work(
    backend: str, device: str | None, scenes: int, tasks: multiprocessing.Queue, done: multiprocessing.Queue
) -> None:
    """Until there are None for tasks, or whoever gives them is gone."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.setswitchinterval(1e-3)  # a thread that has its answer does not wait long for one that computes
    if device is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = device
    # A hardware queue for each scene's stream, or streams that share one wait for each other.
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
                except Exception as error:  # no daemon: a broken row, and the other jobs go on
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
    """Gives each row to `take` when it is there; after `limit_s` no more are begun. devices: as CUDA numbers them, one
    for each job, over and over; none leaves it to CUDA.
    """
    began = time.monotonic()
    context = multiprocessing.get_context("spawn")  # a fork would take the threads of a channel half
    tasks, done = context.Queue(), context.Queue()
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
        """In any order; so many bundles are given away before they are asked for."""
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
    # A few ahead, so that no thread waits and few are left at the limit.
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
    """What looks at one run (`Case.together`) is one thread's, where the first of it stands; any other row is alone."""
    together_of = {case.key: case.together for case in all_cases()}
    bundles: dict[tuple[str, ...], list[Task]] = {}
    for key, precision in tasks:
        together = together_of[key]
        bundles.setdefault((together, precision) if together else (key, precision, ""), []).append((key, precision))
    return list(bundles.values())


def tasks_of(cases: Sequence[Case], precisions: Sequence[str] = tuple(PRECISIONS)) -> list[Task]:
    return [(case.key, precision) for case in cases for precision in case.precisions if precision in precisions]
