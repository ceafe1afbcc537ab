"""One viewer process of a load test: takes every frame it can get and measures its age.

    python -m tensormass_tools.load_viewer --server ADDR --scene NAME --transport zeromq --ready FILE --report FILE

Creates the ready file at the first frame from the bus. If the scene is stopped, no frame will come, and the file is
created at once. Runs until SIGTERM as long as the daemon answers, with or without frames. Then writes the report
(NumPy: ages_s, dropped).
"""

from __future__ import annotations

import signal
import sys
import time
from array import array
from pathlib import Path
from types import FrameType

import numpy as np

from tensormass import DeadlineExceededError, SceneHandle, TensormassError, connect
from tensormass.v1 import stream_pb2
from tensormass_tools.daemon_arguments import add_keys_argument
from tensormass_tools.parser import Parser

_FAULTED = stream_pb2.SceneStatus.STATE_FAULTED


class _StopRequested(Exception):  # noqa: N818  (nothing went wrong)
    """SIGTERM was received."""


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise _StopRequested


def _check(scene: SceneHandle, ready: Path) -> None:
    """Marks the viewer ready if the scene is stopped, because no frame will come. Raises if the daemon is gone."""
    if scene.status().state == _FAULTED:
        ready.touch()


def main(argv: list[str] | None = None) -> int:
    """Runs the viewer. Returns 0 if every frame was whole."""
    parser = Parser(description="one viewer of a load test")
    parser.add_argument("--server", required=True)
    add_keys_argument(parser)
    parser.add_argument("--scene", required=True)
    parser.add_argument("--transport", choices=("zeromq", "zenoh"), required=True)
    parser.add_argument("--ready", type=Path, required=True)
    parser.add_argument("--report", type=Path, required=True)
    args = parser.parse_args(argv)

    ages_s = array("d")
    skipped_while_joining = 0
    signal.signal(signal.SIGTERM, _stop)
    try:
        with connect(args.server, keys=args.keys) as server:
            scene = server.scene(args.scene)
            vertex_count = sum(body.vertex_count for body in scene.topology().bodies)
            stream = scene.frames(args.transport)
            try:
                next(stream)  # the present state, by call; frames of the bus follow
                _check(scene, args.ready)
                while True:
                    try:
                        frame = next(stream)
                    except DeadlineExceededError:
                        _check(scene, args.ready)  # the scene is stopped, or publishes seldom
                        continue
                    ages_s.append((time.time_ns() - frame.server_time_ns) * 1e-9)
                    if len(ages_s) == 1:
                        skipped_while_joining = stream.dropped_count
                        args.ready.touch()
                    appended = len(frame.positions) - vertex_count  # only a surface that changes has more
                    if appended < 0 or (appended and not frame.revision) or not np.isfinite(frame.positions).all():
                        print(f"frame {frame.sequence} is not {vertex_count} finite positions", file=sys.stderr)
                        return 1
            except _StopRequested:
                with args.report.open("wb") as report:
                    dropped = stream.dropped_count - skipped_while_joining
                    np.savez(report, ages_s=np.asarray(ages_s), dropped=dropped)
                return 0
    except (_StopRequested, TensormassError) as error:
        print(f"{args.scene}: {error or 'stopped before the first frame'}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
