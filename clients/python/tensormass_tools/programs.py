"""The programs of a wheel as commands: `tensormassd` and `tensormass-haptic`. Each replaces this Python process."""

from __future__ import annotations

import os
import sys

from tensormass._shared.processes import BUNDLE


def daemon() -> None:
    """`tensormassd`: the simulation server."""
    _become("tensormassd")


def haptic() -> None:
    """`tensormass-haptic`: moves a tool of a scene with a haptic device."""
    _become("tensormass-haptic")


def _become(name: str) -> None:
    # Only the wheel's own program: PATH would find this command again.
    program = BUNDLE / name
    if not os.access(program, os.X_OK):
        sys.exit(f"{name}: not in {BUNDLE}, because this package was installed without programs; see `make wheel`")
    os.execv(program, [name, *sys.argv[1:]])
