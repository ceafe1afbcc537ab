"""Edits of a load test: each scene is changed while its clients run, in every second part of the time."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from tensormass import SceneHandle, TensormassError
from tensormass.v1 import scene_pb2
from tensormass_tools import load_report
from tensormass_tools.load_report import Json

#: Parts of a test without and with edits, in turns.
_PARTS = ("without", "with", "without", "with")


def with_editing(scene: scene_pb2.Scene) -> scene_pb2.Scene:
    """Returns the scene with room for edits."""
    result = scene_pb2.Scene()
    result.CopyFrom(scene)
    result.editing.SetInParent()
    return result


class Edits:
    """Changes scenes from a thread of its own for each, and counts. Ablations and changes of stiffness take turns.

    Args:
        rate_hz: edits of each scene in a second.
    """

    def __init__(self, scenes: Sequence[SceneHandle], rate_hz: float) -> None:
        self._scenes = list(scenes)
        self._rate_hz = rate_hz
        self._lock = threading.Lock()
        self._seconds: list[float] = []
        self._refused: list[str] = []
        self._edits = [_edits(scene, number) for number, scene in enumerate(scenes)]

    def run(self, seconds: float, watch: Callable[[Callable[[], bool]], None]) -> Json:
        """Lets the test run so long, with edits in every second part. Returns what they cost.

        Args:
            watch: waits until its argument returns true, as `_LoadTest._watch` does.
        """
        parts = [self._part(kind, seconds / len(_PARTS), watch) for kind in _PARTS]
        return {
            "rate_hz": self._rate_hz,
            "calls": load_report.percentiles(np.array(self._seconds)),
            "refused": len(self._refused),
            "first_refusal": next(iter(self._refused), ""),
            "parts": parts,
        }

    def _part(self, kind: str, seconds: float, watch: Callable[[Callable[[], bool]], None]) -> Json:
        before = [scene.status() for scene in self._scenes]
        end = time.monotonic() + seconds
        threads = [threading.Thread(target=self._change, args=(edits, end)) for edits in self._edits if kind == "with"]
        for thread in threads:
            thread.start()
        try:
            watch(lambda: time.monotonic() >= end)
        finally:
            for thread in threads:
                thread.join()
        after = [scene.status() for scene in self._scenes]
        grown = zip(before, after, strict=True)
        steps, missed = np.sum([(a.step - b.step, a.missed_deadlines - b.missed_deadlines) for b, a in grown], axis=0)
        return {"name": kind, "steps": int(steps), "missed_deadlines": int(missed)}

    def _change(self, edits: Iterator[Callable[[], object]], end: float) -> None:
        while time.monotonic() < end:
            time.sleep(1 / self._rate_hz)
            begin = time.perf_counter()
            try:
                next(edits)()
            except TensormassError as refusal:  # as of the last element of a body
                with self._lock:
                    self._refused.append(str(refusal))
                continue
            with self._lock:
                self._seconds.append(time.perf_counter() - begin)


def _edits(scene: SceneHandle, seed: int) -> Iterator[Callable[[], object]]:
    random = np.random.default_rng(seed)
    assert scene.report is not None
    bodies = {body.name: iter(random.permutation(body.element_count).tolist()) for body in scene.report.bodies}
    for name, elements in itertools.cycle(bodies.items()):
        element = next(elements, None)
        if element is not None:
            yield partial(scene.edit, ablate={name: [element]})
        yield partial(scene.adjust, stiffness_factor={name: float(1 + 0.2 * random.random())})
