"""Element fields of a scene as colours: asked for over gRPC, a few times a second, only while somebody shows them."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from typing import Protocol

import grpc
import numpy as np
import numpy.typing as npt

from tensormass.v1 import control_pb2, control_pb2_grpc, scene_pb2, stream_pb2
from tensormass_gateway.outbox import Stream, Watcher
from tensormass_gateway.surface import FIELDS, MismatchError, SurfaceMap

log = logging.getLogger(__name__)

INTERVAL_S = 0.25
"""Shortest time between two questions. A daemon that computes for longer gets as long a pause."""

TIMEOUT_S = 30.0

MAX_FIELD_BYTES = 64 << 20
"""Fields whose answers are larger are not asked for, because they would delay everything else."""


class Source(Protocol):
    """The parts of `feed.Feed` that a poll needs."""

    scene: str
    watchers: set[Watcher]
    topology: stream_pb2.Topology | None
    step: int | None

    @property
    def control(self) -> control_pb2_grpc.ControlStub: ...
    @property
    def known(self) -> scene_pb2.Scene | None: ...
    def key(self, stream: str) -> bytes: ...
    def shown_version(self, watcher: Watcher) -> int | None: ...
    def at_shown_vertices(self, watcher: Watcher, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]: ...


class FieldPoll:
    """Asks for the fields that the watchers of a feed show, and sends them on.

    A message is a line of JSON, {"field", "topology_version", "step"}, and the values at the vertices, float32
    little-endian [vertex_count]. Version and vertices are those of the topology that the watcher shows.
    """

    def __init__(self, feed: Source) -> None:
        self._feed = feed
        self._wanted = asyncio.Event()
        self._sent: dict[Watcher, tuple[str, int, int | None]] = {}
        """Field, topology and step that a watcher got last. A scene that stands still costs nothing."""

    def wake(self) -> None:
        """Looks again what the watchers show."""
        self._wanted.set()

    def forget(self, watcher: Watcher) -> None:
        """Sends the field to a watcher again, whose topology is new."""
        self._sent.pop(watcher, None)
        self.wake()

    async def run(self) -> None:
        """Polls until cancelled."""
        surface: tuple[stream_pb2.Topology, SurfaceMap | None] | None = None
        while True:
            await self._wanted.wait()
            names = {watcher.field for watcher in self._feed.watchers if watcher.field}
            topology, scene = self._feed.topology, self._feed.known
            if not names or topology is None or scene is None:
                self._wanted.clear()
                continue
            if surface is None or surface[0] is not topology:
                surface = (topology, await self._map(scene, topology))
            if surface[1] is None:
                self._wanted.clear()
                continue
            began = time.monotonic()
            for name in sorted(name for name in names if self._due(name, self._feed.step)):
                await self._send(name, topology, surface[1])
            await asyncio.sleep(max(INTERVAL_S, time.monotonic() - began))

    def _due(self, name: str, step: int | None) -> list[tuple[Watcher, tuple[str, int, int | None]]]:
        """Returns those who show `name` and have not seen it after `step`, and what they would have seen then."""
        versions = {
            watcher: self._feed.shown_version(watcher) for watcher in self._feed.watchers if watcher.field == name
        }
        states = {watcher: (name, version, step) for watcher, version in versions.items() if version is not None}
        return [(watcher, state) for watcher, state in states.items() if self._sent.get(watcher) != state]

    async def _map(self, scene: scene_pb2.Scene, topology: stream_pb2.Topology) -> SurfaceMap | None:
        try:
            return await asyncio.to_thread(SurfaceMap, scene, topology)
        except MismatchError as error:
            log.warning("scene %s: no element fields: %s", self._feed.scene, error)
            return None

    async def _send(self, name: str, topology: stream_pb2.Topology, surface: SurfaceMap) -> None:
        replies = {}
        for body, mapped in surface.bodies.items():
            components = 6 if name == "pressure" else 1
            count = sum(len(block.nodes) for block in mapped.mesh.blocks)
            if 8 * components * count > MAX_FIELD_BYTES:
                log.warning("scene %s: field %s of body %s is too large", self._feed.scene, name, body)
                return
            request = control_pb2.GetFieldsRequest(scene=self._feed.scene, body=body, fields=[FIELDS[name]])
            try:
                replies[body] = await self._feed.control.GetFields(request, timeout=TIMEOUT_S)
            except grpc.aio.AioRpcError as error:
                log.info("scene %s: no field %s: %s", self._feed.scene, name, error.details())
                return
        step = min((reply.step for reply in replies.values()), default=0)
        if not self._due(name, step) or self._feed.topology is not topology:
            return
        values = await asyncio.to_thread(surface.values, name, replies)
        if self._feed.topology is not topology:
            return
        self._sent = {old: sent for old, sent in self._sent.items() if old in self._feed.watchers}
        # Browsers may have come, gone or changed their minds while the values were computed.
        for watcher, state in self._due(name, step):
            head = {"field": name, "topology_version": str(state[1]), "step": step}
            line = json.dumps(head).encode() + b"\n"
            shown = self._feed.at_shown_vertices(watcher, values)
            watcher.outbox.offer(Stream.FIELD, self._feed.key(Stream.FIELD) + line + shown.tobytes())
            self._sent[watcher] = state
