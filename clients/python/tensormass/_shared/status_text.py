"""Parts of a scene's status in words."""

from __future__ import annotations

from tensormass.v1 import stream_pb2


def recoveries_text(status: stream_pb2.SceneStatus) -> str:
    """Describes the recoveries: their number, their steps, and the one that goes on now."""
    parts = [str(status.recoveries), "1 step" if status.recovering_steps == 1 else f"{status.recovering_steps:,} steps"]
    if status.held_steps:
        parts.append(f"tissue held in {status.held_steps:,}")
    if status.recovering and status.state != stream_pb2.SceneStatus.STATE_FAULTED:
        parts.append("recovering now")
    return ", ".join(parts)
