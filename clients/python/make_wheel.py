"""Makes a wheel that holds SDK, commands, daemon, haptic client and viewer. `make wheel` calls it.

    python make_wheel.py --build ../../build-wheel --output ../../build-wheel/wheel

The packages are copied into a folder, and the built parts are added as tensormass/_bundle:

    tensormassd, tensormass-haptic    stripped; their loader path leads to lib/
    lib/                              the shared libraries that a bare Linux lacks
    viewer/                           the built page

Its dependencies include the extras of EXTRAS, because `tensormass run` needs them. A wheel of the SDK alone, for any
system and with extras, is made by `pip wheel --no-deps clients/python`.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path

from notices import third_party_notices

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PACKAGES = ("tensormass", "tensormass_gateway", "tensormass_tools")
PROGRAMS = ("tensormassd", "tensormass-haptic")
# Extras of pyproject.toml that this wheel always brings along.
EXTRAS = ("meshes", "tetrahedra", "viewer")
# A wheel may expect these on every machine (PEP 600, the manylinux policy). Python itself or NumPy needs them too.
EXPECTED = ("libstdc++.so.6", "libgcc_s.so.1", "libz.so.1")
# Commands that only this wheel has. In a checkout the programs themselves are in build/bin.
COMMANDS = """\
tensormassd = "tensormass_tools.programs:daemon"
tensormass-haptic = "tensormass_tools.programs:haptic"
"""


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--build", type=Path, default=ROOT / "build", help="build folder; its bin/ holds the programs")
    parser.add_argument("--viewer", type=Path, default=ROOT / "clients/web/dist", help="folder of the built viewer")
    parser.add_argument("--output", type=Path, required=True, help="folder for the wheel")
    args = parser.parse_args()
    programs = [args.build / "bin" / name for name in PROGRAMS]
    for needed in (*programs, args.viewer / "index.html", HERE / "tensormass/v1/__init__.py"):
        if not needed.is_file():
            return fail(f"{needed} is missing; `make wheel` builds it")
    version = tomllib.loads((HERE / "pyproject.toml").read_text())["project"]["version"]
    told = output_of([programs[0], "--version"]).split()[-1]
    if told != version:
        return fail(f"{programs[0]} is version {told} and pyproject.toml says {version}; build it again")

    with tempfile.TemporaryDirectory(prefix="tensormass-wheel-") as made:
        stage = Path(made)
        copy_packages(ROOT, stage, project_of_the_wheel((HERE / "pyproject.toml").read_text()))
        bundle = stage / "tensormass" / "_bundle"
        add_programs(bundle, programs)
        shutil.copytree(args.viewer, bundle / "viewer")
        (stage / "NOTICE-third-party.txt").write_text(third_party_notices(ROOT, linked_libraries(programs)))
        shutil.rmtree(args.output, ignore_errors=True)
        tag = platform_tag([*(bundle / name for name in PROGRAMS), *(bundle / "lib").iterdir()])
        build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
        build += [f"--config-settings=--build-option=--plat-name={tag}", "--wheel-dir", str(args.output), made]
        subprocess.run(build, check=True)
    (wheel,) = args.output.glob("*.whl")
    print(f"wheel: {wheel} ({wheel.stat().st_size / 1e6:.1f} MB)")
    return 0


def fail(text: str) -> int:
    print(f"wheel: {text}", file=sys.stderr)
    return 1


def output_of(command: Sequence[str | Path]) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def copy_packages(root: Path, stage: Path, project: str) -> None:
    """Fills a folder with the Python packages of a checkout. `project` becomes its pyproject.toml."""
    for name in PACKAGES:
        source = root / "clients/python" / name
        shutil.copytree(source, stage / name, ignore=shutil.ignore_patterns("__pycache__", "_bundle"))
    shutil.copy(root / "clients/python/README.md", stage)
    shutil.copy(root / "LICENSE", stage)
    (stage / "pyproject.toml").write_text(project)


def project_of_the_wheel(project: str) -> str:
    """Adds the programs' commands and the packages of EXTRAS to the text of pyproject.toml."""
    extras = tomllib.loads(project)["project"]["optional-dependencies"]
    packages = "".join(f'  "{package}",\n' for extra in EXTRAS for package in extras[extra])
    for head, added in (("[project.scripts]\n", COMMANDS), ("\ndependencies = [\n", packages)):
        assert project.count(head) == 1
        project = project.replace(head, head + added)
    return project


def add_programs(bundle: Path, programs: Iterable[Path]) -> None:
    """Copies the programs with their libraries, less the EXPECTED ones."""
    subprocess.run([ROOT / ".setup/portable.sh", bundle, *programs], check=True, stdout=subprocess.DEVNULL)
    for name in EXPECTED:
        (bundle / "lib" / name).unlink(missing_ok=True)


def linked_libraries(programs: Iterable[Path]) -> list[Path]:
    """Returns the shared libraries of the programs where this machine has them, less the EXPECTED ones."""
    found = set()
    for program in programs:
        found |= {Path(path) for path in re.findall(r"=> (/\S+)", output_of(["ldd", program]))}
    return sorted(path for path in found if path.name not in EXPECTED)


def platform_tag(files: Iterable[Path]) -> str:
    """Returns the manylinux tag of the newest glibc symbol that any of the ELF files needs."""
    needed = {(2, 17)}
    for file in files:
        symbols = output_of(["readelf", "--version-info", "--wide", file])
        needed |= {(int(major), int(minor)) for major, minor in re.findall(r"GLIBC_(\d+)\.(\d+)", symbols)}
    major, minor = max(needed)
    return f"manylinux_{major}_{minor}_x86_64"


if __name__ == "__main__":
    sys.exit(main())
