"""A scene whose surface changes at random, with a plain account of what a viewer must show.

The first coordinate of a vertex is its place in the frame. So what a viewer draws tells which vertices it took.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from tensormass.v1 import changes_pb2, event_pb2, stream_pb2

Face: TypeAlias = tuple[int, int, tuple[int, ...]]
"""A triangle: its body, its kind, and the places of its corners."""

VERSION = 1_800_000_000_000_000_001
FAN = 40


class ChangingScene:
    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        fan = np.array([(0, k, k + 1) for k in range(1, FAN - 1)], "<u4")
        self.topology = stream_pb2.Topology(
            scene="s",
            version=VERSION,
            bodies=[
                stream_pb2.BodySurface(name=name, first_vertex=first, vertex_count=FAN, triangles=fan.tobytes())
                for name, first in (("left", 0), ("right", FAN))
            ],
        )
        self.revision = 0
        self.sequence = 0
        self.history: dict[int, set[Face]] = {}
        """Faces that a viewer must show at each revision."""
        self._fan = [tuple(int(corner) for corner in triangle) for triangle in fan]
        self._start()
        self.history[0] = self._shown()

    def _start(self) -> None:
        self.appended = 0
        self._places: list[list[int]] = [[], []]
        self._corners: list[list[tuple[int, ...]]] = [[], []]
        self._kinds: list[list[int]] = [[], []]
        self._dead: list[set[int]] = [set(), set()]

    def change(self) -> None:
        """Kills and appends triangles; seldom takes all of it back."""
        self.revision += 1
        if self.random.random() < 0.1:
            self._start()
        else:
            for body in range(2):
                self._change_body(body)
        self.history[self.revision] = self._shown()

    def _change_body(self, body: int) -> None:
        random = self.random
        for _ in range(random.integers(0, 4)):
            self._places[body].append(2 * FAN + self.appended)
            self.appended += 1
        vertex_count = FAN + len(self._places[body])
        for _ in range(random.integers(0, 5)):
            self._corners[body].append(tuple(int(each) for each in random.choice(vertex_count, 3, replace=False)))
            self._kinds[body].append(int(random.integers(0, 3)))
        count = len(self._fan) + len(self._corners[body])
        self._dead[body] |= {int(each) for each in random.integers(0, count, random.integers(0, 4))}

    def _shown(self) -> set[Face]:
        shown: set[Face] = set()
        for body in range(2):
            corners = self._fan + self._corners[body]
            kinds = [0] * len(self._fan) + self._kinds[body]
            for number, triangle in enumerate(corners):
                if number not in self._dead[body]:
                    shown.add((body, kinds[number], tuple(self._place(body, vertex) for vertex in triangle)))
        return shown

    def _place(self, body: int, vertex: int) -> int:
        return body * FAN + vertex if vertex < FAN else self._places[body][vertex - FAN]

    def changes(self) -> changes_pb2.SurfaceChanges:
        message = changes_pb2.SurfaceChanges(
            topology_version=VERSION, revision=self.revision, appended_vertex_count=self.appended
        )
        if self.appended or any(self._dead) or any(self._corners):
            for body in range(2):
                message.bodies.add(
                    dead_triangles=packed(sorted(self._dead[body])),
                    appended_vertices=packed(self._places[body]),
                    appended_triangles=packed(self._corners[body]),
                    appended_kinds=bytes(self._kinds[body]),
                )
        return message

    def frame(self) -> stream_pb2.Frame:
        """Makes the next frame, at the present revision."""
        self.sequence += 1
        count = 2 * FAN + self.appended
        positions = np.zeros((count, 3), "<f4")
        positions[:, 0] = np.arange(count)
        positions[:, 1] = self.random.random(count)
        return stream_pb2.Frame(
            topology_version=VERSION,
            sequence=self.sequence,
            step=self.sequence,
            server_time_ns=self.sequence,
            revision=self.revision,
            positions=positions.tobytes(),
        )

    def seen(self, revision: int, vertex_count: int) -> set[Face]:
        """Returns what a viewer must show that has the changes of a revision and a frame of so many vertices."""
        return {face for face in self.history[revision] if max(face[2]) < vertex_count}


def packed(numbers: object) -> bytes:
    return np.array(numbers, "<u4").tobytes()


def faces_of(
    body: int, vertices: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer], kinds: npt.NDArray[np.integer]
) -> set[Face]:
    """Returns what is drawn of a body."""
    places = np.rint(vertices[:, 0]).astype(int)
    return {
        (body, int(kind), tuple(int(places[corner]) for corner in triangle))
        for triangle, kind in zip(triangles, kinds, strict=True)
    }


def body_changes(**change: bytes) -> changes_pb2.BodyChanges:
    """Kills a triangle of a fan, and appends a burnt one with a vertex of its own."""
    lists = {
        "dead_triangles": packed([3]),
        "appended_vertices": packed([2 * FAN]),
        "appended_triangles": packed([0, 1, FAN]),
        "appended_kinds": b"\2",
    }
    return changes_pb2.BodyChanges(**{**lists, **change})


def changes(
    *bodies: changes_pb2.BodyChanges, revision: int = 1, version: int = VERSION, appended: int = 1
) -> changes_pb2.SurfaceChanges:
    return changes_pb2.SurfaceChanges(
        topology_version=version, revision=revision, appended_vertex_count=appended, bodies=bodies
    )


NOTHING = changes_pb2.BodyChanges()


def events(first: int, last: int, version: int = VERSION) -> event_pb2.SceneEvents:
    message = event_pb2.SceneEvents(topology_version=version)
    for sequence in range(first, last + 1):
        message.events.add(sequence=sequence, kind=event_pb2.SceneEvent.KIND_ABLATED, value=1e-9, body="liver")
    message.events[-1].position_m.x = 1
    return message
