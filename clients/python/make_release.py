"""Puts everything of a release into a folder. `make release` calls it, before and after it has made the wheel.

    python make_release.py --check                                       is the checkout fit for a release?
    python make_release.py --wheel ../../build-wheel/wheel --output ../../dist

    tensormass-VERSION-py3-none-manylinux_*.whl    SDK, commands, daemon, haptic client, viewer (make_wheel.py)
    tensormass-VERSION-py3-none-any.whl            the SDK and its commands alone, with extras
    tensormass-VERSION-source.tar.gz               the commit
    tensormass-VERSION.cdx.json                    every package in it or pinned, as CycloneDX (components.py)
    SHA256SUMS                                     checksums of these, for `sha256sum --check`

The version is that of pyproject.toml. CHANGELOG.md must have a dated section for it, nothing may be uncommitted, and a
tag of that version must not name another commit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from components import bill_of_materials, bundled, pinned
from make_wheel import copy_packages, output_of

ROOT = Path(__file__).resolve().parents[2]
SUMS = "SHA256SUMS"


class ReleaseError(Exception):
    """The checkout or the wheel is not fit for a release; the message says what to do."""


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0] if __doc__ else None)
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--check", action="store_true", help="only check the checkout")
    task.add_argument("--wheel", type=Path, metavar="FOLDER", help="folder of the wheel that make_wheel.py made")
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder for the release; emptied first")
    args = parser.parse_args()
    try:
        version = check(ROOT)
        if args.wheel is not None:
            for line in make(ROOT, version, args.wheel, args.output):
                print(f"release: {line}")
    except ReleaseError as error:
        print(f"release: {error}", file=sys.stderr)
        return 1
    return 0


def check(root: Path) -> str:
    """Returns the version that this checkout would release.

    Raises:
        ReleaseError: something is not committed, the change log lacks the version, or the tag is taken.
    """
    version = str(tomllib.loads((root / "clients/python/pyproject.toml").read_text("utf-8"))["project"]["version"])
    changed = git(root, "status", "--porcelain")
    if changed:
        names = ", ".join(line[3:] for line in changed.splitlines()[:5])
        raise ReleaseError(f"commit or remove what is not committed first: {names}")
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$"
    if re.search(heading, (root / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE) is None:
        raise ReleaseError(f"CHANGELOG.md has no section '## [{version}] - YYYY-MM-DD'; write it with today's date")
    tag = f"v{version}"
    if git(root, "tag", "--list", tag) and git(root, "rev-list", "-n1", tag) != git(root, "rev-parse", "HEAD"):
        raise ReleaseError(f"tag {tag} names another commit; raise the version in clients/python/pyproject.toml")
    return version


def make(root: Path, version: str, wheels: Path, output: Path) -> list[str]:
    """Fills `output` and returns a line for each file. Leaves it as it was if something fails.

    Raises:
        ReleaseError: `wheels` does not hold one wheel of this version, or the generated protocol is missing.
    """
    found = sorted(wheels.glob("*.whl"))
    wanted = rf"tensormass-{re.escape(version)}-py3-none-manylinux\w+\.whl"
    if len(found) != 1 or not re.fullmatch(wanted, found[0].name):
        names = ", ".join(path.name for path in found) or "no wheel"
        raise ReleaseError(f"{wheels} holds {names}; expected one of version {version}: run `make wheel` again")
    if not (root / "clients/python/tensormass/v1/__init__.py").is_file():
        raise ReleaseError("the protocol's Python code is missing; run `make python`")
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".release-", dir=output.parent) as folder:
        made = Path(folder) / "dist"
        made.mkdir()
        shutil.copy2(found[0], made)
        make_sdk(root, made)
        archive = made / f"tensormass-{version}-source.tar.gz"
        prefix = f"--prefix=tensormass-{version}/"
        git(root, "archive", "--format=tar.gz", prefix, "-o", str(archive.resolve()), "HEAD")
        bill = bill_of_materials(version, git(root, "log", "-1", "--format=%cI"), {*pinned(root), *bundled(found[0])})
        (made / f"tensormass-{version}.cdx.json").write_text(json.dumps(bill, indent=1) + "\n")
        files = sorted(made.iterdir())
        sums = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}\n" for file in files]
        (made / SUMS).write_text("".join(sums))
        shutil.rmtree(output, ignore_errors=True)
        made.rename(output)
    return [f"{output / file.name} ({(output / file.name).stat().st_size / 1e6:.1f} MB)" for file in files]


def make_sdk(root: Path, output: Path) -> None:
    """Makes the wheel of the SDK alone, in a copy: setuptools leaves its own files beside the sources."""
    with tempfile.TemporaryDirectory(prefix="tensormass-sdk-") as folder:
        copy_packages(root, Path(folder), (root / "clients/python/pyproject.toml").read_text("utf-8"))
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
        subprocess.run([*build, "--wheel-dir", str(output), folder], check=True)


def git(root: Path, *arguments: str) -> str:
    return output_of(["git", "-C", root, *arguments]).strip("\n")


if __name__ == "__main__":
    sys.exit(main())
