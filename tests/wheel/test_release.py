"""What `make release` leaves, and when it refuses. A stand-in takes the place of the wheel with the daemon."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PYTHON = ROOT / "clients" / "python"
sys.path.insert(0, str(PYTHON))

import components  # noqa: E402
import make_release  # noqa: E402
import make_wheel  # noqa: E402

VERSION = tomllib.loads((PYTHON / "pyproject.toml").read_text())["project"]["version"]
WHEEL = f"tensormass-{VERSION}-py3-none-manylinux_2_35_x86_64.whl"


def git(folder: Path, *arguments: str) -> str:
    identity = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    return subprocess.run(
        ["git", "-C", folder, *identity, *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A small repository with what a release needs of this one, all committed."""
    folder = tmp_path / "checkout"
    for name in make_wheel.PACKAGES:
        without = shutil.ignore_patterns("__pycache__", "_bundle", "trade")
        shutil.copytree(PYTHON / name, folder / "clients/python" / name, ignore=without)
    copied = ("clients/python/pyproject.toml", "clients/python/README.md", "LICENSE", ".gitignore")
    for name in (*copied, *components.PYTHON_LOCKS, components.NPM_LOCK, components.CARGO_LOCK):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / name)
    (folder / "CHANGELOG.md").write_text(f"# Changes\n\n## [{VERSION}] - 2030-01-31\n")
    git(folder, "init", "--quiet")
    git(folder, "add", "--all", "--force")
    git(folder, "commit", "--quiet", "--message", "Start")
    return folder


@pytest.fixture
def wheels(tmp_path: Path) -> Path:
    folder = tmp_path / "wheels"
    folder.mkdir()
    (folder / WHEEL).write_bytes(b"wheel")
    return folder


def test_a_release_holds_both_wheels_the_sources_and_their_checksums(checkout: Path, wheels: Path) -> None:
    if not (PYTHON / "tensormass/v1/__init__.py").is_file():
        pytest.skip("the protocol's Python code is not made; run `make python`")
    dist = checkout / "dist"
    dist.mkdir()
    (dist / "old.whl").touch()
    version = make_release.check(checkout)
    assert version == VERSION
    lines = make_release.make(checkout, version, wheels, dist)
    sdk, source = f"tensormass-{VERSION}-py3-none-any.whl", f"tensormass-{VERSION}-source.tar.gz"
    bill = f"tensormass-{VERSION}.cdx.json"
    names = {WHEEL, sdk, source, bill}
    assert {path.name for path in dist.iterdir()} == names | {"SHA256SUMS"}
    assert len(lines) == 4

    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "SHA256SUMS"], cwd=dist, check=True)
    assert len((dist / "SHA256SUMS").read_text().splitlines()) == 4

    listed = json.loads((dist / bill).read_text())
    assert listed["metadata"]["component"]["version"] == VERSION
    assert {each["purl"] for each in listed["components"]} == {each.purl for each in components.pinned()}

    with tarfile.open(dist / source) as archive:
        held = {name.removeprefix(f"tensormass-{VERSION}/") for name in archive.getnames() if not name.endswith("/")}
        assert set(git(checkout, "ls-files").splitlines()) <= held
        assert not [name for name in held if name.startswith(("dist", ".git/"))]

    with zipfile.ZipFile(dist / sdk) as archive:
        inside = archive.namelist()
        (metadata,) = [name for name in inside if name.endswith("/METADATA")]
        about = archive.read(metadata).decode()
    assert "tensormass/v1/scene_pb2.py" in inside
    assert not [name for name in inside if "_bundle" in name]
    assert "Provides-Extra: viewer" in about
    assert not re.search(r"^Requires-Dist: aiohttp[^;]*$", about, re.MULTILINE)
    assert make_release.check(checkout) == VERSION, "a release leaves the checkout clean"


def test_the_wheel_with_the_daemon_needs_no_extras() -> None:
    project = tomllib.loads(make_wheel.project_of_the_wheel((PYTHON / "pyproject.toml").read_text()))["project"]
    extras = project["optional-dependencies"]
    for extra in make_wheel.EXTRAS:
        assert set(extras[extra]) <= set(project["dependencies"])
    assert {"tensormass", "tensormassd", "tensormass-haptic"} == set(project["scripts"])


@pytest.mark.parametrize("name", ["LICENSE", "new.txt"])
def test_what_is_not_committed_is_refused(checkout: Path, name: str) -> None:
    (checkout / name).write_text("changed")
    with pytest.raises(make_release.ReleaseError, match=f"commit or remove what is not committed first: {name}"):
        make_release.check(checkout)


@pytest.mark.parametrize("heading", ["## [9.9.9] - 2030-01-31", f"## [{VERSION}] - unreleased"])
def test_a_change_log_without_the_dated_version_is_refused(checkout: Path, heading: str) -> None:
    (checkout / "CHANGELOG.md").write_text(f"# Changes\n\n{heading}\n")
    git(checkout, "commit", "--quiet", "--all", "--message", "Change the log")
    with pytest.raises(make_release.ReleaseError, match=re.escape(f"no section '## [{VERSION}] - YYYY-MM-DD'")):
        make_release.check(checkout)


def test_a_version_that_was_released_from_another_commit_is_refused(checkout: Path) -> None:
    git(checkout, "tag", f"v{VERSION}")
    assert make_release.check(checkout) == VERSION
    git(checkout, "commit", "--quiet", "--allow-empty", "--message", "Go on")
    with pytest.raises(make_release.ReleaseError, match="raise the version"):
        make_release.check(checkout)


@pytest.mark.parametrize("names", [[], ["tensormass-9.9.9-py3-none-manylinux_2_35_x86_64.whl"], [WHEEL, "other.whl"]])
def test_other_wheels_than_this_versions_are_refused(checkout: Path, tmp_path: Path, names: list[str]) -> None:
    folder, dist = tmp_path / "others", tmp_path / "dist"
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    dist.mkdir()
    (dist / "kept.whl").touch()
    with pytest.raises(make_release.ReleaseError, match=f"expected one of version {VERSION}: run `make wheel` again"):
        make_release.make(checkout, VERSION, folder, dist)
    assert (dist / "kept.whl").exists()


def test_the_command_says_why_it_refuses() -> None:
    ran = subprocess.run([sys.executable, PYTHON / "make_release.py"], capture_output=True, text=True)
    assert ran.returncode == 2
    assert "--check --wheel" in ran.stderr
