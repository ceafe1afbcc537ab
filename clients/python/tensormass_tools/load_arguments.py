"""The options of `tensormass load-test`."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from tensormass_tools.daemon_arguments import add_keys_argument
from tensormass_tools.load_test import _MAX_TOOLS

# The daemon's own limits (server/core/limits.h).
_MAX_SCENES = 256
_MAX_VIEWERS = 256
_MAX_SECONDS = 86_400.0
_MAX_EDITS_HZ = 1000.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `tensormass load-test`."""
    parser.add_argument(
        "--scenes", type=_count(1, _MAX_SCENES), default=1, metavar="S", help="copies of the scene; default: 1"
    )
    parser.add_argument(
        "--haptic",
        type=_count(0, _MAX_SCENES * _MAX_TOOLS),
        default=1,
        metavar="H",
        help="haptic clients at 1 kHz; default: 1",
    )
    parser.add_argument(
        "--viewers", type=_count(0, _MAX_VIEWERS), default=1, metavar="V", help="frame subscribers; default: 1"
    )
    parser.add_argument(
        "--seconds", type=_seconds, default=20.0, metavar="T", help="how long the clients run; default: 20"
    )
    parser.add_argument("--scene", default="demo", help="a built-in scene or a scene file (default: %(default)s)")
    parser.add_argument(
        "--transport",
        choices=("mixed", "zeromq", "zenoh"),
        default="mixed",
        help="transport of haptic clients and viewers; mixed: every second one uses zenoh (default)",
    )
    parser.add_argument("--server", metavar="ADDR", help="a running daemon, host:port; without it one is started")
    add_keys_argument(parser)
    parser.add_argument(
        "--backend", choices=("auto", "cpu", "cuda"), default="auto", help="backend of the daemon to start"
    )
    parser.add_argument(
        "--stop-viewer",
        type=_seconds,
        metavar="SECONDS",
        help="SIGSTOP one viewer for so long and compare its scene's step times before, meanwhile and after",
    )
    parser.add_argument(
        "--edits",
        type=_edits_hz,
        metavar="HZ",
        help="change each scene so often a second, ablations and stiffness in turns, in every second quarter of the "
        "time, and compare the quarters",
    )
    parser.add_argument(
        "--max-missed",
        type=_percent,
        metavar="PERCENT",
        help="fail if a scene misses more of its deadlines; default: missed deadlines never fail it",
    )
    parser.add_argument("--json", metavar="FILE", help="write the report as JSON; - for standard output")
    parser.description = (
        "Loads copies of a scene, which step in real time, connects haptic clients and viewers, and measures what they "
        "see: pose to force, age of the frames, step times and missed deadlines. Exit status 0 if nothing went wrong: "
        "every client ran to its end, no last pose was left unanswered, no message was malformed, no scene is faulted, "
        "and none missed more deadlines than --max-missed. Else 1, and the report's `errors` say what. How fast it all "
        "was decides nothing without --max-missed."
    )


def _count(least: int, most: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        value = int(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{value} is not in {least} to {most}")
        return value

    parse.__name__ = "count"
    return parse


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= _MAX_SECONDS:
        raise argparse.ArgumentTypeError(f"{text} is not in 0 to {_MAX_SECONDS:g} s")
    return value


def _edits_hz(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= _MAX_EDITS_HZ:
        raise argparse.ArgumentTypeError(f"{text} is not in 0 to {_MAX_EDITS_HZ:g} Hz")
    return value


def _percent(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 100.0:
        raise argparse.ArgumentTypeError(f"{text} is not in 0 to 100 %")
    return value
