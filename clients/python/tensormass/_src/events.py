"""What happened in a scene, as an iterator."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tensormass._shared.enums import short_name
from tensormass._src.streams import Closing
from tensormass._src.subscriptions import Subscription
from tensormass.v1 import event_pb2

_KINDS = event_pb2.SceneEvent.Kind.DESCRIPTOR


@dataclass(frozen=True)
class Event:
    """Something that happened in a scene. See `SceneEvent` in event.proto."""

    #: Counts the events of a load from 1.
    sequence: int
    #: Steps of the scene when it happened.
    step: int
    #: On the server's clock, nanoseconds since the Unix epoch.
    server_time_ns: int
    #: ablated, piece_free, severed, broken, adjusted, reset, restored, guard, held, cut, cut_begun, cut_ended,
    #: tool_added or tool_removed; its number if of a newer daemon.
    kind: str
    #: Name of the body; empty: none in particular.
    body: str
    #: Name of the tool; empty: none in particular.
    tool: str
    #: What it counts follows from `kind`: a volume [m³], an area [m²], or a number of springs.
    value: float
    #: Where it happened, [3] m; None: nowhere in particular.
    position_m: npt.NDArray[np.float64] | None
    #: In words.
    text: str
    #: Name of the attachment whose springs these are; empty: none in particular.
    attachment: str = ""
    #: Work of fracture [J], of cut_ended.
    work_j: float = 0.0

    @staticmethod
    def from_message(message: event_pb2.SceneEvent) -> Event:
        """Decodes a message."""
        place = message.position_m
        known = message.kind in _KINDS.values_by_number
        return Event(
            sequence=message.sequence,
            step=message.step,
            server_time_ns=message.server_time_ns,
            kind=short_name(_KINDS, message.kind) if known else str(message.kind),
            body=message.body,
            tool=message.tool,
            value=message.value,
            position_m=np.array([place.x, place.y, place.z]) if message.HasField("position_m") else None,
            text=message.text,
            attachment=message.attachment,
            work_j=message.work_j,
        )


class EventStream(Closing, Iterator[Event]):
    """Iterates over the events of a scene, each once; see `SceneHandle.events`."""

    def __init__(self, subscription: Subscription[event_pb2.SceneEvents], timeout_s: float | None) -> None:
        #: Number of events that nobody will see, because more than 64 came between two messages.
        self.missed_count = 0
        self._subscription = subscription
        self._timeout_s = math.inf if timeout_s is None else timeout_s
        self._waiting: deque[Event] = deque()
        self._load = 0
        self._last = 0

    def __next__(self) -> Event:
        while not self._waiting:
            self._take(self._subscription.receive(self._timeout_s))
        return self._waiting.popleft()

    def _take(self, message: event_pb2.SceneEvents) -> None:
        if message.topology_version < self._load:
            return  # the load before; it was overtaken
        if message.topology_version > self._load:
            self._load, self._last = message.topology_version, 0
        for event in message.events:
            if event.sequence > self._last:
                # Those before the first message are the past of a scene, not a loss.
                self.missed_count += event.sequence - self._last - 1 if self._last else 0
                self._last = event.sequence
                self._waiting.append(Event.from_message(event))

    def close(self) -> None:
        """Ends the subscription."""
        self._subscription.close()
