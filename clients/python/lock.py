"""Writes requirements.sha256: the packages of requirements.lock with the sums of their files, for pip.

    .venv/bin/python clients/python/lock.py        after a change of requirements.lock; needs the network

Each line says behind `#` which extras need the package; `base` is the package without extras. The set-up installs the
lines of its extras, without resolving anything. The sums are those of the wheels for Linux on x86-64 and the Pythons of
PYTHONS: with another platform pip finds no file that it may install, and says so.
"""

from __future__ import annotations

import importlib.metadata
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement

HERE = Path(__file__).resolve().parent
LOCK, SUMS = HERE / "requirements.lock", HERE / "requirements.sha256"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = [f"manylinux_2_{minor}_x86_64" for minor in range(36, 4, -1)] + ["manylinux2014_x86_64"]
HEAD = (
    "# Packages of requirements.lock, sums of their files, and extras that need them. Made by lock.py for the set-up.\n"
)
BUILDS = "setuptools"
"""Needed to install the SDK itself, so it belongs to `base`."""


def main() -> int:
    pins = pinned(LOCK.read_text("utf-8"))
    sums: dict[str, set[str]] = {name: set() for name in pins}
    for python in PYTHONS:
        for name, value in files_of(python).items():
            sums[name].add(value)
    extras = extras_of(pins)
    lines = [
        " ".join([f"{name}=={version}", *(f"--hash=sha256:{each}" for each in sorted(sums[name])), "#", *extras[name]])
        for name, version in sorted(pins.items())
        if sums[name]
    ]
    SUMS.write_text(HEAD + "\n".join(lines) + "\n")
    without = sorted(name for name in pins if not sums[name])
    print(f"lock: {len(lines)} packages; without a wheel: {', '.join(without) or 'none'}")
    return 1 if without else 0


def pinned(text: str) -> dict[str, str]:
    """Returns the version of each package in a lock file."""
    return {normal(name): version for name, version in re.findall(r"^([\w.-]+)==(\S+)", text, re.MULTILINE)}


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def files_of(python: str) -> dict[str, str]:
    """Returns the sum of the file that pip takes of each package, for a version of Python."""
    platforms = [part for name in PLATFORMS for part in ("--platform", name)]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed", "--no-deps"]
        command += ["--only-binary", ":all:", "--python-version", python, *platforms, "--target", folder]
        report = subprocess.run(
            [*command, "--report", "-", "-r", str(LOCK)], check=True, stdout=subprocess.PIPE, text=True
        ).stdout
    return {
        normal(entry["metadata"]["name"]): entry["download_info"]["archive_info"]["hashes"]["sha256"]
        for entry in json.loads(report)["install"]
    }


def extras_of(pins: dict[str, str]) -> dict[str, list[str]]:
    """Returns the extras that need each package, by what this environment has installed."""
    metadata = importlib.metadata.metadata("tensormass")
    needed: dict[str, set[str]] = {name: set() for name in pins}
    for extra in ("base", *(metadata.get_all("Provides-Extra") or ())):
        found: set[str] = set()
        _follow("tensormass", "" if extra == "base" else extra, found)
        if extra == "base":
            found.add(BUILDS)
        for name in found & pins.keys():
            needed[name].add(extra)
    for extras in needed.values():
        if "base" in extras:
            extras.intersection_update({"base"})  # whatever else needs it, it is there
    return {name: sorted(extras) for name, extras in needed.items()}


def _follow(name: str, extra: str, found: set[str]) -> None:
    for text in importlib.metadata.requires(name) or ():
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        child = normal(requirement.name)
        if child in found:
            continue
        if child != "tensormass":
            found.add(child)
            _follow(child, "", found)
        for more in requirement.extras:
            _follow(child, more, found)


if __name__ == "__main__":
    sys.exit(main())
