"""`tensormass view --desktop`: a window that follows a running scene. Needs the packages of the extra `desktop`."""

from __future__ import annotations

import argparse
from pathlib import Path

from tensormass import InvalidArgumentError
from tensormass._shared.extras import require


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the window to `tensormass view`."""
    parser.add_argument(
        "scene",
        nargs="?",
        metavar="RECORDING",
        help="a recording to play, made by `tensormass record --frames`; or with --desktop the name of a loaded scene, "
        "or the scene file or built-in scene that was loaded, which has the rest positions; default: the only loaded "
        "scene",
    )
    parser.add_argument("--desktop", action="store_true", help="a window (PyVista) instead of a page for browsers")
    parser.add_argument(
        "--screenshot",
        type=Path,
        metavar="FILE.png",
        help="with --desktop: write a picture of the present state and end; needs no screen",
    )


def run(args: argparse.Namespace) -> int:
    """Runs `tensormass view --desktop`."""
    if args.screenshot is not None and args.screenshot.suffix != ".png":
        raise InvalidArgumentError(f"--screenshot {args.screenshot}: must end in .png")
    require("desktop", "view --desktop")
    from tensormass_tools.desktop.window import run

    return run(args)
