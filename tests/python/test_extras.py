"""The SDK without its extras: what works, and how it asks for the extra that a call needs."""

from __future__ import annotations

import importlib.metadata
import os
import re
import subprocess
import tomllib
import venv
from pathlib import Path

import pytest

from tensormass._shared.extras import EXTRAS

CODE = Path(__file__).resolve().parents[2] / "clients" / "python"
DAEMON = CODE.parents[1] / "build" / "bin" / "tensormassd"
PROJECT = tomllib.loads((CODE / "pyproject.toml").read_text("utf-8"))["project"]


def name_of(requirement: str) -> str:
    """The name of a distribution, as in an index."""
    found = re.match(r"[\w.-]+", requirement)
    assert found is not None
    return re.sub(r"[-_.]+", "-", found.group()).lower()


def with_dependencies(requirements: list[str]) -> set[str]:
    """The distributions that pip would install for them, without their extras."""
    installed = {name_of(distribution.metadata["Name"]) for distribution in importlib.metadata.distributions()}
    found: set[str] = set()
    waiting = [name_of(requirement) for requirement in requirements]
    while waiting:
        if (name := waiting.pop()) not in found:
            found.add(name)
            needed = importlib.metadata.requires(name) or []
            plain = {name_of(requirement) for requirement in needed if "extra ==" not in requirement}
            waiting += plain & installed  # the others are for another system or Python
    return found


@pytest.fixture(scope="session")
def plain_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment that holds the dependencies of the SDK and none of its extras."""
    folder = tmp_path_factory.mktemp("plain")
    venv.create(folder, with_pip=False)
    (site,) = folder.glob("lib/python*/site-packages")
    for name in with_dependencies(PROJECT["dependencies"]):
        distribution = importlib.metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files or () if file.parts[0] != ".."}:
            if top != "__pycache__" and not (site / top).exists():
                (site / top).symlink_to(str(distribution.locate_file(top)))
    return folder / "bin" / "python"


def run(python: Path, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(CODE), "XDG_RUNTIME_DIR": str(folder)}
    return subprocess.run([python, *arguments], capture_output=True, text=True, env=environment, cwd=folder, timeout=60)


def test_the_list_of_extras_is_that_of_the_project() -> None:
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRAS) == set(extras) - {"build", "dev"}
    for extra, packages in EXTRAS.items():
        assert {name.lower() for name in packages} == {name_of(requirement) for requirement in extras[extra]}


def test_extras_are_not_among_the_dependencies() -> None:
    light = with_dependencies(PROJECT["dependencies"])
    assert not light & {name.lower() for packages in EXTRAS.values() for name in packages}


def test_the_sdk_works_without_extras(plain_python: Path, tmp_path: Path) -> None:
    if not DAEMON.exists():
        pytest.skip(f"{DAEMON.name} is not built")
    modules = sorted(module for packages in EXTRAS.values() for module in packages.values())
    program = f"""
import importlib.util
assert not [name for name in {modules} if importlib.util.find_spec(name)], "this environment has extras"
import tensormass as tm
scene = tm.Scene.from_mesh(tm.grid([1, 1, 1], [0.1, 0.1, 0.1]), young_modulus_pa=4000, poisson_ratio=0.45)
scene.add_tool("probe", "spherical_probe", radius_m=0.01, position_m=(0, 0, 0.2))
with tm.launch(backend="cpu") as server:
    handle = server.load(scene, lockstep=True)
    print(handle.step(2).step, handle.positions("body").shape)
"""
    ran = run(plain_python, "-c", program, folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == "2 (8, 3)\n"


@pytest.mark.parametrize(
    ("extra", "call"),
    [
        ("tetrahedra", "tm.tetrahedralize(tm.TriangleSurface.from_arrays(P, [[0, 2, 1], [0, 1, 3]]), 0.1)"),
    ],
)
def test_a_call_names_the_extra_that_it_needs(plain_python: Path, tmp_path: Path, extra: str, call: str) -> None:
    program = f"""
import tensormass as tm
P = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
try:
    {call}
except tm.NotFoundError as error:
    print(error)
"""
    ran = run(plain_python, "-c", program, folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    packages = " and ".join(EXTRAS[extra])
    assert ran.stdout.endswith(f"needs {packages}; install with: pip install 'tensormass[{extra}]'\n")


def test_meshes_need_no_extra_but_for_lz4(plain_python: Path, tmp_path: Path) -> None:
    program = """
import tensormass as tm
from pathlib import Path
tm.write_mesh("cube.vtu", tm.grid([1, 1, 1], [1, 1, 1]))
print(tm.read_mesh("cube.vtu").element_count, len(tm.Scene.from_file("demo").message.bodies))
Path("lz4.vtu").write_text(Path("cube.vtu").read_text().replace("vtkZLib", "vtkLZ4"))
try:
    tm.read_mesh("lz4.vtu")
except tm.InvalidArgumentError as error:
    print(error)
"""
    ran = run(plain_python, "-c", program, folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
    counts, said = ran.stdout.splitlines()
    assert counts.split()[0] == "6"
    needs = "lz4.vtu: reading the compressor LZ4 needs lz4; install with: pip install 'tensormass[meshes]'"
    assert said == f"{needs}, or save with ZLib"


@pytest.mark.parametrize(
    ("extra", "arguments"),
    [
        ("viewer", ["view"]),
        ("desktop", ["view", "--desktop"]),
        ("viewer", ["run"]),
        ("modes", ["modes", "cantilever"]),
        ("organs", ["organ", "liver.seg.nrrd", "--segment", "liver"]),
        ("record", ["record", "cantilever", "-o", "cantilever.mcap"]),
        ("record", ["replay", "cantilever.mcap"]),
        ("record", ["plot", "cantilever.mcap", "-o", "cantilever.png"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else value,
)
def test_a_command_names_the_extra_that_it_needs(
    plain_python: Path, tmp_path: Path, extra: str, arguments: list[str]
) -> None:
    ran = run(plain_python, "-m", "tensormass", *arguments, folder=tmp_path)
    assert ran.returncode == 1, ran.stdout + ran.stderr
    assert ran.stderr.startswith("tensormass: ")
    assert ran.stderr.endswith(f"install with: pip install 'tensormass[{extra}]'\n")


def test_help_needs_no_extras(plain_python: Path, tmp_path: Path) -> None:
    ran = run(plain_python, "-m", "tensormass", "--help", folder=tmp_path)
    assert ran.returncode == 0, ran.stderr
