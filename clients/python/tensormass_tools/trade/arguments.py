"""The options of `tensormass trade`, and its defaults."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from tensormass_tools.trade.recorder import TIMED_STEPS
from tensormass_tools.trade.script import PRESS_RADII

COMBINATIONS = 24
QUICK_COMBINATIONS = 6
REFERENCE_S = 600.0
QUICK_REFERENCE_S = 60.0
_TIMES_S = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
# Largest number of any option. A larger one is a mistake, and the run would not end.
_MOST = 1e6
# Settings that are tried for each of the two files. If all leave their limit, another is unlikely to keep it.
CANDIDATES = 3
# Time for timing one setting [s]. Runs of the written files get AGAIN times as long, so that slow settings are timed
# over enough steps.
TIMING_S, QUICK_TIMING_S = 5.0, 0.5
AGAIN = 4


def add_arguments(parser: argparse.ArgumentParser, scene_help: str) -> None:
    """Adds the options of `tensormass trade`."""
    # A bare mesh, which other commands take, has neither loads nor tools to compare settings by.
    parser.add_argument("scene", help=scene_help.replace(" a mesh file,", ""))
    parser.add_argument(
        "--budget",
        type=parse_time_s,
        metavar="TIME",
        help="limit of the median step, such as 1ms; default: the scene's dt",
    )
    parser.add_argument(
        "--tolerance", type=parse_share, default=0.02, metavar="SHARE", help="largest error; default: 2%%"
    )
    parser.add_argument("--backend", choices=("auto", "cpu", "cuda"), default="auto", help="default: %(default)s")
    parser.add_argument("--cpu-threads", type=int, metavar="N", help="threads of the scene on the CPU")
    parser.add_argument("--seconds", type=parse_number, metavar="T", help="simulated time of the test run")
    parser.add_argument(
        "--press",
        type=parse_depths,
        default=(PRESS_RADII,),
        metavar="RADII",
        help="how deep the tool presses, against its radius; two depths, as in 0.5,1, are judged one by one; default: "
        f"{PRESS_RADII:g}",
    )
    parser.add_argument("--knobs", metavar="A,B", help="only these; default: all that the scene has")
    parser.add_argument(
        "--combinations", type=int, metavar="N", help=f"settings of several knobs; default: {COMBINATIONS}"
    )
    parser.add_argument(
        "--reference-seconds",
        type=parse_number,
        metavar="T",
        help=f"refine the reference no longer than this; default: {REFERENCE_S:g}",
    )
    parser.add_argument(
        "--timing-seconds",
        type=parse_number,
        metavar="T",
        help=f"for the times of each setting, over {TIMED_STEPS} steps where they suffice; {AGAIN} times as long for "
        f"what is run again; default: {TIMING_S:g}",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help=f"nearest values only, {QUICK_COMBINATIONS} combinations, {QUICK_REFERENCE_S:g} s for the reference, "
        f"{QUICK_TIMING_S:g} s for the times of each setting",
    )
    parser.add_argument(
        "--confirm",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="scene files to run through the same script in the end; the two that the command writes always are",
    )
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="FOLDER",
        help="folder of results and report, by default trade-NAME; a stopped run continues from it",
    )
    parser.description = (
        "Runs a scene through a script over and over, with other meshes, laws, steps and solvers, and compares each "
        "run with the same scene refined until it no longer moves. Prints a table and writes report.html, trade.json "
        "and as scene files the fastest setting within the tolerance (fastest.yaml) and the most accurate one within "
        "the budget (most_accurate.yaml), which it then reads and runs again; one that leaves its limit in that run "
        f"makes room for the next best, up to {CANDIDATES} of each. The error is that of displacement (L2) or of the "
        "tool's force, whichever is larger."
    )


def parse_time_s(text: str) -> float:
    """Parses a time: `1ms`, `500us`, `0.001s` -> seconds."""
    match = re.fullmatch(r"([0-9.eE+-]+?)\s*(us|ms|s)", text.strip())
    number, unit_s = (match[1], _TIMES_S[match[2]]) if match else ("", 0.0)
    return _positive(number, unit_s, text, "a time such as 1ms")


def parse_share(text: str) -> float:
    """Parses a share: `2%`, `0.02` -> 0.02."""
    stripped = text.strip()
    if re.fullmatch(r"[1-9][0-9]*", stripped):
        raise argparse.ArgumentTypeError(f"{text!r} is {stripped}00 %; write {stripped}%")
    return _positive(stripped.removesuffix("%"), 0.01 if stripped.endswith("%") else 1.0, text, "a share such as 2%")


def parse_number(text: str) -> float:
    """Parses a positive number: `0.5` -> 0.5."""
    return _positive(text, 1.0, text, f"a number above 0 and below {_MOST:g}")


def parse_depths(text: str) -> tuple[float, ...]:
    """Parses one or two ascending numbers: `0.5` or `0.5,1`."""
    depths = tuple(parse_number(part) for part in text.split(","))
    if len(depths) > 2 or list(depths) != sorted(set(depths)):
        raise argparse.ArgumentTypeError(f"{text!r}: give one depth, or a shallow and a deep one")
    return depths


def _positive(number: str, unit: float, text: str, what: str) -> float:
    try:
        value = float(number) * unit
    except ValueError:
        value = 0.0
    if not 0 < value < _MOST:
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return value
