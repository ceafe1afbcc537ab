"""Recordings of scenes in MCAP files, their replay and their plots. Needs the packages of the extra `record`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tensormass._shared.extras import require
from tensormass_tools import presets
from tensormass_tools.daemon_arguments import add_daemon_arguments

#: How the name of a recording ends.
SUFFIX = ".mcap"
#: Steps from one check of the state to the next.
CHECK_EVERY = 100
#: Bytes of a file, at which the next one starts.
MAX_SIZE = 1 << 30
#: Allowed difference of a sampled node on another backend, relative to the largest displacement in the recording.
TOLERANCE = 1e-2


def size_of(text: str) -> int:
    """Reads a number of bytes, such as 500000, 64K, 200M or 2G."""
    number = text.strip().upper().removesuffix("B")
    unit = {"K": 10, "M": 20, "G": 30}.get(number[-1:], 0)
    try:
        return int(float(number[:-1] if unit else number) * (1 << unit))
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"{text!r} is not a size, such as 200M or 2G") from None


def add_record_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """Adds the options of `tensormass record`."""
    parser.add_argument("scene", help=scene_help)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.mcap")
    parser.add_argument("--preset", choices=tuple(presets.PROMISES), help="a measured setting of a built-in scene")
    parser.add_argument("--lockstep", action="store_true", default=None, help="step as fast as possible; needs --steps")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, metavar="N", help="end after N steps")
    length.add_argument("--seconds", type=float, metavar="T", help="end after T s; default: until Ctrl-C")
    parser.add_argument(
        "--check-every",
        type=int,
        default=CHECK_EVERY,
        metavar="N",
        help="hash the state every N steps; default: %(default)s",
    )
    parser.add_argument("--frames", action="store_true", help="record the surfaces too")
    parser.add_argument(
        "--max-size",
        type=size_of,
        default=MAX_SIZE,
        metavar="SIZE",
        help="size of a file, such as 200M or 2G. Then FILE-2.mcap starts, FILE-3.mcap and so on; each starts with a "
        "snapshot and replays alone. Default: 1G",
    )
    parser.add_argument("--keep", type=int, metavar="N", help="keep the newest N files; default: all")
    parser.add_argument(
        "--attach", metavar="NAME", help="record the scene that is loaded under this name; SCENE is what was loaded"
    )
    add_daemon_arguments(parser)
    parser.description = (
        "Loads a scene and records what its steps take from outside: poses of tools, resets, and what the daemon "
        "decides by its clock. Move its tools from other terminals (tensormass hand, tensormass view). "
        "`tensormass replay` makes the same steps again and compares the state. Needs mcap: pip install "
        "'tensormass[record]'."
    )


def add_replay_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `tensormass replay`."""
    parser.add_argument("file", type=Path, help="a recording of `tensormass record` (.mcap)")
    parser.add_argument(
        "--tolerance",
        type=float,
        default=TOLERANCE,
        metavar="SHARE",
        help="allowed difference on another backend, device or number of threads, as a share of the largest "
        f"displacement; default: {TOLERANCE:g}",
    )
    add_daemon_arguments(
        parser,
        backend_help="auto, the default: the one of the recording",
        threads_help="default: as many as when it was recorded",
    )
    parser.description = (
        "Makes the steps of a recording again, with the same inputs, and compares the state. On the same backend, "
        "device and number of threads every hash must be equal. Exit status 1 if a check fails, if steps were lost "
        "in the recording, or if it has no checks."
    )


def add_plot_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of `tensormass plot`."""
    parser.add_argument("file", type=Path, help="a recording of `tensormass record` (.mcap)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .svg or .pdf")
    parser.description = (
        "Draws the force on each tool, step time, rate, residuals and missed deadlines of a recording over time. "
        "Forces and step times are those of each frame if it was recorded with --frames, otherwise those of a status a "
        "second. Needs mcap and matplotlib: pip install 'tensormass[record,plot]'."
    )


def run_record(args: argparse.Namespace) -> int:
    """Runs `tensormass record`."""
    require("record", "a recording")
    from tensormass_tools.recording.record import run

    return run(args)


def run_replay(args: argparse.Namespace) -> int:
    """Runs `tensormass replay`."""
    require("record", "a replay")
    from tensormass_tools.recording.replay import run

    return run(args)


def run_plot(args: argparse.Namespace) -> int:
    """Runs `tensormass plot`."""
    require("record", "a plot")
    require("plot", "a plot")
    from tensormass_tools.recording.plot import run

    return run(args)
