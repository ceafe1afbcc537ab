"""What Prometheus scrapes of the gateway: the daemon's metrics as they are, and the gateway's own (docs/metrics.md)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_PREFIX = "tensormass_gateway_"


@dataclass(frozen=True)
class Counts:
    """The gateway's own numbers."""

    daemon_up: bool
    """Whether the daemon tells its metrics."""
    replaced_frames: Mapping[int, int]
    """Frames that each connected browser missed, by its place."""
    max_browsers: int
    refused_connections: int
    closed_for_errors: int
    malformed_messages: int


def to_text(counts: Counts) -> str:
    """Writes Prometheus's text format."""
    replaced = [(f'{{browser="{place}"}}', count) for place, count in sorted(counts.replaced_frames.items())]
    lines = [
        *_family("daemon_up", "gauge", "1: the daemon's metrics are in this answer.", counts.daemon_up),
        *_family("browsers", "gauge", "Browsers that are connected.", len(counts.replaced_frames)),
        *_family("browsers_limit", "gauge", "Browsers that are let in at once.", counts.max_browsers),
        *_head("frames_replaced_total", "counter", "Frames of its scene that a browser missed for newer ones."),
        *(f"{_PREFIX}frames_replaced_total{labels} {count}" for labels, count in replaced),
        *_family("refused_connections_total", "counter", "Requests that were not let in.", counts.refused_connections),
        *_family("closed_connections_total", "counter", "Browsers that broke the protocol.", counts.closed_for_errors),
        *_family(
            "malformed_messages_total",
            "counter",
            "Messages of the daemon that could not be read.",
            counts.malformed_messages,
        ),
    ]
    return "\n".join(lines) + "\n"


def _head(name: str, kind: str, meaning: str) -> Iterable[str]:
    return f"# HELP {_PREFIX}{name} {meaning}", f"# TYPE {_PREFIX}{name} {kind}"


def _family(name: str, kind: str, meaning: str, value: int) -> Iterable[str]:
    return *_head(name, kind, meaning), f"{_PREFIX}{name} {int(value)}"
